"""Finding and opening the file of a scene: bad paths, model folders, open files and pipes."""

import importlib
import io
import json
import os
import shutil
import sys
import tempfile
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import cvtgs
from cvtgs import load, load_cameras, save, to_dict
from cvtgs.cli.main import main
from cvtgs.errors import (
    DroppedDataWarning,
    FileFormatError,
    InputError,
    InputNotFoundError,
    InvalidArgumentError,
    OutputError,
)
from cvtgs.io import losses, scene_file, scene_size
from cvtgs.io.files import Document, _sentence
from format_cases import DATA, storable_scene
from ply_files import gaussian_properties, gaussian_rows, ply_bytes
from scenes import random_scene, same_bits

GOOD = ply_bytes(gaussian_properties(), gaussian_rows(gaussian_properties(), 3))


def test_a_missing_file_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "none.ply"
    with pytest.raises(InputNotFoundError) as caught:
        load(path)
    assert str(caught.value) == f"{path}: the file to read must exist, found none."
    assert isinstance(caught.value, FileNotFoundError)


@pytest.mark.parametrize("end", ["ply", "compressed.ply", "spz", "splat", "sog", "ckpt", "pt"])
def test_a_git_lfs_pointer_is_refused(tmp_path: Path, end: str) -> None:
    path = tmp_path / f"scene.{end}"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: must be the file itself, found a Git LFS pointer to it; fetch the file with: "
        f"git lfs pull."
    )


@pytest.mark.parametrize("name", ["folder", "folder.ply"])
def test_a_directory_without_a_scene_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.mkdir()
    with pytest.raises(InputError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: must be a file or the folder of a trained model, found a directory without "
        f"point_cloud/iteration_*/point_cloud.ply, step-*.ckpt, point_cloud.ply, lod-meta.json "
        f"or meta.json."
    )


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "pipe.ply"
    os.mkfifo(path)
    with pytest.raises(InputError) as caught:
        load(path)
    assert str(caught.value) == f"{path}: must be a regular file, found a device or a pipe."


def test_an_unreadable_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "s.ply"
    path.write_bytes(GOOD)

    def refuse(*args: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputError) as caught:
        load(path)
    assert str(caught.value) == f"{path}: the file must be readable, found: permission denied."


@pytest.mark.parametrize(("name", "found"), [("s.xyz", "the suffix '.xyz'"), ("s", "no suffix")])
def test_an_unknown_suffix_is_refused(tmp_path: Path, name: str, found: str) -> None:
    path = tmp_path / name
    path.write_bytes(GOOD)
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: the file name must end in .compressed.ply, .ply, .spz, .ksplat, .splat, .sog, "
        f"lod-meta.json, meta.json, .glb, .gltf, .ckpt or .pt, found {found}."
    )


def test_the_case_of_suffixes_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "S.PLY"
    path.write_bytes(GOOD)
    assert len(load(path)) == 3


