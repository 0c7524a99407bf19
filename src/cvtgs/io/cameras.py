"""Read cameras of any capture format, in one common form: views and lenses."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float

from cvtgs.cameras import Cameras
from cvtgs.errors import (
    DroppedDataWarning,
    FileFormatError,
    InputNotFoundError,
    InvalidArgumentError,
    check_path,
    warn,
)
from cvtgs.io.files import is_file, is_folder, read_json

MAX_PIXELS = 1 << 20  # largest width and height of images; a larger number is considered damaged
MAX_AREA = 1 << 28  # largest number of pixels of an image, for which rendering takes some gigabytes
_SKEW = 0.01
_TEST_EVERY = 8
_COLMAP_FILES = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")

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
    distorted: bool = False  # whether the file has a distortion, which is left out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """The camera of one photograph; its name is the name or path in the file."""

    name: str
    viewmat: Float[np.ndarray, "4 4"]  # from world to camera, OpenCV axes
    lens: Lens


def checked_lens(lens: Lens, where: str) -> Lens:
    """Return the lens, after checking that its intrinsics are possible."""
    sides = (lens.width, lens.height)
    if min(sides) < 1 or max(sides) > MAX_PIXELS or lens.width * lens.height > MAX_AREA:
        raise FileFormatError(
            f"{where}: an image must have 1 to {MAX_PIXELS:,} pixels per side and at most "
            f"{MAX_AREA:,} in all, found {lens.width} x {lens.height}."
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


def load_cameras(path: str | os.PathLike[str], *, split: Split | None = None) -> Cameras:
    """Read the cameras of a capture.

    In a folder, these are tried in this order:

    - ``transforms.json`` of NeRF, instant-ngp or nerfstudio; or ``transforms_train.json`` and
      ``transforms_test.json``. OpenGL axes become OpenCV axes. Intrinsics come from the frame,
      else from the file; the default principal point is the image centre; a missing image size is
      read from the PNG images. ``applied_transform`` is ignored: the cameras stay in the world of
      the file. Scenes exported by nerfstudio are moved and scaled relative to it, unless this was
      disabled in training.
    - a COLMAP model in ``sparse/0``, ``sparse``, the folder itself or its ``0``, binary before
      text, of any pinhole model; the cameras are in the order of their names.
    - ``cameras.json`` of INRIA's 3DGS code.

    :class:`cvtgs.cameras.Cameras` have one image size. If sizes differ, the most frequent one (the
    first in a tie) is used, and the intrinsics of other cameras are scaled to it, separately for
    rows and columns; photographs must be resized in the same way. Distortion is left out with a
    warning.

    The split is that of the files (``transforms_test.json``, or ``test_filenames`` in the file).
    If there is none, every 8th camera in the order of names, from the first, is for testing.

    Args:
        path: A folder, or one of these files.
        split: ``"train"``, ``"test"``, or None for all cameras, in the order of the file; those
            of ``transforms_train.json`` come before those of ``transforms_test.json``.

    Returns:
        The cameras, float64 on the CPU; their names are the image names or paths in the file.

    Raises:
        InvalidArgumentError: The split does not exist, the file is that of the other split, or
            ``path`` is no path.
        InputError: The path does not exist or cannot be read, or the folder has no such file.
        FileFormatError: A file does not conform to its format, or has no camera of the split.

    Example:
        >>> import json, tempfile
        >>> frame = {"file_path": "a.png", "transform_matrix": [
        ...     [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}
        >>> document = {"w": 64, "h": 48, "fl_x": 50.0, "frames": [frame]}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "transforms.json").write_text(json.dumps(document))
        ...     cameras = load_cameras(folder)
        >>> cameras.names, cameras.centers[0, 2].item()
        (('a.png',), 4.0)
    """
    if split is not None and split not in SPLITS:
        raise InvalidArgumentError(f"split must be 'train', 'test' or None, found {split!r}.")
    check_path(path)
    source = Path(path)
    views = _folder_views(source, split) if is_folder(source) else _file_views(source, split)
    if not views:
        raise FileFormatError(
            f"{source}: must hold at least one {f'{split} ' if split else ''}camera, found none."
        )
    sizes = Counter((view.lens.width, view.lens.height) for view in views)
    (width, height), _ = sizes.most_common(1)[0]
    distorted = sum(view.lens.distorted for view in views)
    if distorted:
        warn(
            f"{source}: left out the lens distortion of {distorted:,} of {len(views):,} cameras, "
            f"since rendering uses pinhole cameras; compare with undistorted photographs.",
            DroppedDataWarning,
        )
    intrinsics = []
    for lens in (view.lens for view in views):
        x, y = width / lens.width, height / lens.height
        intrinsics.append([[lens.fx * x, 0, lens.cx * x], [0, lens.fy * y, lens.cy * y], [0, 0, 1]])
    return Cameras(
        viewmats=torch.from_numpy(np.stack([view.viewmat for view in views])),
        Ks=torch.from_numpy(np.array(intrinsics, np.float64)),
        width=width,
        height=height,
        names=tuple(view.name for view in views),
    )


def _folder_views(folder: Path, split: Split | None) -> list[View]:
    if is_file(folder / "transforms.json"):
        return _file_views(folder / "transforms.json", split)
    parts = {name: folder / f"transforms_{name}.json" for name in SPLITS}
    there = [part for part in parts.values() if is_file(part)]
    if there:
        chosen = there if split is None else [parts[split]]
        return [view for part in chosen for view in _file_views(part, split)]
    from cvtgs.io.colmap import colmap_views, is_colmap  # noqa: PLC0415 (when it is read)

    for model in (folder / "sparse" / "0", folder / "sparse", folder, folder / "0"):
        if is_colmap(model):
            return hold_out(colmap_views(model), split)
    if is_file(folder / "cameras.json"):
        return _file_views(folder / "cameras.json", split)
    raise InputNotFoundError(
        f"{folder}: must hold transforms.json, transforms_train.json, transforms_test.json, a "
        f"COLMAP model (in sparse/0, sparse or the folder itself) or cameras.json, found none."
    )


def _file_views(path: Path, split: Split | None) -> list[View]:
    if path.name in _COLMAP_FILES:
        from cvtgs.io.colmap import colmap_views  # noqa: PLC0415 (when it is read)

        return hold_out(colmap_views(path.parent, as_text=path.suffix == ".txt"), split)
    if path.suffix.lower() != ".json" and is_file(path):
        raise FileFormatError(
            f"{path}: must be a .json or one of COLMAP's {', '.join(_COLMAP_FILES)}, found neither."
        )
    from cvtgs.io.transforms import inria_views, transforms_views  # noqa: PLC0415

    content = read_json(path)
    if isinstance(content, list):
        return hold_out(inria_views(content, path), split)
    if isinstance(content, dict) and "frames" in content:
        return transforms_views(content, path, split)
    raise FileFormatError(
        f"{path}: must be a list of cameras (INRIA's cameras.json) or an object with 'frames' "
        f"(transforms.json), found neither."
    )
