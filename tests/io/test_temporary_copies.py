"""Temporary copies of open files: no room for them, and bytes of other kinds."""

import io
import sys
from pathlib import Path

import pytest

import cvtgs
from cvtgs.errors import InputError, OutputError
from cvtgs.io import streams
from format_cases import storable_scene
from scenes import same_bits


@pytest.mark.skipif(sys.platform != "linux", reason="limits the file size as Linux does")
def test_no_room_to_build_a_file_is_an_error_of_the_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    import resource  # noqa: PLC0415 (not on Windows)

    monkeypatch.setattr(streams, "MEMORY_BYTES", 1000)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
    try:
        with pytest.raises(OutputError) as caught:
            cvtgs.save(storable_scene(500), io.BytesIO())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert str(caught.value) == (
        "the folder of temporary files must be writable and have room for a copy of what the "
        "BytesIO gets, found: file too large; TMPDIR sets another folder."
    )


class Pieces(io.BytesIO):
    """Returns its bytes as another kind of object."""

    def __init__(self, content: bytes, kind: type) -> None:
        super().__init__(content)
        self.kind = kind

    def read(self, size: int | None = -1, /) -> bytes:
        return self.kind(super().read(size))  # type: ignore[no-any-return]


@pytest.mark.parametrize("kind", [bytearray, memoryview])
def test_any_kind_of_bytes_is_read(tmp_path: Path, kind: type) -> None:
    cvtgs.save(storable_scene(5), tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    assert same_bits(cvtgs.load(Pieces(content, kind)), cvtgs.load(tmp_path / "a.ply"))


def test_a_stream_without_bytes_yet_is_named_so() -> None:
    class Waiting(io.RawIOBase):
        def read(self, size: int = -1, /) -> None:  # type: ignore[override]
            return None

    with pytest.raises(InputError, match="must be open in blocking mode, found no bytes yet"):
        cvtgs.load(Waiting())  # type: ignore[arg-type]
