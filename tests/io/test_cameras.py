"""Camera files of every format, compared with one hand-made rig of cameras."""

import json
import locale
import math
import os
import struct
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from camera_files import (
    CENTERS,
    NAMES,
    POINT,
    SIZE,
    colmap_bin,
    colmap_txt,
    expected_pixels,
    inria,
    poses,
    transforms,
    write_json,
)
from cvtgs.cameras import Cameras
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError
from cvtgs.io import load_cameras

WRITERS = {
    "transforms": lambda folder: write_json(folder / "transforms.json", transforms()),
    "cameras.json": lambda folder: write_json(folder / "cameras.json", inria()),
    "colmap bin": lambda folder: colmap_bin(folder / "sparse" / "0"),
    "colmap txt": lambda folder: colmap_txt(folder / "sparse" / "0"),
}
each_format = pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)


def pixels(cameras: Cameras, point: np.ndarray = POINT) -> np.ndarray:
    """Project a world point by the definition of Cameras."""
    world = torch.tensor([*point, 1.0], dtype=torch.float64)
    seen = (cameras.viewmats.double() @ world)[:, :3]
    images = (cameras.Ks.double() @ seen[:, :, None])[:, :, 0]
    return (images[:, :2] / images[:, 2:]).numpy()


@each_format
def test_a_known_point_projects_to_the_expected_pixel(write, tmp_path) -> None:
    write(tmp_path)
    cameras = load_cameras(tmp_path)
    assert (cameras.width, cameras.height) == SIZE
    assert cameras.names == NAMES
    assert cameras.viewmats.dtype == cameras.Ks.dtype == torch.float64
    np.testing.assert_allclose(pixels(cameras), expected_pixels(), atol=1e-3)
    np.testing.assert_allclose(cameras.centers, CENTERS, atol=1e-5)
    rotations = cameras.viewmats[:, :3, :3].double()
    torch.testing.assert_close(rotations.det(), torch.ones(len(NAMES)).double())


def test_the_numbers_of_one_camera_are_as_computed_by_hand(tmp_path) -> None:
    """At (1, 2, 5), looking along -z as OpenGL cameras do: up in the world is up in the image."""
    frame = {
        "file_path": "a.png",
        "transform_matrix": [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 5], [0, 0, 0, 1]],
    }
    document = {"w": 80, "h": 60, "fl_x": 100.0, "cx": 41.0, "frames": [frame]}
    cameras = load_cameras(write_json(tmp_path / "transforms.json", document))
    assert cameras.viewmats[0].tolist() == [
        [1, 0, 0, -1],
        [0, -1, 0, 2],
        [0, 0, -1, 5],
        [0, 0, 0, 1],
    ]
    assert cameras.Ks[0].tolist() == [[100, 0, 41], [0, 100, 30], [0, 0, 1]]
    np.testing.assert_allclose(pixels(cameras, np.array([2.0, 3.0, 1.0])), [[66.0, 5.0]])


@each_format
def test_every_eighth_camera_by_name_is_a_test_camera(write, tmp_path) -> None:
    write(tmp_path)
    test, train = (load_cameras(tmp_path, split=split) for split in ("test", "train"))
    by_name = sorted(NAMES)
    assert sorted(test.names) == by_name[::8]
    assert sorted(train.names) == [name for name in by_name if name not in by_name[::8]]
    assert list(train.names) == [name for name in NAMES if name in train.names]


@pytest.mark.parametrize("place", ["sparse/0", "sparse", ".", "0"])
@pytest.mark.parametrize("write", [colmap_bin, colmap_txt])
def test_a_colmap_model_is_found_in_every_place(write, place, tmp_path) -> None:
    write(tmp_path / place)
    assert len(load_cameras(tmp_path)) == len(NAMES)
    for file in (tmp_path / place).iterdir():
        assert load_cameras(str(file)).names == NAMES


