"""Error messages about damaged COLMAP models and missing files, word for word."""

import contextlib
import os
import random
import struct
from collections.abc import Mapping
from typing import Any

import pytest

from camera_files import colmap_bin, colmap_txt, inria, write_json
from cvtgs.errors import (
    DroppedDataWarning,
    FileFormatError,
    InputError,
    InputNotFoundError,
)
from cvtgs.io import load_cameras
from format_cases import camera_refusal

CAMERAS_TXT: Mapping[str, tuple[str, str]] = {
    "few words": (
        "1 PINHOLE 64",
        "must be a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], found '1 PINHOLE 64'.",
    ),
    "few parameters": (
        "1 PINHOLE 64 48 9 9 9",
        "must be a PINHOLE camera with 4 parameters, found '1 PINHOLE 64 48 9 9 9'.",
    ),
    "no number": (
        "1 PINHOLE 64 48 9 9 9 x",
        "must be a camera with numeric fields, found '1 PINHOLE 64 48 9 9 9 x'.",
    ),
    "fisheye": (
        "1 OPENCV_FISHEYE 64 48 9 9 9 9 0 0 0 0",
        "the camera model must be one of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, "
        "FULL_OPENCV, found OPENCV_FISHEYE; use colmap image_undistorter first.",
    ),
    "infinite": (
        "1 PINHOLE 64 48 9 inf 9 9",
        "focal lengths must be above 0 and the principal point finite, "
        "found fx 9, fy inf, cx 9, cy 9.",
    ),
    "nan distortion": (
        "1 SIMPLE_RADIAL 64 48 9 9 9 nan",
        "the distortion must be finite, found nan.",
    ),
    "twice": (
        "1 PINHOLE 64 48 9 9 9 9\n1 PINHOLE 64 48 8 8 8 8",
        "each camera must have a number of its own, found 1 again.",
    ),
    "size": (
        "1 PINHOLE 64 99999999 9 9 9 9",
        "an image must have 1 to 1,048,576 pixels per side and at most 268,435,456 in all, "
        "found 64 x 99999999.",
    ),
}


@pytest.mark.parametrize("case", CAMERAS_TXT)
def test_damage_of_cameras_txt_is_one_sentence(case, tmp_path) -> None:
    colmap_txt(tmp_path)
    lines, wanted = CAMERAS_TXT[case]
    path = tmp_path / "cameras.txt"
    path.write_text(f"# a comment\n\n{lines}\n")
    number = 3 + lines.count("\n")
    assert camera_refusal(tmp_path) == f"{path}: line {number}: {wanted}"


IMAGES_TXT: Mapping[str, tuple[str, str]] = {
    "few words": (
        "1 1 0 0 0 0 0 1 7",
        "line 2: must be an image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, numeric but for "
        "the name, found '1 1 0 0 0 0 0 1 7'.",
    ),
    "no number": (
        "1 1 0 0 0 0 0 x 7 a.jpg",
        "line 2: must be an image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, numeric but for "
        "the name, found '1 1 0 0 0 0 0 x 7 a.jpg'.",
    ),
    "zero quaternion": (
        "1 0 0 0 0 0 0 5 7 a.jpg",
        "line 2: the pose must be finite with a nonzero quaternion, found 0, 0, 0, 0, 0, 0, 5.",
    ),
    "infinite": (
        "1 1 0 0 0 0 nan 5 7 a.jpg",
        "line 2: the pose must be finite with a nonzero quaternion, found 1, 0, 0, 0, 0, nan, 5.",
    ),
    "no points line": (
        "1 1 0 0 0 0 0 5 7 a.jpg\n2 1 0 0 0 0 0 5 7 b.jpg",
        "line 3: must be the points of image 'a.jpg' as X Y POINT3D_ID, or empty, "
        "found '2 1 0 0 0 0 0 5 7 b.jpg'.",
    ),
    "no points line before a name of three words": (
        "1 1 0 0 0 0 0 5 7 a.jpg\n2 1 0 0 0 0 0 5 7 00 left b.jpg",
        "line 3: must be the points of image 'a.jpg' as X Y POINT3D_ID, or empty, "
        "found '2 1 0 0 0 0 0 5 7 00 left b.jpg'.",
    ),
    "unknown camera": (
        "1 1 0 0 0 0 0 5 8 a.jpg",
        "image 'a.jpg' must refer to a camera in the camera file, found camera 8.",
    ),
}


@pytest.mark.parametrize("case", IMAGES_TXT)
def test_damage_of_images_txt_is_one_sentence(case, tmp_path) -> None:
    colmap_txt(tmp_path)
    lines, wanted = IMAGES_TXT[case]
    path = tmp_path / "images.txt"
    path.write_text(f"# a comment\n{lines}\n")
    assert camera_refusal(tmp_path) == f"{path}: {wanted}"


def packed_cameras(count: int = 1, model: int = 1, **changes: Any) -> bytes:
    numbers = changes.get("parameters", (9.0, 9.0, 9.0, 9.0))
    width = changes.get("width", 64)
    return struct.pack("<QiiQQ", count, 7, model, width, 48) + struct.pack("<4d", *numbers)


def packed_image(
    count: int = 1, name: bytes = b"a.jpg\0", points: int = 0, w: float = 1.0
) -> bytes:
    pose = struct.pack("<Qi7di", count, 1, w, 0, 0, 0, 0, 0, 5, 7)
    return pose + name + struct.pack("<Q", points)


