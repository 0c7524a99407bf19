"""The ``transforms.json`` of NeRF, instant-ngp and nerfstudio."""

import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from cvtgs.errors import FileFormatError, InvalidArgumentError
from cvtgs.io.cameras.holdout import SPLITS, Split, hold_out
from cvtgs.io.cameras.png_size import png_size
from cvtgs.io.cameras.views import Lens, View, checked_lens, viewmat_of_pose
from cvtgs.io.fields import Fields
from cvtgs.io.files import is_file

_PINHOLE_MODELS = (
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "PERSPECTIVE",
)
_DISTORTIONS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_OPENGL = np.diag([1.0, -1.0, -1.0])


def transforms_views(document: Mapping[str, Any], path: Path, split: Split | None) -> list[View]:
    """Read the frames of a ``transforms.json``."""
    everything = Fields.of(document, str(path))
    views = [
        _view(Fields.of(frame, f"{path}: frame {row}"), everything, path.parent)
        for row, frame in enumerate(everything.items("frames"))
    ]
    if split is None:
        return views
    own = path.stem.removeprefix("transforms_")
    if own in SPLITS:
        if own != split:
            raise InvalidArgumentError(
                f"{path}: the split must be {own!r} for this file, found {split!r}; "
                f"pass the folder to have both."
            )
        return views
    if any(f"{name}_filenames" in everything for name in (*SPLITS, "val")):
        return _listed(views, everything, f"{split}_filenames")
    return hold_out(views, split)


def _view(frame: Fields, everything: Fields, folder: Path) -> View:
    pose = frame.array("transform_matrix", (4, 4), (3, 4))
    if len(pose) == 4 and not np.allclose(pose[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
        raise frame.wrong("transform_matrix", "a pose in rows, with 0 0 0 1 as the last")
    name = frame.text("file_path")
    width, height = _size(frame, everything, folder / name)
    lens = _lens(frame, everything, width=width, height=height)
    return View(
        name=name,
        viewmat=viewmat_of_pose(pose[:3, :3] @ _OPENGL, pose[:3, 3], where=frame.where),
        lens=checked_lens(lens, frame.where),
    )


def _lens(frame: Fields, everything: Fields, *, width: int, height: int) -> Lens:
    """Take each number from the frame, else from the whole file, else from the image size."""
    fx = _focal(frame, everything, axis="x", pixels=width)
    fy = _focal(frame, everything, axis="y", pixels=height)
    if fx is None and fy is None:
        raise FileFormatError(
            f"{frame.where}: 'fl_x', 'fl_y', 'camera_angle_x' or 'camera_angle_y' must be given "
            f"here or for the whole file, found none."
        )
    cx, cy = _place(frame, everything, "cx"), _place(frame, everything, "cy")
    return Lens(
        fx=_first(fx, fy),
        fy=_first(fy, fx),
        cx=width / 2 if cx is None else cx.number("cx"),
        cy=height / 2 if cy is None else cy.number("cy"),
        width=width,
        height=height,
        distorted=_distorted(frame, everything),
    )


def _first(*values: float | None) -> float:
    return next(value for value in values if value is not None)


def _place(frame: Fields, everything: Fields, key: str) -> Fields | None:
    """Report who gives a key: the frame, the whole file or nobody."""
    return next((fields for fields in (frame, everything) if key in fields), None)


def _focal(frame: Fields, everything: Fields, *, axis: str, pixels: int) -> float | None:
    for fields in (frame, everything):
        if f"fl_{axis}" in fields:
            return fields.number(f"fl_{axis}")
        key = f"camera_angle_{axis}"
        if key in fields:
            angle = fields.number(key)
            if not 0 < angle < math.pi:
                raise fields.wrong(key, "an angle between 0 and pi")
            return 0.5 * pixels / math.tan(0.5 * angle)
    return None


def _distorted(frame: Fields, everything: Fields) -> bool:
    model = _place(frame, everything, "camera_model")
    if model is not None and model.text("camera_model") not in _PINHOLE_MODELS:
        raise model.wrong("camera_model", f"one of {', '.join(_PINHOLE_MODELS)}")
    places = ((_place(frame, everything, key), key) for key in _DISTORTIONS)
    return any(fields is not None and fields.number(key) != 0 for fields, key in places)


def _size(frame: Fields, everything: Fields, image: Path) -> tuple[int, int]:
    width, height = _place(frame, everything, "w"), _place(frame, everything, "h")
    if width is not None and height is not None:
        return width.whole("w"), height.whole("h")
    for candidate in (image, image.with_name(f"{image.name}.png")):
        if is_file(candidate):
            return png_size(candidate)
    raise FileFormatError(
        f"{frame.where}: 'w' and 'h' must be given here or for the whole file, or the image must "
        f"be there; found neither them nor {image}."
    )


def _listed(views: list[View], everything: Fields, key: str) -> list[View]:
    """Take the frames that the file itself lists, in the order of the frames."""
    known = {PurePosixPath(view.name) for view in views}
    wanted = set()
    for row, name in enumerate(everything.items(key)):
        if not isinstance(name, str) or PurePosixPath(name) not in known:
            raise FileFormatError(
                f"{everything.where}: row {row} of {key!r} must be the 'file_path' of a frame, "
                f"found {name!r}."
            )
        wanted.add(PurePosixPath(name))
    return [view for view in views if PurePosixPath(view.name) in wanted]
