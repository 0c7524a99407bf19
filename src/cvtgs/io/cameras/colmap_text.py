"""COLMAP's ``cameras.txt`` and ``images.txt``."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from cvtgs.errors import FileFormatError
from cvtgs.io.cameras.colmap_image import ColmapImage, checked_image
from cvtgs.io.cameras.colmap_models import find_model, lens_of
from cvtgs.io.cameras.views import Lens
from cvtgs.io.files import open_input


def read_cameras(path: Path) -> dict[int, Lens]:
    """Read ``cameras.txt``: number, model, width, height and parameters in a line."""
    lenses: dict[int, Lens] = {}
    with open_input(path) as file:
        for number, line in _lines(file):
            where = f"{path}: line {number}"
            if not line or line.startswith("#"):
                continue
            words = line.split()
            if len(words) < 4:
                raise _wrong(where, "a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", line)
            model = find_model(words[1], where)
            if len(words) != 4 + model.parameters:
                raise _wrong(where, f"{model.parameters} parameters of {words[1]}", line)
            try:
                camera, width, height = int(words[0]), int(words[2]), int(words[3])
                parameters = [float(word) for word in words[4:]]
            except ValueError as error:
                raise _wrong(where, "a camera in numbers", line) from error
            lenses[camera] = lens_of(model, parameters, width=width, height=height, where=where)
    return lenses


def read_images(path: Path) -> list[ColmapImage]:
    """Read ``images.txt``: a line with number, pose, camera and name, and a line of points."""
    images: list[ColmapImage] = []
    with open_input(path) as file:
        lines = _lines(file)
        for number, line in lines:
            if not line or line.startswith("#"):
                continue
            images.append(_image(line, f"{path}: line {number}"))
            number_of_points, points = next(lines, (number + 1, ""))
            if len(points.split()) % 3:
                raise _wrong(
                    f"{path}: line {number_of_points}",
                    f"the points of image {images[-1].name!r} as X Y POINT3D_ID, or empty",
                    points,
                )
    return images


def _image(line: str, where: str) -> ColmapImage:
    words = line.split(maxsplit=9)  # names may have blanks
    if len(words) != 10:
        raise _wrong(where, "an image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", line)
    try:
        pose = [float(word) for word in words[1:8]]
        camera = int(words[8])
    except ValueError as error:
        raise _wrong(where, "an image in numbers", line) from error
    return checked_image(words[9], camera, pose=pose, where=where)


def _lines(file: BinaryIO) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(file, start=1):
        yield number, os.fsdecode(line).strip()


def _wrong(where: str, required: str, line: str) -> FileFormatError:
    found = line if len(line) <= 60 else f"{line[:57]}..."
    return FileFormatError(f"{where}: must be {required}, found {found!r}.")
