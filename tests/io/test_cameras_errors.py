"""Error messages about damaged camera files, word for word."""

import copy
import math
from collections.abc import Callable, Mapping
from typing import Any

import pytest

from camera_files import inria, transforms, write_json
from cvtgs.errors import (
    InputNotFoundError,
    InvalidArgumentError,
)
from format_cases import camera_refusal


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
UNDISTORT = "for others, use colmap image_undistorter first, and give the folder that it writes"
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
        " frame 2: the pose must hold a rotation without scaling or reflection, "
        "found a matrix of determinant 8, 3 from orthogonal.",
    ),
    "mirrored pose": (
        put("frames", 2, "transform_matrix", value=MIRROR),
        " frame 2: the pose must hold a rotation without scaling or reflection, "
        "found a matrix of determinant -1, 0 from orthogonal.",
    ),
    "pose by columns": (
        put("frames", 2, "transform_matrix", value=BY_COLUMNS),
        " frame 2: 'transform_matrix' must be a row-major pose with 0 0 0 1 as its last row, found "
        "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [3, 4, 5, 1]].",
    ),
    "no name": (
        drop("frames", 0, "file_path"),
        " frame 0: 'file_path' must be a string, found none.",
    ),
    "no focal length": (
        lambda document: [document.pop(key) for key in ("fl_x", "fl_y")],
        " frame 0: 'fl_x', 'fl_y', 'camera_angle_x' or 'camera_angle_y' must be given in "
        "the frame or at the top level of the file, found none.",
    ),
    "text for a number": (put("fl_x", value="9"), " 'fl_x' must be a finite number, found '9'."),
    "huge number": (
        put("frames", 1, "cx", value=10**400),
        " frame 1: 'cx' must be a finite number",
    ),
    "half a pixel": (put("w", value=64.5), " 'w' must be a whole number, found 64.5."),
    "no pixel": (
        put("frames", 3, "w", value=0),
        " frame 3: an image must have 1 to 1,048,576 pixels per side and at most 268,435,456 in "
        "all, found 0 x 48.",
    ),
    "half a turn": (
        lambda document: (
            [document.pop(key) for key in ("fl_x", "fl_y")],
            document.update(camera_angle_x=math.pi),
        ),
        " 'camera_angle_x' must be an angle between 0 and pi, found 3.14",
    ),
    "pixels": (
        lambda document: document["frames"][3].update(w=20_000, h=20_000),
        " frame 3: an image must have 1 to 1,048,576 pixels per side and at most 268,435,456 in "
        "all, found 20000 x 20000.",
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
        f"FULL_OPENCV, PERSPECTIVE ({UNDISTORT}), found 'OPENCV_FISHEYE'.",
    ),
    "fisheye of instant-ngp": (
        put("is_fisheye", value=True),
        " 'is_fisheye' must be false, since rendering uses pinhole cameras "
        f"({UNDISTORT}), found True.",
    ),
    "fisheye of a frame": (
        put("frames", 2, "is_fisheye", value=True),
        " frame 2: 'is_fisheye' must be false, since rendering uses pinhole cameras "
        f"({UNDISTORT}), found True.",
    ),
    "text for distortion": (
        put("distortion_params", value=[0.1, "x"]),
        " 'distortion_params' must be a list of finite numbers, found [0.1, 'x'].",
    ),
    "no frames": (put("frames", value=[]), " must hold at least one camera, found none."),
}


@pytest.mark.parametrize("case", TRANSFORMS)
def test_damage_of_transforms_json_is_one_sentence(case, tmp_path) -> None:
    change, wanted = TRANSFORMS[case]
    document = copy.deepcopy(transforms())
    change(document)
    path = write_json(tmp_path / "transforms.json", document)
    found = camera_refusal(path)
    assert found.startswith(f"{path}:{wanted}")
    assert found.endswith(".")
    assert "\n" not in found


