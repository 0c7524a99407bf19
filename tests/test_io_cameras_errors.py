"""What damaged camera files get: one sentence, word for word."""

import contextlib
import copy
import math
import os
import random
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from camera_files import colmap_bin, colmap_txt, inria, transforms, write_json
from cvtgs.errors import (
    CvtgsError,
    DroppedDataWarning,
    FileFormatError,
    InputError,
    InputNotFoundError,
    InvalidArgumentError,
)
from cvtgs.io import load_cameras


def text_of(path: Path, error: type[CvtgsError] = FileFormatError, **arguments: Any) -> str:
    with pytest.raises(error) as caught:
        load_cameras(path, **arguments)
    assert type(caught.value) is error
    return str(caught.value)


def put(*keys: Any, value: Any) -> Callable[[Any], None]:
    def change(document: Any) -> None:
        for key in keys[:-1]:
            document = document[key]
        document[keys[-1]] = value

    return change


def drop(*keys: Any) -> Callable[[Any], None]:
    def change(document: Any) -> None:
        for key in keys[:-1]:
            document = document[key]
        del document[keys[-1]]

    return change


BIGGER = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
MIRROR = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
BY_COLUMNS = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [3, 4, 5, 1]]
MATRIX = "frame 2: 'transform_matrix' must be 4 x 4 or 3 x 4 finite numbers, found "

TRANSFORMS: Mapping[str, tuple[Callable[[Any], None], str]] = {
    "frames": (put("frames", value=3), " 'frames' must be a list, found 3."),
    "frame": (put("frames", 1, value="x"), " frame 1: must be a JSON object, found 'x'."),
    "no pose": (drop("frames", 2, "transform_matrix"), f" {MATRIX}none."),
    "ragged pose": (put("frames", 2, "transform_matrix", value=[[1]]), f" {MATRIX}[[1]]."),
    "infinite pose": (
        put("frames", 2, "transform_matrix", 0, 0, value=math.inf),
        f" {MATRIX}[[inf, ",
    ),
    "boolean pose": (put("frames", 2, "transform_matrix", 0, 0, value=True), f" {MATRIX}[[True, "),
    "scaled pose": (
        put("frames", 2, "transform_matrix", value=BIGGER),
        " frame 2: the pose must hold a rotation without scale or mirror, "
        "found a matrix of determinant 8 that is 3 away from one.",
    ),
    "mirrored pose": (
        put("frames", 2, "transform_matrix", value=MIRROR),
        " frame 2: the pose must hold a rotation without scale or mirror, "
        "found a matrix of determinant -1 that is 0 away from one.",
    ),
    "pose by columns": (
        put("frames", 2, "transform_matrix", value=BY_COLUMNS),
        " frame 2: 'transform_matrix' must be a pose in rows, with 0 0 0 1 as the last, found "
        "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [3, 4, 5, 1]].",
    ),
    "no name": (
        drop("frames", 0, "file_path"),
        " frame 0: 'file_path' must be a text, found none.",
    ),
    "no focal length": (
        lambda document: [document.pop(key) for key in ("fl_x", "fl_y")],
        " frame 0: 'fl_x', 'fl_y', 'camera_angle_x' or 'camera_angle_y' must be given here or "
        "for the whole file, found none.",
    ),
    "text for a number": (put("fl_x", value="9"), " 'fl_x' must be a finite number, found '9'."),
    "huge number": (
        put("frames", 1, "cx", value=10**400),
        " frame 1: 'cx' must be a finite number",
    ),
    "half a pixel": (put("w", value=64.5), " 'w' must be a whole number, found 64.5."),
    "no pixel": (
        put("frames", 3, "w", value=0),
        " frame 3: the image size must be from 1 to 1,048,576 pixels, found 0 x 48.",
    ),
    "focal length below 0": (
        put("frames", 3, "fl_x", value=-5),
        " frame 3: focal lengths must be above 0 and the principal point finite, "
        "found fx -5, fy 50, cx 32, cy 24.",
    ),
    "wide angle": (
        lambda document: document.pop("fl_x") and put("camera_angle_x", value=3.2)(document),
        " 'camera_angle_x' must be an angle between 0 and pi, found 3.2.",
    ),
    "fisheye": (
        put("camera_model", value="OPENCV_FISHEYE"),
        " 'camera_model' must be one of PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, "
        "FULL_OPENCV, PERSPECTIVE, found 'OPENCV_FISHEYE'.",
    ),
    "no frames": (put("frames", value=[]), " must hold at least one camera, found none."),
}