def test_the_formats_in_a_folder_are_tried_in_order(tmp_path) -> None:
    write_json(tmp_path / "cameras.json", inria()[:1])
    assert len(load_cameras(tmp_path)) == 1
    colmap_txt(tmp_path / "sparse", rows=range(2))
    assert len(load_cameras(tmp_path)) == 2
    colmap_bin(tmp_path / "sparse", rows=range(3))
    assert len(load_cameras(tmp_path)) == 3
    colmap_txt(tmp_path / "sparse" / "0", rows=range(4))
    assert len(load_cameras(tmp_path)) == 4
    write_json(tmp_path / "transforms_test.json", transforms(rows=range(5)))
    assert len(load_cameras(tmp_path)) == 5
    write_json(tmp_path / "transforms.json", transforms(rows=range(6)))
    assert len(load_cameras(tmp_path)) == 6
    assert len(load_cameras(tmp_path / "cameras.json")) == 1


def test_blender_scenes_have_one_file_per_split_and_png_sizes(tmp_path) -> None:
    """The scenes of NeRF: one angle, no image size, names without suffix."""
    angle = 2 * math.atan(0.5)
    for split, rows in (("train", range(3)), ("test", range(3, 5))):
        document = transforms(rows=rows)
        frames = [
            {"file_path": f"./{split}/r_{row}", "transform_matrix": frame["transform_matrix"]}
            for row, frame in enumerate(document["frames"])
        ]
        write_json(
            tmp_path / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames}
        )
        (tmp_path / split).mkdir()
        for row in range(len(rows)):
            png(tmp_path / split / f"r_{row}.png", 48, 32)
    cameras = load_cameras(tmp_path)
    assert cameras.names == (
        "./train/r_0", "./train/r_1", "./train/r_2", "./test/r_0", "./test/r_1"
    )  # fmt: skip
    assert (cameras.width, cameras.height) == (48, 32)
    np.testing.assert_allclose(cameras.Ks[4], [[48, 0, 24], [0, 48, 16], [0, 0, 1]], rtol=1e-6)
    assert load_cameras(tmp_path, split="train").names == cameras.names[:3]
    assert load_cameras(tmp_path, split="test").names == cameras.names[3:]
    assert load_cameras(tmp_path / "transforms_test.json").names == cameras.names[3:]
    assert load_cameras(tmp_path / "transforms_test.json", split="test").names == cameras.names[3:]
    with pytest.raises(InvalidArgumentError) as error:
        load_cameras(tmp_path / "transforms_test.json", split="train")
    assert str(error.value) == (
        f"{tmp_path / 'transforms_test.json'}: the split of this file must be 'test', found "
        f"'train'; give the folder to read both splits."
    )


def test_paths_of_windows_lead_to_the_sizes_of_images(tmp_path) -> None:
    (frame,) = transforms(rows=[0])["frames"]
    frame = {"file_path": ".\\train\\r_0", "transform_matrix": frame["transform_matrix"]}
    write_json(tmp_path / "transforms.json", {"camera_angle_x": 1.0, "frames": [frame]})
    (tmp_path / "train").mkdir()
    png(tmp_path / "train" / "r_0.png", 48, 32)
    assert load_cameras(tmp_path).width == 48


def png(path: Path, width: int, height: int) -> None:
    header = struct.pack(">I4sIIBBBBB", 13, b"IHDR", width, height, 8, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header)


def test_the_splits_listed_by_nerfstudio_are_used(tmp_path) -> None:
    document = transforms()
    document["train_filenames"] = [NAMES[3], NAMES[1]]
    document["test_filenames"] = [f"./{NAMES[2]}"]
    path = write_json(tmp_path / "transforms.json", document)
    assert load_cameras(path, split="train").names == (NAMES[1], NAMES[3])
    assert load_cameras(path, split="test").names == (NAMES[2],)
    assert load_cameras(path).names == NAMES


