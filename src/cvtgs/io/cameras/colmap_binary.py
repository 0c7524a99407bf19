"""COLMAP's ``cameras.bin`` and ``images.bin``."""

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from cvtgs.errors import FileFormatError
from cvtgs.io.cameras.colmap_image import ColmapImage, checked_image
from cvtgs.io.cameras.colmap_models import find_model, lens_of, model_name
from cvtgs.io.cameras.views import Lens
from cvtgs.io.files import open_input

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<iiQQ")
_IMAGE = struct.Struct("<i7di")
_POINT_BYTES = 24
_MAX_NAME = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bytes:
    """A binary file that never reads more than there is.

    Attributes:
        file: The open file.
        size: Its bytes.
        path: Its name, for error texts.
    """

    file: BinaryIO
    size: int
    path: Path

    def left(self) -> int:
        return self.size - self.file.tell()

    def take(self, layout: struct.Struct, what: str) -> tuple[Any, ...]:
        self.check(layout.size, what)
        return layout.unpack(self.file.read(layout.size))

    def count(self, what: str, *, least: int) -> int:
        """Read a count of rows, and refuse it where the file is too short for them."""
        (count,) = self.take(_COUNT, f"the count of {what}")
        self.check(count * least, f"{count:,} {what}")
        return int(count)

    def skip(self, size: int) -> None:
        self.file.seek(size, os.SEEK_CUR)

    def name(self, what: str) -> str:
        """Read a text that ends in a zero byte."""
        start = self.file.tell()
        text, zero, _ = self.file.read(_MAX_NAME + 1).partition(b"\0")
        if not zero:
            raise FileFormatError(
                f"{self.path}: the name of {what} must end within {_MAX_NAME:,} bytes, "
                f"found no end."
            )
        self.file.seek(start + len(text) + 1)
        return os.fsdecode(text)

    def check(self, size: int, what: str) -> None:
        if size > self.left():
            raise FileFormatError(
                f"{self.path}: the file is cut short: {what} must have {size:,} bytes, "
                f"found {self.left():,}."
            )


def read_cameras(path: Path) -> dict[int, Lens]:
    """Read ``cameras.bin``."""
    lenses: dict[int, Lens] = {}
    with open_input(path) as file:
        data = _Bytes(file=file, size=os.fstat(file.fileno()).st_size, path=path)
        for row in range(data.count("cameras", least=_CAMERA.size)):
            camera, number, width, height = data.take(_CAMERA, f"camera {row}")
            where = f"{path}: camera {row}"
            model = find_model(model_name(number), where)
            layout = struct.Struct(f"<{model.parameters}d")
            parameters = data.take(layout, f"camera {row}")
            lenses[camera] = lens_of(model, parameters, width=width, height=height, where=where)
    return lenses


def read_images(path: Path) -> list[ColmapImage]:
    """Read ``images.bin``; the points in the images are skipped."""
    images: list[ColmapImage] = []
    with open_input(path) as file:
        data = _Bytes(file=file, size=os.fstat(file.fileno()).st_size, path=path)
        for row in range(data.count("images", least=_IMAGE.size + 1 + _COUNT.size)):
            _, *pose, camera = data.take(_IMAGE, f"image {row}")
            name = data.name(f"image {row}")
            images.append(checked_image(name, camera, pose=pose, where=f"{path}: image {row}"))
            data.skip(_POINT_BYTES * data.count(f"points of image {row}", least=_POINT_BYTES))
    return images