def test_impossible_splits_are_refused(tmp_path) -> None:
    document = {**transforms(), "train_filenames": ["images/frame_01.jpg", "images/none.jpg"]}
    path = write_json(tmp_path / "transforms.json", document)
    assert camera_refusal(path, split="train") == (
        f"{path}: train_filenames[1] must name a frame, found 'images/none.jpg'."
    )
    assert (
        camera_refusal(path, split="test")
        == f"{path}: 'test_filenames' must be a list, found none."
    )
    write_json(path, {**document, "train_filenames": []})
    assert (
        camera_refusal(path, split="train")
        == f"{path}: must hold at least one train camera, found none."
    )
    write_json(path, transforms(rows=[3]))
    assert camera_refusal(tmp_path, split="train") == (
        f"{tmp_path}: must hold at least one train camera, found none."
    )
    assert camera_refusal(tmp_path, InvalidArgumentError, split="val") == (
        "split must be 'train', 'test' or None, found 'val'."
    )
    path.rename(tmp_path / "transforms_train.json")
    assert camera_refusal(tmp_path, InputNotFoundError, split="test") == (
        f"{tmp_path / 'transforms_test.json'}: the file to read must exist, found none."
    )


def test_missing_image_sizes_are_one_sentence(tmp_path) -> None:
    document = transforms(rows=[0])
    del document["w"]
    document["frames"][0]["file_path"] = "r_0"
    path = write_json(tmp_path / "transforms.json", document)
    assert camera_refusal(path) == (
        f"{path}: frame 0: 'w' and 'h' must be given in the frame or at the top level of the "
        f"file, or the image must exist; found neither them nor an image 'r_0'."
    )
    for content in (b"\xff\xd8\xff" + bytes(100), b"\x89PNG"):
        (tmp_path / "r_0.png").write_bytes(content)
        assert camera_refusal(path) == (
            f"{tmp_path / 'r_0.png'}: must be a PNG unless the camera file gives 'w' and 'h', "
            "found another format; add them to it."
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
    "name": (put(0, "img_name", value=3), "camera 0: 'img_name' must be a string, found 3."),
    "width": (drop(9, "width"), "camera 9: 'width' must be a whole number, found none."),
    "focal length": (
        put(9, "fy", value=0),
        "camera 9: focal lengths must be above 0 and the principal point finite, "
        "found fx 55, fy 0, cx 32, cy 24.",
    ),
}


@pytest.mark.parametrize("case", INRIA)
def test_damage_of_inria_cameras_is_one_sentence(case, tmp_path) -> None:
    change, wanted = INRIA[case]
    entries = inria()
    change(entries)
    path = write_json(tmp_path / "cameras.json", entries)
    assert camera_refusal(path) == f"{path}: {wanted}"


JSON: Mapping[str, tuple[bytes, str]] = {
    "empty": (b"", "must be JSON in UTF-8, found: Expecting value: line 1 column 1 (char 0)."),
    "cut": (
        b'{"w": 3,\n "frames": [',
        "must be JSON in UTF-8, found: Expecting value: line 2 column 13 (char 21).",
    ),
    "latin 1": (
        b'["\xe4"]',
        "must be JSON in UTF-8, found: 'utf-8' codec can't decode byte 0xe4 in position 2: invalid "
        "continuation byte.",
    ),
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
def test_damaged_json_is_one_sentence(case, tmp_path) -> None:
    data, wanted = JSON[case]
    path = tmp_path / "cameras.json"
    path.write_bytes(data)
    assert camera_refusal(path) == f"{path}: {wanted}"


def test_nested_json_and_huge_numbers_are_refused(tmp_path) -> None:
    path = tmp_path / "cameras.json"
    for data in (b"[" * 1_000_000, b"[" + b"9" * 10_000 + b"]"):
        path.write_bytes(data)
        assert camera_refusal(path).startswith(f"{path}: must be JSON in UTF-8, found: ")
