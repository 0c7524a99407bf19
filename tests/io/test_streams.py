"""Open files, pipes and members of archives as inputs and outputs."""

import errno
import io
import json
import shutil
import sys
import tempfile
import zipfile
from collections import OrderedDict
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import cvtgs
from cvtgs.errors import (
    DroppedDataWarning,
    FileFormatError,
    InputError,
    InputNotFoundError,
    InvalidArgumentError,
    OutputError,
)
from cvtgs.io import losses, to_dict
from cvtgs.io.atomic import replace_file
from format_cases import storable_scene
from ply_files import gaussian_properties, gaussian_rows, ply_bytes
from scenes import same_bits

GOOD = ply_bytes(gaussian_properties(), gaussian_rows(gaussian_properties(), 3))


FORMATS = (".ply", ".compressed.ply", ".spz", ".splat", ".sog")


class Pipe(io.RawIOBase):
    """Bytes that can be read once, some at a time."""

    def __init__(self, content: bytes) -> None:
        self.content = io.BytesIO(content)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: bytearray) -> int:  # type: ignore[override]
        return self.content.readinto(memoryview(buffer)[:100])


def test_no_threads_spin_while_files_are_written(two_threads, monkeypatch) -> None:
    """Where other programs use the cores, they would wait for one another."""
    counts = []

    def write(scene: cvtgs.GaussianScene, file: io.BytesIO) -> None:
        counts.append(torch.get_num_threads())

    monkeypatch.setattr("cvtgs.io.ply.write_ply", write)
    cvtgs.save(storable_scene(40, degree=0), io.BytesIO())
    assert (counts, torch.get_num_threads()) == ([1], 2)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
@pytest.mark.parametrize("end", FORMATS)
def test_bytes_do_not_depend_on_the_number_of_threads(two_threads, end: str) -> None:
    scene, files = cvtgs.synthetic.scene("object", 40_000, sh_degree=1), []
    for threads in (2, 1):
        torch.set_num_threads(threads)
        files.append(io.BytesIO())
        cvtgs.save(scene, files[-1], format=end)
    assert files[0].getvalue() == files[1].getvalue()


@pytest.mark.parametrize("end", FORMATS)
def test_a_stream_holds_the_bytes_of_a_file(tmp_path: Path, end: str) -> None:
    scene = replace(storable_scene(40, degree=0), comments=())
    path, stream = tmp_path / f"a{end}", io.BytesIO()
    cvtgs.save(scene, path)
    scene.save(stream, format=end)
    assert stream.getvalue() == path.read_bytes()
    named = end if end == ".splat" else None
    for source in (Pipe(stream.getvalue()), io.BytesIO(stream.getvalue()), path.open("rb")):
        with source:
            assert same_bits(cvtgs.load(source, format=named), cvtgs.load(path))


def test_streams_default_to_ply_and_are_read_from_their_position() -> None:
    stream = io.BytesIO()
    stream.write(b"before")
    cvtgs.save(storable_scene(5), stream)
    stream.seek(6)
    assert stream.getvalue()[6:9] == b"ply"
    assert len(cvtgs.load(stream, sh_degree=1)) == 5


def test_scenes_in_members_of_a_zip_archive_are_read(tmp_path: Path) -> None:
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


def test_the_format_argument_overrides_the_suffix(tmp_path: Path) -> None:
    scene = storable_scene(5)
    cvtgs.save(scene, tmp_path / "a.data", format=".ply")
    assert same_bits(cvtgs.load(tmp_path / "a.data", format=".ply"), scene)
    cvtgs.save(scene, tmp_path / "b.data", format="ply")
    assert same_bits(cvtgs.load(tmp_path / "b.data", format="ply"), scene)


@pytest.mark.parametrize("name", ["compressed.ply", "spz.glb", "splat"])
def test_a_format_may_be_named_without_its_first_dot(tmp_path: Path, name: str) -> None:
    scene = replace(storable_scene(40, degree=0), comments=())
    for number, written in enumerate((name, f".{name}")):
        cvtgs.save(scene, tmp_path / f"{number}", format=written)
    assert (tmp_path / "0").read_bytes() == (tmp_path / "1").read_bytes()
    assert len(cvtgs.load(io.BytesIO((tmp_path / "0").read_bytes()), format=name)) == 40