@pytest.mark.parametrize("case", TRANSFORMS)
def test_transforms(case, tmp_path) -> None:
    change, wanted = TRANSFORMS[case]
    document = copy.deepcopy(transforms())
    change(document)
    path = write_json(tmp_path / "transforms.json", document)
    found = text_of(path)
    assert found.startswith(f"{path}:{wanted}")
    assert found.endswith(".")
    assert "\n" not in found


def test_splits_of_transforms(tmp_path) -> None:
    document = {**transforms(), "train_filenames": ["images/frame_01.jpg", "images/none.jpg"]}
    path = write_json(tmp_path / "transforms.json", document)
    assert text_of(path, split="train") == (
        f"{path}: row 1 of 'train_filenames' must be the 'file_path' of a frame, "
        f"found 'images/none.jpg'."
    )
    assert text_of(path, split="test") == f"{path}: 'test_filenames' must be a list, found none."
    write_json(path, {**document, "train_filenames": []})
    assert (
        text_of(path, split="train") == f"{path}: must hold at least one train camera, found none."
    )
    write_json(path, transforms(rows=[3]))
    assert text_of(tmp_path, split="train") == (
        f"{tmp_path}: must hold at least one train camera, found none."
    )
    assert text_of(tmp_path, InvalidArgumentError, split="val") == (
        "split must be 'train', 'test' or None, found 'val'."
    )
    path.rename(tmp_path / "transforms_train.json")
    assert text_of(tmp_path, InputNotFoundError, split="test") == (
        f"{tmp_path / 'transforms_test.json'}: the file to read must exist, found none."
    )


def test_image_sizes_that_are_not_there(tmp_path) -> None:
    document = transforms(rows=[0])
    del document["w"]
    document["frames"][0]["file_path"] = "r_0"
    path = write_json(tmp_path / "transforms.json", document)
    assert text_of(path) == (
        f"{path}: frame 0: 'w' and 'h' must be given here or for the whole file, or the image "
        f"must be there; found neither them nor {tmp_path / 'r_0'}."
    )
    (tmp_path / "r_0.png").write_bytes(b"\xff\xd8\xff" + bytes(100))
    assert text_of(path) == (
        f"{tmp_path / 'r_0.png'}: must be a PNG file, since its size is not among the cameras; "
        f"found another format. Give 'w' and 'h' in the file of the cameras."
    )


INRIA: Mapping[str, tuple[Callable[[Any], None], str]] = {
    "entry": (put(4, value=[]), "camera 4: must be a JSON object, found []."),
    "rotation": (
        put(4, "rotation", value=[1, 0, 0]),
        "camera 4: 'rotation' must be 3 x 3 finite numbers, found [1, 0, 0].",
    ),
    "position": (
        put(0, "position", value=[1, 0, None]),
        "camera 0: 'position' must be 3 finite numbers, found [1, 0, None].",
    ),
    "name": (put(0, "img_name", value=3), "camera 0: 'img_name' must be a text, found 3."),
    "width": (drop(9, "width"), "camera 9: 'width' must be a whole number, found none."),
    "focal length": (
        put(9, "fy", value=0),
        "camera 9: focal lengths must be above 0 and the principal point finite, "
        "found fx 55, fy 0, cx 32, cy 24.",
    ),
}


