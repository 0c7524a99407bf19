"""Finding and opening the file of a scene: bad paths, model folders, open files and pipes."""

import importlib
import json
import os
import shutil
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from cvtgs import describe, load, load_cameras, save, to_dict
from cvtgs.boxes import read_boxes
from cvtgs.cli.main import main
from cvtgs.errors import (
    DroppedDataWarning,
    FileFormatError,
    InputError,
    InputNotFoundError,
    InvalidArgumentError,
    OutputError,
)
from cvtgs.io import change_axes, check_output, check_save, losses, scene_file, scene_size
from cvtgs.io.files import Document, _sentence
from cvtgs.rendering import blending_weights, contributions, observe
from cvtgs.views import find_own_cameras
from format_cases import DATA
from ply_files import gaussian_properties, gaussian_rows, ply_bytes
from render_cases import one_camera
from scenes import random_scene

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
        f"{path}: must be the file itself, found a Git LFS pointer; run: git lfs pull."
    )


@pytest.mark.parametrize("name", ["folder", "folder.ply"])
def test_a_directory_without_a_scene_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.mkdir()
    with pytest.raises(InputError) as caught:
        load(path)
    assert str(caught.value) == (
        f"{path}: must be a file or the folder of a trained model, found a directory without "
        f"point_cloud/iteration_*/point_cloud.ply, step-*.ckpt, ckpt_*_rank0.pt, "
        f"point_cloud.ply, lod-meta.json or meta.json."
    )


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "pipe.ply"
    os.mkfifo(path)
    for read in (load, scene_size):
        with pytest.raises(InputError) as caught:
            read(path)
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
        f"{path}: the name must end in .compressed.ply, .ply, .spz, .ksplat, .splat, .sog, "
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


@pytest.mark.parametrize(
    ("folder", "name"),
    [("nerfstudio_models", "step-{:09}.ckpt"), ("ckpts", "ckpt_{}_rank0.pt")],
    ids=["nerfstudio", "gsplat"],
)
def test_the_last_step_of_a_run_is_read(tmp_path: Path, folder: str, name: str) -> None:
    steps = tmp_path / folder
    steps.mkdir()
    for step, count in ((999, 3), (29999, 5)):
        state = {"step": step, "splats": to_dict(random_scene(count))}
        torch.save(state, steps / name.format(step))
    assert len(load(tmp_path)) == len(load(steps)) == 5


def test_a_checkpoint_of_inrias_code_names_what_is_read(tmp_path: Path) -> None:
    (tmp_path / "chkpnt30000.pth").write_bytes(b"")
    with pytest.raises(FileFormatError, match=r"suffix '\.pth'; of a model .* point_cloud\.ply\.$"):
        load(tmp_path / "chkpnt30000.pth")


def test_point_cloud_ply_in_a_folder_is_read(tmp_path: Path) -> None:
    shutil.copy(DATA / "source.ply", tmp_path / "point_cloud.ply")
    assert len(load(tmp_path)) == 40
    with pytest.raises(InputError, match="found a directory without"):
        load(tmp_path.parent / tmp_path.name / "..")


def test_the_size_of_an_unbundled_sog_includes_its_images(tmp_path: Path) -> None:
    shutil.unpack_archive(DATA / "splat-transform.sog", tmp_path, "zip")
    size = sum(file.stat().st_size for file in tmp_path.iterdir())
    assert scene_size(tmp_path) == size
    (tmp_path / "preview.webp").write_bytes(bytes(1000))  # which meta.json does not name
    assert scene_size(tmp_path) == scene_size(tmp_path / "meta.json") == size


@pytest.mark.parametrize("text", ["[]", "{", '{"means": {"files": 3}}', '{"sh0": {"files": [3]}}'])
def test_the_size_of_a_damaged_sog_is_that_of_its_file(tmp_path: Path, text: str) -> None:
    (tmp_path / "meta.json").write_text(text)
    assert scene_size(tmp_path) == len(text)


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
    assert str(caught.value) == f"{tmp_path}: the file must be readable, found: permission denied."


