"""Read JSON cameras: ``transforms.json`` of NeRF and nerfstudio, ``cameras.json`` of INRIA."""

import math
import struct
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field

from cvtgs.errors import FileFormatError, InvalidArgumentError
from cvtgs.io.cameras import SPLITS, Lens, Split, View, checked_lens, hold_out, viewmat_of_pose
from cvtgs.io.files import (
    Document,
    FourNumbers,
    Items,
    Number,
    Text,
    Vector,
    Whole,
    is_file,
    open_input,
    validated,
)
from cvtgs.text import shown

_PinholeModel = Literal[
    "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE"
]
_UNDISTORT = "for others, use colmap image_undistorter first, and give the folder that it writes"
_DISTORTIONS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_OPENGL = np.diag([1.0, -1.0, -1.0])
_PNG_START = struct.Struct(">8sI4sII")
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


class _Intrinsics(Document):
    """Intrinsics of a frame, or of the file for all its frames."""

    w: Whole | None = None
    h: Whole | None = None
    fl_x: Number | None = None
    fl_y: Number | None = None
    camera_angle_x: Number | None = None
    camera_angle_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    camera_model: _PinholeModel | None = Field(
        None, description=f"one of {', '.join(get_args(_PinholeModel))} ({_UNDISTORT})"
    )
    is_fisheye: Literal[False] | None = Field(
        None, description=f"false, since rendering uses pinhole cameras ({_UNDISTORT})"
    )
    k1: Number | None = None
    k2: Number | None = None
    k3: Number | None = None
    k4: Number | None = None
    k5: Number | None = None
    k6: Number | None = None
    p1: Number | None = None
    p2: Number | None = None
    distortion_params: tuple[Number, ...] | None = Field(
        None, description="a list of finite numbers"
    )


class _Frame(_Intrinsics):
    file_path: Text
    transform_matrix: Annotated[
        list[FourNumbers],
        Field(min_length=3, max_length=4, description="4 x 4 or 3 x 4 finite numbers"),
    ]


class _Transforms(_Intrinsics):
    frames: Items
    train_filenames: Items | None = None
    val_filenames: Items | None = None
    test_filenames: Items | None = None


class _InriaCamera(Document):
    img_name: Text
    width: Whole
    height: Whole
    fx: Number
    fy: Number
    position: Vector
    rotation: tuple[Vector, Vector, Vector] = Field(description="3 x 3 finite numbers")


def inria_views(entries: Sequence[Any], path: Path) -> list[View]:
    """Read the cameras of a ``cameras.json``."""
    views = []
    for row, entry in enumerate(entries):
        where = f"{path}: camera {row}"
        camera = validated(_InriaCamera, entry, where)
        width, height = camera.width, camera.height
        cx, cy = width / 2, height / 2
        lens = Lens(fx=camera.fx, fy=camera.fy, cx=cx, cy=cy, width=width, height=height)
        rotation, position = np.array(camera.rotation), np.array(camera.position)
        viewmat = viewmat_of_pose(rotation, position, where=where)
        views.append(View(name=camera.img_name, viewmat=viewmat, lens=checked_lens(lens, where)))
    return views


def transforms_views(content: Any, path: Path, split: Split | None) -> list[View]:
    """Read the frames of a ``transforms.json``."""
    document = validated(_Transforms, content, str(path))
    views = [
        _view(frame, document, path=path, where=f"{path}: frame {row}")
        for row, frame in enumerate(document.frames)
    ]
    if split is None:
        return views
    own = path.stem.removeprefix("transforms_")
    if own in SPLITS:
        if own != split:
            raise InvalidArgumentError(
                f"{path}: the split of this file must be {own!r}, found {split!r}; give the folder "
                f"to read both splits."
            )
        return views
    lists = (document.train_filenames, document.val_filenames, document.test_filenames)
    if any(names is not None for names in lists):
        key = f"{split}_filenames"
        return _listed(views, getattr(document, key), key, path)
    return hold_out(views, split)