def test_an_unknown_format_is_named(tmp_path: Path) -> None:
    scene = storable_scene(5)
    cvtgs.save(scene, tmp_path / "a.ply")
    for target in (io.BytesIO(), tmp_path / "b.ply"):
        with pytest.raises(FileFormatError, match=r"^format must be .*, found 'xyz'\.$"):
            cvtgs.save(scene, target, format="xyz")
    with pytest.raises(FileFormatError, match=r"^format must be .*, found 'xyz'\.$"):
        cvtgs.load(tmp_path / "a.ply", format="xyz")
    assert losses(scene, "spz") == losses(scene, ".spz") == losses(scene, "a.spz")


@pytest.mark.parametrize("name", ["spz.gz", "tar.gz", "."])
def test_unknown_formats_of_streams_are_named(name: str) -> None:
    stream = io.BytesIO()
    cvtgs.save(storable_scene(5), stream)
    with pytest.raises(FileFormatError, match=f"^format must be .*, found '{name}'"):
        cvtgs.load(io.BytesIO(stream.getvalue()), format=name)


def test_messages_about_streams_name_the_stream(tmp_path: Path) -> None:
    stream = io.BytesIO()
    cvtgs.save(storable_scene(5), stream)
    face = b"element face 1\nproperty uchar corner\n"
    ply = stream.getvalue().replace(b"end_header\n", face + b"end_header\n", 1) + b"\0"
    with pytest.warns(DroppedDataWarning, match="^the BytesIO: left out element 'face'"):
        cvtgs.load(io.BytesIO(ply))
    gltf = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": 9, "uri": "no.bin"}]}
    cvtgs.save(storable_scene(5, degree=0), tmp_path / "a.gltf")
    document = json.loads((tmp_path / "a.gltf").read_text())
    document["buffers"] = gltf["buffers"]
    with pytest.raises(InputNotFoundError, match=r"^no\.bin: the file to read must exist"):
        cvtgs.load(io.BytesIO(json.dumps(document).encode()), format=".gltf")


@pytest.mark.parametrize("end", [".glb", ".gltf", ".splat", ".usda"])
def test_scales_beyond_float32_are_clamped(tmp_path: Path, end: str) -> None:
    scene = replace(storable_scene(4, degree=0), comments=())
    log_scales = torch.tensor([[95.0, 0, 0], [-95, 0, 0], [1, 2, 3], [0, 0, 0]])
    path = tmp_path / f"a{end}"
    with pytest.warns(UserWarning, match="clamped") as said:
        cvtgs.save(scene.with_tensors({"log_scales": log_scales}), path)
    assert [one.category for one in said] == [DroppedDataWarning]  # none of numpy
    if end != ".usda":  # which is not read
        found = cvtgs.load(path).log_scales
        assert torch.allclose(found, log_scales.clamp(-87.3365, 88.7), atol=1e-4)


@pytest.mark.parametrize("end", [".ply", ".spz", ".spz.glb", ".sog", ".splat", ".compressed.ply"])
def test_tensors_of_any_memory_layout_are_written(tmp_path: Path, end: str) -> None:
    scene = replace(storable_scene(40, degree=0), comments=())
    turned = scene.with_tensors({"means": scene.means.T.contiguous().T}, {})
    cvtgs.save(scene, tmp_path / f"a{end}")
    cvtgs.save(turned, tmp_path / f"b{end}")
    assert (tmp_path / f"a{end}").read_bytes() == (tmp_path / f"b{end}").read_bytes()


