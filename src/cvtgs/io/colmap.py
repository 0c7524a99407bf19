"""Read sparse COLMAP models: a file of cameras and a file of images, binary or text."""

import codecs
import locale
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch

from cvtgs.errors import FileFormatError
from cvtgs.io.cameras import Lens, View, checked_lens
from cvtgs.io.files import is_file, open_input
from cvtgs.math import parameters
from cvtgs.text import MOST_LETTERS, printable, shortened, shown

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<iiQQ")
_IMAGE = struct.Struct("<i7di")
_POINT_BYTES = 24
_MAX_NAME = 4096


class _Image(NamedTuple):
    """A registered image, and the number of its camera."""

    name: str
    camera: int
    pose: Sequence[float]  # world to camera: a quaternion, w first, of any length, a translation


class _Model(NamedTuple):
    """A COLMAP camera model that a pinhole camera can replace."""

    parameters: int
    focals: int  # how many of the parameters are focal lengths


_MODELS: Mapping[str, _Model] = {
    "SIMPLE_PINHOLE": _Model(parameters=3, focals=1),
    "PINHOLE": _Model(parameters=4, focals=2),
    "SIMPLE_RADIAL": _Model(parameters=4, focals=1),
    "RADIAL": _Model(parameters=5, focals=1),
    "OPENCV": _Model(parameters=8, focals=2),
    "FULL_OPENCV": _Model(parameters=12, focals=2),
}
_NAMES = (  # of all models, by their numbers in binary files
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
    *("FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
)


def is_colmap(folder: Path) -> bool:
    """Return whether a folder holds a sparse model."""
    return any(is_file(folder / f"images.{suffix}") for suffix in ("bin", "txt"))


def colmap_views(folder: Path, *, as_text: bool = False) -> list[View]:
    """Read a sparse model; binary files take precedence, unless its text files are asked for."""
    path = folder / "images.bin"
    if is_file(path) and not as_text:
        lenses, images = _cameras_of_bin(folder / "cameras.bin"), _images_of_bin(path)
    else:
        path = folder / "images.txt"
        lenses, images = _cameras_of_txt(folder / "cameras.txt"), _images_of_txt(path)
    images.sort(key=lambda image: image.name)
    for before, image in pairwise(images):
        if image.name == before.name:
            raise FileFormatError(
                f"{path}: each image must have a name of its own, by which its photograph is "
                f"found, found {shown(image.name)} twice; remove one of them."
            )
    for image in images:
        if image.camera not in lenses:
            raise FileFormatError(
                f"{path}: image {shown(image.name)} must refer to a camera in the camera file, "
                f"found camera {image.camera}."
            )
    poses = np.array([image.pose for image in images], np.float64).reshape(-1, 7)
    viewmats = np.tile(np.eye(4), (len(images), 1, 1))
    viewmats[:, :3, :3] = parameters.rotation_matrices(torch.from_numpy(poses[:, :4])).numpy()
    viewmats[:, :3, 3] = poses[:, 4:]
    return [
        View(name=image.name, viewmat=viewmat, lens=lenses[image.camera])
        for image, viewmat in zip(images, viewmats, strict=True)
    ]


def _checked_image(name: str, camera: int, *, pose: Sequence[float], where: str) -> _Image:
    """Build an image; raise an error if its pose or name is invalid."""
    if not all(map(math.isfinite, pose)) or not any(pose[:4]):
        raise FileFormatError(
            f"{where}: the pose must be finite with a nonzero quaternion, "
            f"found {', '.join(f'{value:g}' for value in pose)}."
        )
    if not name:
        raise FileFormatError(f"{where}: the image must have a name, found none.")
    return _Image(name, camera, pose)


def _check_new(camera: int, lenses: Mapping[int, Lens], where: str) -> None:
    if camera in lenses:
        raise FileFormatError(
            f"{where}: each camera must have a number of its own, found {camera} again."
        )


def _find_model(name: str, where: str) -> _Model:
    if name not in _MODELS:
        raise FileFormatError(
            f"{where}: the camera model must be one of {', '.join(_MODELS)}, found "
            f"{shortened(printable(name), MOST_LETTERS)}; use colmap image_undistorter first."
        )
    return _MODELS[name]


def _lens_of(
    model: _Model, parameters: Sequence[float], *, width: int, height: int, where: str
) -> Lens:
    """Return the pinhole part of a camera."""
    fx, fy = parameters[0], parameters[model.focals - 1]
    cx, cy, *distortion = parameters[model.focals :]
    for value in distortion:
        if not math.isfinite(value):
            raise FileFormatError(f"{where}: the distortion must be finite, found {value}.")
    lens = Lens(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, distorted=any(distortion))
    return checked_lens(lens, where)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bytes:
    """A binary file whose reads are checked against its size."""

    file: BinaryIO
    path: Path

    def take(self, layout: struct.Struct, what: str) -> tuple[Any, ...]:
        self.check(layout.size, what)
        return layout.unpack(self.file.read(layout.size))

    def count(self, what: str, *, least: int) -> int:
        """Read a count of rows, and refuse it if the file is too short for them."""
        (count,) = self.take(_COUNT, f"the count of {what}")
        self.check(count * least, f"{count:,} {what}")
        return int(count)

    def name(self, what: str) -> str:
        """Read a text that ends with a zero byte."""
        start = self.file.tell()
        text, zero, _ = self.file.read(_MAX_NAME + 1).partition(b"\0")
        if not zero:
            raise FileFormatError(
                f"{self.path}: the name of {what} must end within {_MAX_NAME:,} bytes, "
                f"found no end."
            )
        self.file.seek(start + len(text) + 1)
        return _text_of(text)

    def check(self, size: int, what: str) -> None:
        left = os.fstat(self.file.fileno()).st_size - self.file.tell()
        if size > left:
            raise FileFormatError(
                f"{self.path}: the file is cut short: {what} must have {size:,} bytes, "
                f"found {left:,}."
            )


def _cameras_of_bin(path: Path) -> dict[int, Lens]:
    lenses: dict[int, Lens] = {}
    with open_input(path) as file:
        data = _Bytes(file=file, path=path)
        for row in range(data.count("cameras", least=_CAMERA.size)):
            camera, number, width, height = data.take(_CAMERA, f"camera {row}")
            where = f"{path}: camera {row}"
            _check_new(camera, lenses, where)
            is_known = 0 <= number < len(_NAMES)
            model = _find_model(_NAMES[number] if is_known else f"number {number}", where)
            layout = struct.Struct(f"<{model.parameters}d")
            parameters = data.take(layout, f"camera {row}")
            lenses[camera] = _lens_of(model, parameters, width=width, height=height, where=where)
    return lenses


def _images_of_bin(path: Path) -> list[_Image]:
    """Read ``images.bin``; the points of the images are skipped."""
    images: list[_Image] = []
    with open_input(path) as file:
        data = _Bytes(file=file, path=path)
        for row in range(data.count("images", least=_IMAGE.size + 1 + _COUNT.size)):
            _, *pose, camera = data.take(_IMAGE, f"image {row}")
            name = data.name(f"image {row}")
            images.append(_checked_image(name, camera, pose=pose, where=f"{path}: image {row}"))
            points = data.count(f"points of image {row}", least=_POINT_BYTES)
            file.seek(_POINT_BYTES * points, os.SEEK_CUR)
    return images


def _cameras_of_txt(path: Path) -> dict[int, Lens]:
    """Read ``cameras.txt``: each line has number, model, width, height and parameters."""
    lenses: dict[int, Lens] = {}
    with open_input(path) as file:
        for where, line in _lines(file, path):
            if not line or line.startswith("#"):
                continue
            words = line.split()
            if len(words) < 4:
                raise _wrong(where, "a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", line)
            model = _find_model(words[1], where)
            try:
                camera, width, height = int(words[0]), int(words[2]), int(words[3])
                parameters = [float(word) for word in words[4:]]
            except ValueError as error:
                raise _wrong(where, "a camera with numeric fields", line) from error
            _check_new(camera, lenses, where)
            if len(parameters) != model.parameters:
                raise _wrong(where, f"a {words[1]} camera with {model.parameters} parameters", line)
            lenses[camera] = _lens_of(model, parameters, width=width, height=height, where=where)
    return lenses


def _images_of_txt(path: Path) -> list[_Image]:
    """Read ``images.txt``: a line of number, pose, camera and name, then a line of points."""
    images: list[_Image] = []
    with open_input(path) as file:
        lines = _lines(file, path)
        for where, line in lines:
            if not line or line.startswith("#"):
                continue
            words = line.split(maxsplit=9)  # names may have blanks
            try:
                pose, camera, name = [float(word) for word in words[1:8]], int(words[8]), words[9]
            except (ValueError, IndexError) as error:
                required = "an image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
                raise _wrong(where, f"{required}, numeric but for the name", line) from error
            images.append(_checked_image(name, camera, pose=pose, where=where))
            place, points = next(lines, (where, ""))
            words = points.split()
            if len(words) % 3 or not all(word.lstrip("-").isdecimal() for word in words[2::3]):
                required = f"the points of image {shown(name)} as X Y POINT3D_ID, or empty"
                raise _wrong(place, required, points)
    return images


def _lines(file: BinaryIO, path: Path) -> Iterator[tuple[str, str]]:
    """Yield the lines and their places for errors."""
    for number, line in enumerate(file, start=1):
        text = line.removeprefix(codecs.BOM_UTF8) if number == 1 else line
        yield f"{path}: line {number}", _text_of(text).strip()


def _text_of(content: bytes) -> str:
    """Decode a name as this system names files; Windows has two encodings, and COLMAP uses both."""
    try:
        return os.fsdecode(content)
    except UnicodeDecodeError:  # not UTF-8, which Windows demands
        return content.decode(locale.getencoding(), "surrogateescape")


def _wrong(where: str, required: str, line: str) -> FileFormatError:
    return FileFormatError(f"{where}: must be {required}, found {shortened(line, MOST_LETTERS)!r}.")