def _view(content: Any, shared: _Intrinsics, *, path: Path, where: str) -> View:
    frame = validated(_Frame, content, where)
    pose = np.array(frame.transform_matrix)
    if len(pose) == 4 and not np.allclose(pose[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
        raise FileFormatError(
            f"{where}: 'transform_matrix' must be a row-major pose with 0 0 0 1 as its last row, "
            f"found {shown(content['transform_matrix'])}."
        )
    lens = _lens(frame, shared, path=path, where=where)
    return View(
        name=frame.file_path,
        viewmat=viewmat_of_pose(pose[:3, :3] @ _OPENGL, pose[:3, 3], where=where),
        lens=checked_lens(lens, where),
    )


def _lens(frame: _Frame, shared: _Intrinsics, *, path: Path, where: str) -> Lens:
    """Build a lens; each number is from the frame, else the file, else from the image size."""
    levels = ((frame, where), (shared, str(path)))
    missing = [key for key in _Intrinsics.model_fields if getattr(frame, key) is None]
    frame = frame.model_copy(update={key: getattr(shared, key) for key in missing})
    width, height = _size(frame, path=path, where=where)
    fx, fy = _focal(levels, "x", pixels=width), _focal(levels, "y", pixels=height)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None:
        raise FileFormatError(
            f"{where}: 'fl_x', 'fl_y', 'camera_angle_x' or 'camera_angle_y' must be given "
            f"in the frame or at the top level of the file, found none."
        )
    distortions = (getattr(frame, key) for key in _DISTORTIONS)
    return Lens(
        fx=fx,
        fy=fy,
        cx=width / 2 if frame.cx is None else frame.cx,
        cy=height / 2 if frame.cy is None else frame.cy,
        width=width,
        height=height,
        distorted=any(distortions) or any(frame.distortion_params or ()),
    )


def _focal(levels: Sequence[tuple[_Intrinsics, str]], axis: str, *, pixels: int) -> float | None:
    for given, where in levels:
        focal, angle = getattr(given, f"fl_{axis}"), getattr(given, f"camera_angle_{axis}")
        if focal is not None:
            return float(focal)
        if angle is not None and not 0 < angle < math.pi:
            raise FileFormatError(
                f"{where}: 'camera_angle_{axis}' must be an angle between 0 and pi, found {angle}."
            )
        if angle is not None:
            return 0.5 * pixels / math.tan(0.5 * float(angle))
    return None


def _size(frame: _Frame, *, path: Path, where: str) -> tuple[int, int]:
    if frame.w is not None and frame.h is not None:
        return frame.w, frame.h
    image = path.parent / frame.file_path.replace("\\", "/")  # of Windows
    for candidate in (image, Path(f"{image}.png")):
        if not is_file(candidate):
            continue
        with open_input(candidate) as file:
            start = file.read(_PNG_START.size)
        if len(start) == _PNG_START.size:
            signature, _, chunk, width, height = _PNG_START.unpack(start)
            if signature == _PNG_SIGNATURE and chunk == b"IHDR":
                return width, height
        raise FileFormatError(
            f"{candidate}: must be a PNG unless the camera file gives 'w' and 'h', found another "
            f"format; add them to it."
        )
    raise FileFormatError(
        f"{where}: 'w' and 'h' must be given in the frame or at the top level of the file, or the "
        f"image must exist; found neither them nor an image {shown(frame.file_path)}."
    )


def _listed(views: Sequence[View], names: Sequence[Any] | None, key: str, path: Path) -> list[View]:
    """Return the views that the file lists under a key, in the order of the frames."""
    if names is None:
        raise FileFormatError(f"{path}: {key!r} must be a list, found none.")
    known = {PurePosixPath(view.name) for view in views}
    for row, name in enumerate(names):
        if not isinstance(name, str) or PurePosixPath(name) not in known:
            raise FileFormatError(f"{path}: {key}[{row}] must name a frame, found {shown(name)}.")
    wanted = set(map(PurePosixPath, names))
    return [view for view in views if PurePosixPath(view.name) in wanted]