@pytest.mark.parametrize("case", INRIA)
def test_inria(case, tmp_path) -> None:
    change, wanted = INRIA[case]
    entries = inria()
    change(entries)
    path = write_json(tmp_path / "cameras.json", entries)
    assert text_of(path) == f"{path}: {wanted}"


JSON: Mapping[str, tuple[bytes, str]] = {
    "empty": (b"", "must be JSON, found an error in line 1, column 1: expecting value."),
    "cut": (
        b'{"w": 3,\n "frames": [',
        "must be JSON, found an error in line 2, column 13: expecting value.",
    ),
    "latin 1": (b'["\xe4"]', "must be JSON in UTF-8, found another byte at 2."),
    "other object": (
        b'{"w": 3}',
        "must be a list of cameras (INRIA's cameras.json) or an object with 'frames' "
        "(transforms.json), found neither.",
    ),
    "a number": (
        b"3",
        "must be a list of cameras (INRIA's cameras.json) or an object with 'frames' "
        "(transforms.json), found neither.",
    ),
    "no camera": (b"[]", "must hold at least one camera, found none."),
}


@pytest.mark.parametrize("case", JSON)
def test_json(case, tmp_path) -> None:
    data, wanted = JSON[case]
    path = tmp_path / "cameras.json"
    path.write_bytes(data)
    assert text_of(path) == f"{path}: {wanted}"


def test_json_without_end(tmp_path) -> None:
    path = tmp_path / "cameras.json"
    for data in (b"[" * 1_000_000, b"[" + b"9" * 10_000 + b"]"):
        path.write_bytes(data)
        assert text_of(path).startswith(f"{path}: must be plain JSON, found: ")


CAMERAS_TXT: Mapping[str, tuple[str, str]] = {
    "few words": (
        "1 PINHOLE 64",
        "must be a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], found '1 PINHOLE 64'.",
    ),
    "few parameters": (
        "1 PINHOLE 64 48 9 9 9",
        "must be 4 parameters of PINHOLE, found '1 PINHOLE 64 48 9 9 9'.",
    ),
    "no number": (
        "1 PINHOLE 64 48 9 9 9 x",
        "must be a camera in numbers, found '1 PINHOLE 64 48 9 9 9 x'.",
    ),
    "fisheye": (
        "1 OPENCV_FISHEYE 64 48 9 9 9 9 0 0 0 0",
        "the camera model must be one of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, "
        "FULL_OPENCV, found OPENCV_FISHEYE; undistort the images first (colmap image_undistorter).",
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
    "size": (
        "1 PINHOLE 64 99999999 9 9 9 9",
        "the image size must be from 1 to 1,048,576 pixels, found 64 x 99999999.",
    ),
}


@pytest.mark.parametrize("case", CAMERAS_TXT)
def test_colmap_cameras_txt(case, tmp_path) -> None:
    colmap_txt(tmp_path)
    line, wanted = CAMERAS_TXT[case]
    path = tmp_path / "cameras.txt"
    path.write_text(f"# a comment\n\n{line}\n")
    assert text_of(tmp_path) == f"{path}: line 3: {wanted}"


IMAGES_TXT: Mapping[str, tuple[str, str]] = {
    "few words": (
        "1 1 0 0 0 0 0 1 7",
        "line 2: must be an image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, "
        "found '1 1 0 0 0 0 0 1 7'.",
    ),
    "no number": (
        "1 1 0 0 0 0 0 x 7 a.jpg",
        "line 2: must be an image in numbers, found '1 1 0 0 0 0 0 x 7 a.jpg'.",
    ),
    "zero quaternion": (
        "1 0 0 0 0 0 0 5 7 a.jpg",
        "line 2: the pose must be finite with a quaternion other than 0, "
        "found 0, 0, 0, 0, 0, 0, 5.",
    ),
    "infinite": (
        "1 1 0 0 0 0 nan 5 7 a.jpg",
        "line 2: the pose must be finite with a quaternion other than 0, "
        "found 1, 0, 0, 0, 0, nan, 5.",
    ),
    "no points line": (
        "1 1 0 0 0 0 0 5 7 a.jpg\n2 1 0 0 0 0 0 5 7 b.jpg",
        "line 3: must be the points of image 'a.jpg' as X Y POINT3D_ID, or empty, "
        "found '2 1 0 0 0 0 0 5 7 b.jpg'.",
    ),
    "unknown camera": (
        "1 1 0 0 0 0 0 5 8 a.jpg",
        "image 'a.jpg' must have a camera of the file of cameras, found camera 8.",
    ),
}


@pytest.mark.parametrize("case", IMAGES_TXT)
def test_colmap_images_txt(case, tmp_path) -> None:
    colmap_txt(tmp_path)
    lines, wanted = IMAGES_TXT[case]
    path = tmp_path / "images.txt"
    path.write_text(f"# a comment\n{lines}\n")
    assert text_of(tmp_path) == f"{path}: {wanted}"


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
        "OPENCV, FULL_OPENCV, found OPENCV_FISHEYE; undistort the images first "
        "(colmap image_undistorter).",
    ),
    "unknown model": (
        "cameras", packed_cameras(model=99),
        "camera 0: the camera model must be one of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, "
        "OPENCV, FULL_OPENCV, found number 99; undistort the images first "
        "(colmap image_undistorter).",
    ),
    "width": (
        "cameras", packed_cameras(width=1 << 63),
        "camera 0: the image size must be from 1 to 1,048,576 pixels, "
        "found 9223372036854775808 x 48.",
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
        "image 0: the pose must be finite with a quaternion other than 0, "
        "found 0, 0, 0, 0, 0, 0, 5.",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BINARY)