def test_the_size_of_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputNotFoundError, match=r"no\.ply: the file to read must exist, found"):
        scene_size(tmp_path / "no.ply")


def kinds_of_documents() -> list[type[Document]]:
    for name in ("gltf.read", "sog.read", "sog.stream", "transforms"):
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


@pytest.mark.parametrize(
    "call",
    [
        scene_file,
        check_save,
        check_output,
        load_cameras,
        read_boxes,
        lambda path: losses(random_scene(2), path),
        lambda path: find_own_cameras(random_scene(2), path),
    ],
)
def test_other_values_than_paths_are_refused(call: Callable[[Any], object]) -> None:
    with pytest.raises(InvalidArgumentError, match="a path must be a str or Path, found NoneType"):
        call(None)


@pytest.mark.parametrize(
    "call",
    [
        to_dict,
        lambda scene: losses(scene, "a.sog"),
        lambda scene: save(scene, "a.ply"),
        lambda scene: change_axes(scene, "rdf", "rub"),
        lambda scene: contributions(scene, one_camera(4, 4)),
        lambda scene: observe(scene, one_camera(4, 4)),
        lambda scene: blending_weights(scene, one_camera(4, 4)),
    ],
)
@pytest.mark.parametrize("value", [None, {}, "scene.ply"])
def test_other_values_than_scenes_are_refused(call: Callable[[Any], object], value: object) -> None:
    with pytest.raises(InvalidArgumentError, match="scene must be a GaussianScene, found"):
        call(value)


def test_folders_and_versions_of_other_formats_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="must be a file, found a directory"):
        save(random_scene(2), f"{tmp_path}/new.ply/")
    with pytest.raises(InvalidArgumentError, match=r"spz_version needs an \.spz to write, found"):
        save(random_scene(2), tmp_path / "a.ply", spz_version=2)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name == "nt", reason="names of files are UTF-16 there")
@pytest.mark.parametrize("name", ["a\ud800", "a\0"])
def test_names_that_no_file_can_have_are_refused(name: str) -> None:
    for read, suffix in ((load, ".ply"), (load_cameras, ".json")):
        with pytest.raises(InputNotFoundError):
            read(f"{name}{suffix}")
    with pytest.raises(OutputError, match=r"the output must have a valid name"):
        save(random_scene(2), f"{name}.ply")


def test_paths_of_bytes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.ply").touch()
    with os.scandir(os.fsencode(tmp_path)) as entries:
        entry = next(entries)
    for call in (load, describe, partial(save, random_scene(2))):
        with pytest.raises(InvalidArgumentError, match="must be a str or Path, found one of bytes"):
            call(entry)


@pytest.mark.skipif(os.name == "nt", reason="Windows keeps the working directory")
def test_a_deleted_working_directory_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    with pytest.raises(OutputError, match=r"a\.ply: the output must be writable, found: no such"):
        save(random_scene(2), "a.ply")


def test_names_cannot_add_lines_to_messages(tmp_path: Path) -> None:
    with pytest.raises(InputNotFoundError) as caught:
        load(tmp_path / "a\nb\x1b[2J.ply")
    assert str(caught.value).endswith(
        r"a\nb\u001b[2J.ply: the file to read must exist, found none."
    )
    assert caught.value.filename.endswith("a\nb\x1b[2J.ply")


@pytest.mark.parametrize("suffix", ["spz", "splat", "glb", "compressed.ply", "sog", "usda"])
def test_values_that_a_format_cannot_hold_are_written_without_warnings_of_numpy(
    tmp_path: Path, suffix: str
) -> None:
    scene = random_scene(9, degree=1)
    large = {"sh0": scene.sh0 * 1e38, "shN": scene.shN * 1e38, "log_scales": scene.log_scales + 80}
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", DroppedDataWarning)
        save(scene.with_tensors(large, {}), tmp_path / f"a.{suffix}")