FRAME: Mapping[str, Any] = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
INTRINSICS = {
    "whole numbers as floats": (
        {"w": 80.0, "h": 60.0, "fl_x": 70, "fl_y": 71, "cx": 39, "cy": 31}, {},
        [[70, 0, 39], [0, 71, 31], [0, 0, 1]],
    ),
    "the frame before the file": (
        {"w": 1, "h": 60, "fl_x": 70, "fl_y": 72, "camera_angle_y": 1.0},
        {"w": 80, "camera_angle_x": math.pi / 2, "cy": 29.5},
        [[40, 0, 40], [0, 72, 29.5], [0, 0, 1]],
    ),
    "a focal length before an angle": (
        {"w": 80, "h": 60, "fl_x": 70, "camera_angle_x": 1.0}, {},
        [[70, 0, 40], [0, 70, 30], [0, 0, 1]],
    ),
    "two angles": (
        {"w": 80, "h": 60, "camera_angle_x": math.pi / 2, "camera_angle_y": math.pi / 2}, {},
        [[40, 0, 40], [0, 30, 30], [0, 0, 1]],
    ),
    "only y, and null": (
        {"w": 80, "h": 60, "fl_y": 50, "cx": None}, {"fl_x": None},
        [[50, 0, 40], [0, 50, 30], [0, 0, 1]],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", INTRINSICS)
def test_intrinsics_of_transforms_json_are_read(case, tmp_path) -> None:
    everything, own, wanted = INTRINSICS[case]
    document = {**everything, "frames": [{**FRAME, **own}]}
    cameras = load_cameras(write_json(tmp_path / "any_name.json", document))
    assert (cameras.width, cameras.height) == (80, 60)
    np.testing.assert_allclose(cameras.Ks[0], wanted, rtol=1e-6)


def test_mixed_image_sizes_become_the_most_frequent_one(tmp_path) -> None:
    frames = [dict(frame) for frame in transforms(rows=range(3))["frames"]]
    document = {**transforms(), "frames": frames}
    width, height = SIZE
    frames[0] |= {"w": 2 * width, "h": 4 * height, "fl_x": 120.0, "fl_y": 80.0}
    frames[0] |= {"cx": 100.0, "cy": 10.0}
    cameras = load_cameras(write_json(tmp_path / "transforms.json", document))
    assert (cameras.width, cameras.height) == SIZE
    assert cameras.Ks[0].tolist() == [[60, 0, 50], [0, 20, 2.5], [0, 0, 1]]
    assert torch.equal(cameras.Ks[1], load_cameras(tmp_path, split="train").Ks[0])


def test_rounded_rotations_are_made_orthogonal(tmp_path) -> None:
    document = transforms()
    for frame in document["frames"]:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 3).tolist()
    cameras = load_cameras(write_json(tmp_path / "transforms.json", document))
    rotations = cameras.viewmats[:, :3, :3]
    wanted = torch.eye(3, dtype=rotations.dtype).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.mT, wanted, atol=1e-6, rtol=0)
    np.testing.assert_allclose(pixels(cameras), expected_pixels(), atol=0.2)


def test_poses_of_three_rows_and_a_byte_order_mark_are_read(tmp_path) -> None:
    document = transforms()
    for frame in document["frames"]:
        frame["transform_matrix"] = frame["transform_matrix"][:3]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(document), encoding="utf-8-sig")
    np.testing.assert_allclose(pixels(load_cameras(path)), expected_pixels(), atol=1e-3)


DISTORTION = "left out the lens distortion of {} of {} cameras, since rendering uses "
DISTORTION += "pinhole cameras; compare with undistorted photographs."


@pytest.mark.parametrize(
    ("model", "parameters", "wanted"),
    [
        ("SIMPLE_PINHOLE", [50, 31, 23], (50, 50)),
        ("PINHOLE", [50, 51, 31, 23], (50, 51)),
        ("SIMPLE_RADIAL", [50, 31, 23, 0.1], (50, 50)),
        ("RADIAL", [50, 31, 23, 0.0, -0.1], (50, 50)),
        ("OPENCV", [50, 51, 31, 23, 0, 0, 0, 0.1], (50, 51)),
        ("FULL_OPENCV", [50, 51, 31, 23, 0, 0, 0, 0, 0.1, 0, 0, 0], (50, 51)),
    ],
)
@pytest.mark.parametrize("write", [colmap_bin, colmap_txt])
def test_the_pinhole_part_of_every_colmap_model_is_read(
    write, model, parameters, wanted, tmp_path
) -> None:
    write(tmp_path, model=model, parameters=parameters)
    distorted = any(parameters[4 if wanted[1] == 51 else 3 :])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cameras = load_cameras(tmp_path)
    fx, fy = wanted
    assert cameras.Ks[0].tolist() == [[fx, 0, 31], [0, fy, 23], [0, 0, 1]]
    texts = [str(warning.message) for warning in caught]
    count = len(NAMES)
    assert texts == ([f"{tmp_path}: {DISTORTION.format(count, count)}"] if distorted else [])
    assert all(warning.category is DroppedDataWarning for warning in caught)
    assert all(warning.filename == __file__ for warning in caught)


