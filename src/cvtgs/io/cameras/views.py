"""Views and lenses, the common form of all camera formats, and cameras built from them."""

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float

from cvtgs.cameras import Cameras
from cvtgs.errors import DroppedDataWarning, FileFormatError

MAX_PIXELS = 1 << 20
"""Largest width and height of images; a larger number is considered damaged."""

_SKEW = 0.01
_TEST_EVERY = 8

Split = Literal["train", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """Intrinsics of a camera, in pixels; pixel centres are at half-integers."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distorted: bool = False
    """Whether the file has a distortion, which is left out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """The camera of one photograph; its name is the name or path in the file."""

    name: str
    viewmat: Float[np.ndarray, "4 4"]
    """From world to camera, OpenCV axes."""
    lens: Lens


def checked_lens(lens: Lens, where: str) -> Lens:
    """Return the lens, after checking that its intrinsics are possible."""
    if not (1 <= lens.width <= MAX_PIXELS and 1 <= lens.height <= MAX_PIXELS):
        raise FileFormatError(
            f"{where}: the image size must be from 1 to {MAX_PIXELS:,} pixels, "
            f"found {lens.width} x {lens.height}."
        )
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy)
    if not all(np.isfinite(numbers)) or min(lens.fx, lens.fy) <= 0:
        raise FileFormatError(
            f"{where}: focal lengths must be above 0 and the principal point finite, found "
            f"fx {lens.fx:g}, fy {lens.fy:g}, cx {lens.cx:g}, cy {lens.cy:g}."
        )
    return lens


def viewmat_of_pose(
    rotation: Float[np.ndarray, "3 3"], center: Float[np.ndarray, "3"], *, where: str
) -> Float[np.ndarray, "4 4"]:
    """Return the world-to-camera matrix of a camera-to-world pose."""
    with np.errstate(over="ignore", invalid="ignore"):
        skew = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        determinant = float(np.linalg.det(rotation))
    if not skew <= _SKEW or determinant < 0:  # also refuses NaN
        raise FileFormatError(
            f"{where}: the pose must hold a rotation without scaling or reflection, "
            f"found a matrix of determinant {determinant:.6g}, {skew:.3g} from orthogonal."
        )
    left, _, right = np.linalg.svd(rotation)
    inverse = (left @ right).T
    viewmat = np.eye(4)
    viewmat[:3, :3] = inverse
    with np.errstate(over="ignore", invalid="ignore"):
        viewmat[:3, 3] = -inverse @ center
    if not np.isfinite(viewmat).all():
        raise FileFormatError(
            f"{where}: the camera must be closer to the origin, found it at {center.tolist()}."
        )
    return viewmat


def hold_out(views: Sequence[View], split: Split | None) -> list[View]:
    """Return a split; every 8th view by name is for testing, as in Mip-NeRF 360 and 3DGS."""
    if split is None:
        return list(views)
    by_name = sorted(range(len(views)), key=lambda row: views[row].name)
    test = set(by_name[::_TEST_EVERY])
    return [view for row, view in enumerate(views) if (row in test) == (split == "test")]


def to_cameras(views: Sequence[View], path: str) -> Cameras:
    """Build cameras of the most frequent image size, and warn once about distortion."""
    sizes = Counter((view.lens.width, view.lens.height) for view in views)
    (width, height), _ = sizes.most_common(1)[0]
    _warn_of_distortion(views, path)
    viewmats = np.stack([view.viewmat for view in views])
    intrinsics = np.stack([_intrinsics(view.lens, width=width, height=height) for view in views])
    return Cameras(
        viewmats=torch.from_numpy(viewmats),
        Ks=torch.from_numpy(intrinsics),
        width=width,
        height=height,
        names=tuple(view.name for view in views),
    )


def _intrinsics(lens: Lens, *, width: int, height: int) -> Float[np.ndarray, "3 3"]:
    x, y = width / lens.width, height / lens.height
    return np.array([[lens.fx * x, 0, lens.cx * x], [0, lens.fy * y, lens.cy * y], [0, 0, 1]])


def _warn_of_distortion(views: Sequence[View], path: str) -> None:
    count = sum(view.lens.distorted for view in views)
    if count:
        warnings.warn(
            f"{path}: left out the lens distortion of {count:,} of {len(views):,} cameras, since "
            f"rendering uses pinhole cameras; compare with undistorted photographs.",
            DroppedDataWarning,
            stacklevel=4,
        )