def inria_model(folder: Path, iterations: tuple[int, ...] = (7000, 30000)) -> Path:
    """Write a model as INRIA's code does, with as many Gaussians as thousands of iterations."""
    for iteration in iterations:
        part = folder / "point_cloud" / f"iteration_{iteration}"
        part.mkdir(parents=True)
        save(random_scene(iteration // 1000, degree=1), part / "point_cloud.ply")
    cameras = [
        {
            "id": i, "img_name": f"{i:05}", "width": 64, "height": 48, "fx": 60.0, "fy": 60.0,
            "position": [0.0, 0.0, -4.0 - i], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        }
        for i in range(12)
    ]  # fmt: skip
    (folder / "cameras.json").write_text(json.dumps(cameras))
    (folder / "cfg_args").write_text("Namespace()")
    return folder


def test_the_largest_iteration_of_a_model_is_read(tmp_path: Path) -> None:
    model = inria_model(tmp_path / "model", (7000, 30000, 9000))
    assert scene_file(model) == model / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    assert len(load(model)) == 30
    assert scene_size(model) == scene_file(model).stat().st_size
    shutil.rmtree(model / "point_cloud" / "iteration_30000")
    (model / "point_cloud" / "iteration_30000").mkdir()  # training was stopped while it saved
    (model / "point_cloud" / "iteration_last").mkdir()
    assert len(load(model)) == 9


def test_the_cameras_of_a_model_folder_are_found(tmp_path: Path) -> None:
    assert len(load_cameras(inria_model(tmp_path))) == 12


def test_the_last_step_of_a_splatfacto_run_is_read(tmp_path: Path) -> None:
    steps = tmp_path / "nerfstudio_models"
    steps.mkdir()
    for step, count in ((999, 3), (29999, 5)):
        state = {"step": step, "splats": to_dict(random_scene(count))}
        torch.save(state, steps / f"step-{step:09}.ckpt")
    assert len(load(tmp_path)) == len(load(steps)) == 5


def test_point_cloud_ply_in_a_folder_is_read(tmp_path: Path) -> None:
    shutil.copy(DATA / "source.ply", tmp_path / "point_cloud.ply")
    assert len(load(tmp_path)) == 40
    with pytest.raises(InputError, match="found a directory without"):
        load(tmp_path.parent / tmp_path.name / "..")


def test_the_size_of_an_unbundled_sog_includes_its_images(tmp_path: Path) -> None:
    shutil.unpack_archive(DATA / "splat-transform.sog", tmp_path, "zip")
    assert scene_size(tmp_path) == sum(file.stat().st_size for file in tmp_path.iterdir())


def test_commands_accept_a_model_folder_and_its_cameras(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, small = inria_model(tmp_path / "model"), tmp_path / "small.spz"
    assert main(["simplify", str(model), str(small), "--count", "20", "--ckpt", "none"]) == 0
    assert "30 -> 20 Gaussians" in capsys.readouterr().out
    assert main(["info", str(model)]) == 0
    assert "Gaussians        30" in capsys.readouterr().out
    words = [
        str(model),
        str(small),
        "--size",
        "32",
        "--lpips",
        "off",
        "--json",
        "--backend",
        "torch",
    ]
    assert main(["evaluate", *words]) == 0
    views = json.loads(capsys.readouterr().out)["views"]
    assert views == ["00000", "00001", "00003", "00004", "00006", "00007", "00009", "00010"]
    assert main(["evaluate", *words, "--cameras", str(model), "--views", "2"]) == 0
    assert json.loads(capsys.readouterr().out)["views"] == ["00000", "00006"]
    assert main(["evaluate", *words, "--views", "1"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["views"], found["width"], found["height"]) == (["00000"], 32, 24)


def test_an_unreadable_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(folder: Path) -> Iterator[Path]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("cvtgs.io.files._scenes", refuse)
    with pytest.raises(InputError) as caught:
        scene_file(tmp_path)
    assert (
        str(caught.value) == f"{tmp_path}: the folder must be readable, found: permission denied."
    )


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
    before = warnings.showwarning
    gltf = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": 9, "uri": "no.bin"}]}
    cvtgs.save(storable_scene(5, degree=0), tmp_path / "a.gltf")
    document = json.loads((tmp_path / "a.gltf").read_text())
    document["buffers"] = gltf["buffers"]
    with pytest.raises(InputNotFoundError, match=r"^no\.bin: the file to read must exist"):
        cvtgs.load(io.BytesIO(json.dumps(document).encode()), format=".gltf")
    assert warnings.showwarning is before


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
        assert torch.allclose(found, log_scales.clamp(-87.3, 88.7), atol=1e-4)


def test_the_size_of_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputNotFoundError, match=r"no\.ply: the file to read must exist, found"):
        scene_size(tmp_path / "no.ply")


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
        (b"", FileFormatError, "the first bytes must be those of a .ply, .spz, .sog, .glb or .pt"),
        (b"what?", FileFormatError, "found b'what'; give format= for other formats"),
        (b"ply\nnonsense", FileFormatError, "the BytesIO: the PLY header must end"),
        (b"PK\x03\x04nonsense", FileFormatError, "the BytesIO: a .sog file must be a zip"),
    ],
)
def test_damaged_streams_are_refused(content: bytes, error: type[Exception], text: str) -> None:
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
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", list)
    with pytest.raises(OutputError, match="found: no usable temporary directory found"):
        cvtgs.load(content)
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


def kinds_of_documents() -> list[type[Document]]:
    for name in ("gltf.read", "sog.read", "sog.stream", "cameras.transforms"):
        importlib.import_module(f"cvtgs.io.{name}")
    found = [Document]
    for kind in found:
        found += kind.__subclasses__()
    return [kind for kind in found if kind.__module__.startswith("cvtgs.")]


@pytest.mark.parametrize("kind", kinds_of_documents(), ids=lambda kind: kind.__name__)
def test_every_key_of_a_document_has_an_error_message(kind: type[Document]) -> None:
    for key, field in kind.model_fields.items():
        if field.annotation is not Any:
            text = _sentence(kind, {key: 0.5}, [key], "file")
            assert text.startswith(f"file: '{key}'")
            assert " must be " in text