@pytest.mark.parametrize(
    ("content", "error", "text"),
    [
        (b"", FileFormatError, "a .ply, .spz, .sog, .glb or .pt, found no bytes at all; give"),
        (b"what?", FileFormatError, "found b'what'; give format= for other formats"),
        (b"ply\nnonsense", FileFormatError, "the BytesIO: the header must end with 'end_header'"),
        (b"PK\x03\x04nonsense", FileFormatError, "the BytesIO: a .sog must be a zip"),
    ],
)
def test_damaged_streams_are_refused(content: bytes, error: type[Exception], text: str) -> None:
    with pytest.raises(error) as caught:
        cvtgs.load(io.BytesIO(content))
    assert text in str(caught.value)


def test_a_stream_of_another_kind_is_refused_by_its_first_bytes() -> None:
    class Endless(io.RawIOBase):
        count = 0

        def read(self, size: int = -1, /) -> bytes:
            self.count += 1
            return b"x" * min(size, 3)

    stream = Endless()
    with pytest.raises(FileFormatError, match="found b'xxxx'"):
        cvtgs.load(stream)
    assert stream.count == 2


def test_text_files_and_closed_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must be open in binary mode, found text"):
        cvtgs.load(io.StringIO("ply"))  # type: ignore[arg-type]
    scene, path = storable_scene(5), tmp_path / "a.ply"
    path.write_bytes(b"ply\n\xea")
    with path.open(encoding="utf-8") as file, pytest.raises(InputError, match="found text; open"):
        cvtgs.load(file)  # type: ignore[arg-type]
    with path.open("w") as file, pytest.raises(OutputError, match=r"a\.ply: must be open for writ"):
        cvtgs.save(scene, file)  # type: ignore[arg-type]
    cvtgs.save(scene, path, overwrite=True)
    with path.open("rb") as file, pytest.raises(OutputError, match="must be open for writing"):
        cvtgs.save(scene, file)


def test_an_error_of_a_sink_is_one_of_outputs() -> None:
    for error, found in ((RuntimeError("Out of quota."), "out of quota"), (EOFError(), "EOFError")):
        with pytest.raises(OutputError, match=f"all bytes, found: {found}\\.$") as raised:
            cvtgs.save(storable_scene(5), Cut(error), format=".ply")
        assert raised.value.__cause__ is error
    with pytest.raises(MemoryError):
        cvtgs.save(storable_scene(5), Cut(MemoryError()), format=".ply")


class Cut(io.RawIOBase):
    """A connection that breaks, with an error of its own kind."""

    name = ""

    def __init__(self, error: Exception | None = None) -> None:
        self.error = error

    def write(self, _: object) -> int:
        raise self.error or EOFError

    def read(self, size: int = -1) -> bytes:
        raise EOFError("the stream ended too early")


class Narrow(io.RawIOBase):
    """Takes a few bytes at a time, as sockets with a timeout can, up to a number of them."""

    def __init__(self, room: int) -> None:
        self.taken, self.room = bytearray(), room

    def write(self, data: bytes) -> int | None:  # type: ignore[override]
        part = bytes(data[: min(1000, self.room - len(self.taken))])
        self.taken += part
        return len(part) or None


def test_raw_streams_get_all_bytes_or_an_error() -> None:
    scene, wanted, narrow = storable_scene(500), io.BytesIO(), Narrow(1 << 20)
    cvtgs.save(scene, wanted)
    cvtgs.save(scene, narrow)
    assert bytes(narrow.taken) == wanted.getvalue()
    with pytest.raises(OutputError, match="takes no more bytes without blocking"):
        cvtgs.save(scene, Narrow(5000))


def test_streams_that_break_and_closed_ones_are_refused() -> None:
    with pytest.raises(InputError, match="the Cut: must be readable to its end, found: the stream"):
        cvtgs.load(Cut())
    closed = io.BytesIO(GOOD)
    closed.close()
    with pytest.raises(InputError, match="must be readable to its end, found: I/O operation on"):
        cvtgs.load(closed)
    with pytest.raises(OutputError, match=r"in binary mode .* take all bytes, found: i/o"):
        cvtgs.save(storable_scene(5), closed)


