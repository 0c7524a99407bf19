"""Scenes in open binary files: every format, without seeking, and what cannot be read."""

import io
import zipfile
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs.errors import DroppedDataWarning, FileFormatError, InputError, OutputError
from format_cases import storable_scene
from scenes import same_bits

FORMATS = (".ply", ".compressed.ply", ".spz", ".splat", ".sog")


class Pipe(io.RawIOBase):
    """Bytes that can be read once, some at a time."""

    def __init__(self, content: bytes) -> None:
        self.content = io.BytesIO(content)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: bytearray) -> int:  # type: ignore[override]
        return self.content.readinto(memoryview(buffer)[:100])


@pytest.mark.parametrize("end", FORMATS)
def test_a_stream_holds_what_a_file_holds(tmp_path: Path, end: str) -> None:
    scene = replace(storable_scene(40, degree=0), comments=())
    path, stream = tmp_path / f"a{end}", io.BytesIO()
    cvtgs.save(scene, path)
    scene.save(stream, format=end)
    assert stream.getvalue() == path.read_bytes()
    named = end if end == ".splat" else None
    for source in (Pipe(stream.getvalue()), io.BytesIO(stream.getvalue()), path.open("rb")):
        with source:
            assert same_bits(cvtgs.load(source, format=named), cvtgs.load(path))


def test_a_stream_gets_a_ply_and_is_read_from_where_it_stands() -> None:
    stream = io.BytesIO()
    stream.write(b"before")
    cvtgs.save(storable_scene(5), stream)
    stream.seek(6)
    assert stream.getvalue()[6:9] == b"ply"
    assert len(cvtgs.load(stream, sh_degree=1)) == 5


def test_members_of_archives_and_checkpoints(tmp_path: Path) -> None:
    scene = storable_scene(5)
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        with archive.open("scene.ply", "w") as file:
            cvtgs.save(scene, file)
        with archive.open("model.pt", "w") as file:
            torch.save({"step": 1, "splats": OrderedDict(cvtgs.to_dict(scene))}, file)
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        for name in ("scene.ply", "model.pt"):
            with archive.open(name) as file:
                assert torch.equal(cvtgs.load(file).means, scene.means)


def test_a_format_may_be_named_whatever_the_file_is_called(tmp_path: Path) -> None:
    scene = storable_scene(5)
    cvtgs.save(scene, tmp_path / "a.data", format=".ply")
    assert same_bits(cvtgs.load(tmp_path / "a.data", format=".ply"), scene)


@pytest.mark.parametrize(
    ("content", "error", "text"),
    [
        (b"", FileFormatError, "the first bytes must be those of a .ply, .spz, .sog, .glb or .pt"),
        (b"what?", FileFormatError, "found b'what'; give format= for another one"),
        (b"ply\nnonsense", FileFormatError, "stream.ply: "),
        (b"PK\x03\x04nonsense", FileFormatError, "stream.sog: "),
    ],
)
def test_what_cannot_be_read(content: bytes, error: type[Exception], text: str) -> None:
    with pytest.raises(error) as caught:
        cvtgs.load(io.BytesIO(content))
    assert text in str(caught.value)


def test_text_files_and_closed_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must be open in binary mode, found text"):
        cvtgs.load(io.StringIO("ply"))  # type: ignore[arg-type]
    scene, path = storable_scene(5), tmp_path / "a.ply"
    with path.open("w") as file, pytest.raises(OutputError, match=r"a\.ply: must be open for writ"):
        cvtgs.save(scene, file)  # type: ignore[arg-type]
    cvtgs.save(scene, path, overwrite=True)
    with path.open("rb") as file, pytest.raises(OutputError, match="must be open for writing"):
        cvtgs.save(scene, file)


def test_what_a_format_drops_is_said() -> None:
    with pytest.warns(DroppedDataWarning, match="the BytesIO: files of this format do not hold"):
        cvtgs.save(storable_scene(5), io.BytesIO(), format=".splat")
