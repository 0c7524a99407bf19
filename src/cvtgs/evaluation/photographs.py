"""The photographs that belong to cameras, found by name."""

import os
from collections import Counter
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.errors import InputNotFoundError, InvalidArgumentError
from cvtgs.evaluation.images import image_size, read_image

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")


def load_photographs(
    folder: str | os.PathLike[str],
    cameras: Cameras,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Float[Tensor, "c h w 3"]:
    """Read the photograph of every camera, at the cameras' size.

    A photograph lies in the folder under the camera's name, or under the last part of that name;
    the suffix may be another one or be missing in the name. Other files, such as masks, are left
    alone; transparent pixels show the background. Photographs of another size are scaled to that
    of the cameras, along rows and columns by themselves.

    Memory: ``12 c h w`` bytes.

    Args:
        folder: Where the photographs are.
        cameras: Cameras with names.
        background: Colour behind transparent pixels, in [0, 1].

    Returns:
        ``(c, h, w, 3)`` images in [0, 1], float32.

    Raises:
        InvalidArgumentError: The cameras have no names.
        InputNotFoundError: There is no such folder, or a camera has no photograph in it.
        InputError: A photograph cannot be read.
        FileFormatError: A photograph is no image.

    Example:
        >>> import tempfile
        >>> from cvtgs.evaluation.images import encode
        >>> cameras = Cameras(viewmats=torch.eye(4)[None], Ks=torch.eye(3)[None], width=4,
        ...                   height=2, names=("train/a",))
        >>> with tempfile.TemporaryDirectory() as images:
        ...     _ = (Path(images) / "a.png").write_bytes(encode(np.zeros((4, 8, 3), "u1"), "png"))
        ...     load_photographs(images, cameras).shape
        torch.Size([1, 2, 4, 3])
    """
    size = (cameras.width, cameras.height)
    paths = _find_all(Path(folder), cameras)
    return torch.from_numpy(np.stack([read_image(path, size, background) for path in paths]))


def fit_cameras(cameras: Cameras, folder: str | os.PathLike[str]) -> Cameras:
    """Give cameras the size of their photographs if that is smaller, as in ``images_4``.

    Args:
        cameras: Cameras with names.
        folder: Where the photographs are, as :func:`load_photographs` finds them.

    Returns:
        Cameras with scaled intrinsics, or the same; of several sizes the most frequent counts.

    Raises:
        InvalidArgumentError: The cameras have no names, or the photographs another shape.
        InputNotFoundError: There is no such folder, or a camera has no photograph in it.
        FileFormatError: A photograph is no image.

    Example:
        >>> import tempfile
        >>> from cvtgs.evaluation.images import encode
        >>> cameras = Cameras(viewmats=torch.eye(4)[None], Ks=torch.eye(3)[None], width=16,
        ...                   height=8, names=("a",))
        >>> with tempfile.TemporaryDirectory() as images:
        ...     _ = (Path(images) / "a.png").write_bytes(encode(np.zeros((4, 8, 3), "u1"), "png"))
        ...     fit_cameras(cameras, images).width
        8
    """
    paths = _find_all(Path(folder), cameras)
    (width, height), _ = Counter(image_size(path) for path in paths).most_common(1)[0]
    # Sizes were rounded when the photographs were scaled.
    if abs(width * cameras.height - height * cameras.width) > 1.5 * max(
        cameras.width, cameras.height
    ):
        raise InvalidArgumentError(
            f"{folder}: photographs must have the shape of the cameras' images, {cameras.width} x "
            f"{cameras.height} or smaller, found {width} x {height}."
        )
    return cameras.resized(width, height) if width < cameras.width else cameras


def _find_all(place: Path, cameras: Cameras) -> list[Path]:
    """Find the photograph of every camera."""
    if not cameras.names:
        raise InvalidArgumentError(
            "photographs are matched by the names of the cameras, but these have none."
        )
    if not place.is_dir():
        raise InputNotFoundError(f"{place}: the folder of photographs must exist, found none.")
    found = {name: _find(place, name) for name in cameras.names}
    missing = [name for name, path in found.items() if path is None]
    if missing:
        raise InputNotFoundError(
            f"{place}: must hold a photograph of every camera; {len(missing)} of "
            f"{len(found)} cameras have none, the first is {missing[0]!r}."
        )
    return [path for path in found.values() if path]


def _find(folder: Path, name: str) -> Path | None:
    """Look for the whole name first, then for its last part; first as it is, then by suffix."""
    whole = PurePosixPath(name.replace("\\", "/"))
    parts = [part for part in whole.parts if part not in ("/", ".", "..")]
    for inner in (PurePosixPath(*parts), PurePosixPath(whole.name)):
        exact = folder / inner
        if exact.suffix.lower() in SUFFIXES and exact.is_file():
            return exact
        bases = [exact.with_suffix("")] if exact.suffix.lower() in SUFFIXES else [exact]
        for base in bases:
            for suffix in SUFFIXES:
                for written in (suffix, suffix.upper()):
                    candidate = base.with_name(base.name + written)
                    if candidate.is_file():
                        return candidate
    return None