@pytest.mark.parametrize(
    ("work", "error", "text"),
    [
        (
            lambda: cvtgs.load("a.ply", sh_degree=1.5),
            InvalidArgumentError,
            "between 0 and 3",
        ),
        (lambda: cvtgs.load("a.ply", axes=5), InvalidArgumentError, "axes must be .* found 5"),
        (lambda: cvtgs.load("a.ply", format=5), FileFormatError, "format must be a suffix .* 5"),
        (lambda: cvtgs.load("a\0b.ply"), InputNotFoundError, "must have the name of a file"),
        (lambda: cvtgs.save(storable_scene(1), None), InvalidArgumentError, "found None"),
        (lambda: cvtgs.save(storable_scene(1), "a\0b.ply"), OutputError, "found a null byte"),
    ],
)
def test_arguments_of_other_types_are_errors(work, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        work()


@pytest.mark.skipif(sys.platform != "linux", reason="limits the file size as Linux does")
def test_no_room_for_a_copy_of_a_stream_is_an_error_of_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import resource  # noqa: PLC0415 (not on Windows)

    content = io.BytesIO()
    cvtgs.save(storable_scene(5), content)
    content.seek(0)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    with pytest.raises(
        OutputError, match="folder of temporary files must be writable and have room for"
    ):
        cvtgs.load(content)
    content.seek(0)
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", list)
    with pytest.raises(OutputError, match="found: no usable temporary directory found"):
        cvtgs.load(content)
    content.seek(0)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(OutputError, match="found: file too large; TMPDIR sets another folder"):
            cvtgs.load(content)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    content.seek(0)
    assert len(cvtgs.load(content)) == 5


def test_a_level_of_a_stream_that_has_none_is_refused() -> None:
    content = io.BytesIO()
    cvtgs.save(storable_scene(5), content)
    content.seek(0)
    with pytest.raises(InvalidArgumentError, match=r"lod .* found 1 for the BytesIO"):
        cvtgs.load(content, lod=1)


def test_dropped_data_is_warned_about_for_streams() -> None:
    with pytest.warns(DroppedDataWarning, match="the BytesIO: files of this format do not hold"):
        cvtgs.save(storable_scene(5), io.BytesIO(), format=".splat")


@pytest.mark.skipif(sys.platform != "linux", reason="reads the maps of Linux")
@pytest.mark.parametrize("is_damaged", [False, True])
def test_no_copy_of_a_stream_is_mapped_when_it_is_removed(
    monkeypatch: pytest.MonkeyPatch, is_damaged: bool
) -> None:
    """Windows does not remove mapped files."""
    splats = to_dict(storable_scene(40, degree=0))
    if is_damaged:
        splats["scales"] = splats["scales"][1:].clone()
    stream, seen, remove = io.BytesIO(), list[list[str]](), shutil.rmtree
    torch.save({"splats": splats}, stream)
    stream.seek(0)

    def look(path: str, **options: Any) -> None:
        maps = Path("/proc/self/maps").read_text(encoding="utf-8")
        seen.append([line for line in maps.splitlines() if f"{path}/stream.pt" in line])
        remove(path, **options)

    monkeypatch.setattr(shutil, "rmtree", look)
    monkeypatch.setattr(tempfile, "_rmtree", look, raising=False)  # its name in some versions
    with pytest.raises(FileFormatError) if is_damaged else nullcontext():
        cvtgs.load(stream)
    assert seen == [[]]


def test_a_full_disk_behind_a_stream_is_named() -> None:
    class Full(io.RawIOBase):
        def write(self, content: Any) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match=r"must be open .* take all bytes, found: no space left"):
        cvtgs.save(storable_scene(3, degree=0), Full(), format=".ply")


def test_the_copy_of_a_stream_gets_its_name_by_a_move_that_waits_on_windows(monkeypatch):
    moved = []

    def move(source, target):
        moved.append(target.name)
        replace_file(source, target)

    monkeypatch.setattr("cvtgs.io.streams.replace_file", move)
    assert len(cvtgs.load(io.BytesIO(GOOD))) == 3
    assert moved == ["stream.ply"]