BINARY: Mapping[str, tuple[str, bytes, str]] = {
    "empty": (
        "cameras", b"",
        "the file is cut short: the count of cameras must have 8 bytes, found 0.",
    ),
    "lying count of cameras": (
        "cameras", packed_cameras(count=1 << 60),
        "the file is cut short: 1,152,921,504,606,846,976 cameras must have "
        "27,670,116,110,564,327,424 bytes, found 56.",
    ),
    "cut camera": (
        "cameras", packed_cameras()[:-1],
        "the file is cut short: camera 0 must have 32 bytes, found 31.",
    ),
    "fisheye": (
        "cameras", packed_cameras(model=5),
        "camera 0: the camera model must be one of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, "
        "OPENCV, FULL_OPENCV, found OPENCV_FISHEYE; use colmap image_undistorter first.",
    ),
    "unknown model": (
        "cameras", packed_cameras(model=99),
        "camera 0: the camera model must be one of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, "
        "OPENCV, FULL_OPENCV, found number 99; use colmap image_undistorter first.",
    ),
    "twice": (
        "cameras", packed_cameras(count=2) + packed_cameras()[8:],
        "camera 1: each camera must have a number of its own, found 7 again.",
    ),
    "width": (
        "cameras", packed_cameras(width=1 << 63),
        "camera 0: an image must have 1 to 1,048,576 pixels per side and at most 268,435,456 in "
        "all, found 9223372036854775808 x 48.",
    ),
    "lying count of images": (
        "images", packed_image(count=9),
        "the file is cut short: 9 images must have 657 bytes, found 78.",
    ),
    "lying count of points": (
        "images", packed_image(points=(1 << 64) - 1),
        "the file is cut short: 18,446,744,073,709,551,615 points of image 0 must have "
        "442,721,857,769,029,238,760 bytes, found 0.",
    ),
    "endless name": (
        "images", packed_image(name=b"x" * 5000),
        "the name of image 0 must end within 4,096 bytes, found no end.",
    ),
    "no name": (
        "images", packed_image(name=b"\0"), "image 0: the image must have a name, found none.",
    ),
    "zero quaternion": (
        "images", packed_image(w=0.0),
        "image 0: the pose must be finite with a nonzero quaternion, "
        "found 0, 0, 0, 0, 0, 0, 5.",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BINARY)
def test_damage_of_binary_models_is_one_sentence(case, tmp_path) -> None:
    name, data, wanted = BINARY[case]
    colmap_bin(tmp_path)
    path = tmp_path / f"{name}.bin"
    path.write_bytes(data)
    assert camera_refusal(tmp_path) == f"{path}: {wanted}"


@pytest.mark.parametrize("write", [colmap_txt, colmap_bin])
def test_two_images_of_one_name_are_refused(write, tmp_path) -> None:
    write(tmp_path, rows=[0, 1, 2], names=["b.jpg", "a.jpg", "b.jpg"])
    path = tmp_path / f"images.{write.__name__[-3:]}"
    assert camera_refusal(tmp_path) == (
        f"{path}: each image must have a name of its own, by which its photograph is found, "
        "found 'b.jpg' twice; remove one of them."
    )


@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "cameras.txt", "images.txt"])
def test_random_damage_gives_cameras_or_a_format_error(name, tmp_path) -> None:
    (colmap_bin if name.endswith("bin") else colmap_txt)(tmp_path)
    path = tmp_path / name
    good = path.read_bytes()
    rng = random.Random(3)
    for _ in range(300):
        data = bytearray(good[: rng.randrange(len(good) + 1)] if rng.random() < 0.3 else good)
        for _ in range(rng.randrange(1, 4)):
            if data:
                data[rng.randrange(len(data))] = rng.randrange(256)
        path.write_bytes(data)
        with contextlib.suppress(FileFormatError):
            load_cameras(tmp_path)


def test_missing_files_are_one_sentence(tmp_path) -> None:
    assert camera_refusal(tmp_path, InputNotFoundError) == (
        f"{tmp_path}: must hold transforms.json, transforms_train.json, "
        f"transforms_test.json, a COLMAP model (in sparse/0, sparse or the folder itself) "
        f"or cameras.json, found none."
    )
    for name in ("no.json", "no"):
        assert camera_refusal(tmp_path / name, InputNotFoundError) == (
            f"{tmp_path / name}: the file to read must exist, found none."
        )
    colmap_bin(tmp_path)
    (tmp_path / "cameras.bin").unlink()
    assert camera_refusal(tmp_path, InputNotFoundError) == (
        f"{tmp_path / 'cameras.bin'}: the file to read must exist, found none."
    )
    (tmp_path / "points.ply").write_bytes(b"ply\n")
    assert camera_refusal(tmp_path / "points.ply") == (
        f"{tmp_path / 'points.ply'}: must be a .json or one of COLMAP's cameras.bin, images.bin, "
        f"cameras.txt, images.txt, found neither."
    )


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes and permissions are those of POSIX")
def test_pipes_and_unreadable_files_are_refused(tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    assert camera_refusal(tmp_path / "pipe.json", InputError) == (
        f"{tmp_path / 'pipe.json'}: must be a regular file, found a device or a pipe."
    )
    if os.geteuid() == 0:
        pytest.skip("root may read everything")
    path = write_json(tmp_path / "cameras.json", inria())
    path.chmod(0)
    assert camera_refusal(path, InputError) == (
        f"{path}: the file must be readable, found: permission denied."
    )


def test_reading_changes_no_file(tmp_path) -> None:
    colmap_bin(tmp_path, model="RADIAL", parameters=[50, 32, 24, 0.1, 0])
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.warns(DroppedDataWarning):
        load_cameras(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
