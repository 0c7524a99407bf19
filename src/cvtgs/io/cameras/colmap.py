"""A sparse COLMAP model: a file of cameras and a file of images."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from cvtgs.errors import FileFormatError
from cvtgs.io.cameras import colmap_binary, colmap_text
from cvtgs.io.cameras.colmap_image import ColmapImage
from cvtgs.io.cameras.views import Lens, View
from cvtgs.io.files import is_file
from cvtgs.math import parameters


def is_colmap(folder: Path) -> bool:
    """Report whether a folder holds a sparse model."""
    return any(is_file(folder / f"images.{suffix}") for suffix in ("bin", "txt"))


def colmap_views(folder: Path) -> list[View]:
    """Read a sparse model; binary files go before text files."""
    if is_file(folder / "images.bin"):
        lenses = colmap_binary.read_cameras(folder / "cameras.bin")
        images = colmap_binary.read_images(folder / "images.bin")
        path = folder / "images.bin"
    else:
        lenses = colmap_text.read_cameras(folder / "cameras.txt")
        images = colmap_text.read_images(folder / "images.txt")
        path = folder / "images.txt"
    return _views(sorted(images, key=lambda image: image.name), lenses, path)


def _views(images: Sequence[ColmapImage], lenses: Mapping[int, Lens], path: Path) -> list[View]:
    for image in images:
        if image.camera not in lenses:
            raise FileFormatError(
                f"{path}: image {image.name!r} must have a camera of the file of cameras, "
                f"found camera {image.camera}."
            )
    quats = torch.tensor([image.quat for image in images], dtype=torch.float64).reshape(-1, 4)
    viewmats = np.tile(np.eye(4), (len(images), 1, 1))
    viewmats[:, :3, :3] = parameters.quats_to_matrices(parameters.normalize_quats(quats)).numpy()
    viewmats[:, :3, 3] = np.array([image.shift for image in images]).reshape(-1, 3)
    return [
        View(name=image.name, viewmat=viewmat, lens=lenses[image.camera])
        for image, viewmat in zip(images, viewmats, strict=True)
    ]