def test_zero_distortion_gives_no_warning(tmp_path) -> None:
    colmap_bin(tmp_path / "a", model="OPENCV", parameters=[50, 51, 31, 23, 0, 0, 0, 0])
    document = {**transforms(), "k1": 0.0, "p2": 0, "camera_model": "OPENCV", "is_fisheye": False}
    write_json(tmp_path / "b" / "transforms.json", document)
    assert len(load_cameras(tmp_path / "a")) == len(load_cameras(tmp_path / "b"))


@pytest.mark.parametrize(
    "given",
    [
        *({name: -0.01} for name in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")),
        {"distortion_params": [0, 0.01, 0, 0, 0, 0]},
    ],
)
def test_distortion_in_transforms_json_is_warned_about(given, tmp_path) -> None:
    document = {**transforms(), "distortion_params": [0.0] * 6}
    document["frames"][2] |= given
    path = write_json(tmp_path / "transforms.json", document)
    with pytest.warns(DroppedDataWarning) as caught:
        load_cameras(path)
    (warning,) = caught
    assert str(warning.message) == f"{path}: {DISTORTION.format(1, len(NAMES))}"


def test_a_colmap_model_with_byte_order_marks_is_read(tmp_path) -> None:
    colmap_txt(tmp_path, rows=range(2))
    plain = load_cameras(tmp_path)
    for name in ("cameras.txt", "images.txt"):
        file = tmp_path / name
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    marked = load_cameras(tmp_path)
    assert marked.names == plain.names
    assert torch.equal(marked.Ks, plain.Ks)


def test_text_files_that_are_asked_for_are_read_beside_binary_ones(tmp_path) -> None:
    colmap_txt(tmp_path, rows=range(2), names=["text a.jpg", "text b.jpg"])
    colmap_bin(tmp_path, rows=range(2), names=["binary a.jpg", "binary b.jpg"])
    for name in ("images.txt", "cameras.txt"):
        assert load_cameras(tmp_path / name).names == ("text a.jpg", "text b.jpg")
    for path in (tmp_path, tmp_path / "images.bin"):
        assert load_cameras(path).names == ("binary a.jpg", "binary b.jpg")


def test_text_models_with_spaces_in_names_and_points_are_read(tmp_path) -> None:
    colmap_txt(tmp_path, rows=range(2), names=["b c.jpg", "a  d.jpg"], points="1 2 3 4.5 5 -1")
    assert load_cameras(tmp_path).names == ("a  d.jpg", "b c.jpg")


def test_binary_models_with_long_names_and_points_are_read(tmp_path) -> None:
    names = ["ä/b c.jpg", "x" * 3000]
    colmap_bin(tmp_path, rows=range(2), names=names, points=1000)
    assert load_cameras(tmp_path).names == tuple(sorted(names))


@pytest.mark.parametrize("write", [colmap_txt, colmap_bin])
def test_names_in_the_other_encoding_of_windows_are_read(tmp_path, monkeypatch, write) -> None:
    write(tmp_path, rows=range(2), names=["a.jpg", "K~che.jpg"])
    path = next(tmp_path.glob("images.*"))
    path.write_bytes(path.read_bytes().replace(b"~", b"\xfc"))
    monkeypatch.setattr(os, "fsdecode", lambda name: name.decode("utf-8", "surrogatepass"))
    monkeypatch.setattr(locale, "getencoding", lambda: "cp1252")
    assert load_cameras(tmp_path).names == ("Küche.jpg", "a.jpg")


def test_quaternions_are_normalised(tmp_path) -> None:
    colmap_txt(tmp_path, scale=-2.5)
    np.testing.assert_allclose(pixels(load_cameras(tmp_path)), expected_pixels(), atol=1e-3)


def test_the_oracle_projects_the_point_into_every_image() -> None:
    for (x, y), (rotation, center) in zip(expected_pixels(), poses(), strict=True):
        assert 0 < x < SIZE[0]
        assert 0 < y < SIZE[1]
        assert (rotation.T @ (POINT - center))[2] > 0