def test_colmap_binary(case, tmp_path) -> None:
    name, data, wanted = BINARY[case]
    colmap_bin(tmp_path)
    path = tmp_path / f"{name}.bin"
    path.write_bytes(data)
    assert text_of(tmp_path) == f"{path}: {wanted}"


@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "cameras.txt", "images.txt"])
def test_any_damage_gives_cameras_or_one_sentence(name, tmp_path) -> None:
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


def test_what_is_not_there(tmp_path) -> None:
    assert text_of(tmp_path, InputNotFoundError) == (
        f"{tmp_path}: the folder must hold transforms.json, transforms_train.json, "
        f"transforms_test.json, a COLMAP model in sparse/0, sparse or itself, or cameras.json; "
        f"found none of them."
    )
    for name in ("no.json", "no"):
        assert text_of(tmp_path / name, InputNotFoundError) == (
            f"{tmp_path / name}: the file to read must exist, found none."
        )
    colmap_bin(tmp_path)
    (tmp_path / "cameras.bin").unlink()
    assert text_of(tmp_path, InputNotFoundError) == (
        f"{tmp_path / 'cameras.bin'}: the file to read must exist, found none."
    )
    (tmp_path / "points.ply").write_bytes(b"ply\n")
    assert text_of(tmp_path / "points.ply") == (
        f"{tmp_path / 'points.ply'}: a file of cameras must be JSON (.json) or of a COLMAP model "
        f"(cameras.bin, images.bin, cameras.txt, images.txt), found neither."
    )


def test_what_cannot_be_read(tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    assert text_of(tmp_path / "pipe.json", InputError) == (
        f"{tmp_path / 'pipe.json'}: must be a regular file, found a device or a pipe."
    )
    if os.geteuid() == 0:
        pytest.skip("root may read everything")
    path = write_json(tmp_path / "cameras.json", inria())
    path.chmod(0)
    assert text_of(path, InputError) == (
        f"{path}: the file must be readable, found: permission denied."
    )


def test_the_rest_of_the_files_is_left_alone(tmp_path) -> None:
    """Reading writes nothing."""
    colmap_bin(tmp_path, model="RADIAL", parameters=[50, 32, 24, 0.1, 0])
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.warns(DroppedDataWarning):
        load_cameras(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
