"""The editing options of ``cvtgs convert``, and the edits."""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cvtgs
from cvtgs.errors import InvalidArgumentError

if TYPE_CHECKING:
    from cvtgs.boxes import Box
    from cvtgs.edit import Motion
    from cvtgs.scene import GaussianScene

_NUMBERS = {
    "--crop-box": "six numbers x,y,z,X,Y,Z, the minimum and maximum coordinates",
    "--crop-sphere": "four numbers x,y,z,r, the centre and radius",
    "--rotate": "three numbers x,y,z, degrees about each axis",
    "--translate": "three numbers x,y,z",
}


def add_edit_options(parser: argparse.ArgumentParser) -> None:
    """Add the options, in the order in which they are applied."""
    group = parser.add_argument_group(
        "edits", "applied in this order, in PLY coordinates; rows that are kept do not change"
    )
    group.add_argument(
        "--merge",
        metavar="FILE",
        type=Path,
        action="append",
        default=[],
        help="scene to add to IN, in any format; can be repeated",
    )
    group.add_argument(
        "--crop-box",
        metavar="X,Y,Z,X,Y,Z",
        action="append",
        default=[],
        help="box to keep, by its minimum and maximum corner; with more than one region, "
        "Gaussians in any of them are kept",
    )
    group.add_argument(
        "--crop-sphere",
        metavar="X,Y,Z,R",
        action="append",
        default=[],
        help="sphere to keep, by its centre and radius",
    )
    group.add_argument(
        "--min-opacity", metavar="A", type=float, help="lowest opacity to keep, 0 to 1"
    )
    group.add_argument(
        "--max-size",
        metavar="S",
        type=float,
        help="largest standard deviation of a Gaussian to keep, scene units",
    )
    group.add_argument("--scale", metavar="F", type=float, help="scale factor of all lengths")
    group.add_argument(
        "--rotate",
        metavar="X,Y,Z",
        help="rotation in degrees about x, then y, then z, which also rotates the SH",
    )
    group.add_argument(
        "--translate", metavar="X,Y,Z", help="translation, after rotation and scaling"
    )


class SceneEdits:
    """The edits of a command line: checked on construction, applied to a scene later."""

    def __init__(self, options: argparse.Namespace) -> None:
        from cvtgs.boxes import checked_box
        from cvtgs.edit import Sphere

        self.regions: list[Box | Sphere] = []
        for text in options.crop_box:
            numbers = _numbers("--crop-box", text, 6)
            self.regions.append(checked_box(numbers[:3], numbers[3:], "--crop-box"))
        for text in options.crop_sphere:
            x, y, z, radius = _numbers("--crop-sphere", text, 4)
            self.regions.append(Sphere(center=(x, y, z), radius=radius))
        self.least, self.largest = options.min_opacity, options.max_size
        if self.least is not None and not 0 <= self.least <= 1:
            raise InvalidArgumentError(f"--min-opacity must be from 0 to 1, found {self.least}.")
        if self.largest is not None and not self.largest > 0:
            raise InvalidArgumentError(f"--max-size must be above 0, found {self.largest}.")
        self.motion = _motion(options)

    def apply(self, scene: "GaussianScene") -> "tuple[GaussianScene, list[str]]":
        """Return the edited scene, and one phrase for each kind of lost data."""
        from cvtgs.validity import lost_step

        phrases = []
        for phrase, smaller in self._filtered(scene):
            if len(smaller) < len(scene):
                phrases.append(f"{len(scene) - len(smaller):,} Gaussians ({phrase})")
            scene = smaller
        if len(scene) == 0:
            raise InvalidArgumentError(
                f"at least one Gaussian must be left to write, found none: {'; '.join(phrases)}."
            )
        if self.motion is not None:
            moved = cvtgs.edit.move(scene, self.motion)
            step = lost_step(moved)
            if step > lost_step(scene):
                phrases.append(f"digits of positions (steps of {step:.3g} so far from the origin)")
            scene = moved
        return scene, phrases

    def _filtered(self, scene: "GaussianScene") -> "Iterator[tuple[str, GaussianScene]]":
        if self.regions:
            scene = cvtgs.edit.crop(scene, self.regions)
            yield "outside --crop-box and --crop-sphere", scene
        if self.least is not None:
            scene = cvtgs.edit.drop_faint(scene, self.least)
            yield "below --min-opacity", scene
        if self.largest is not None:
            yield "above --max-size", cvtgs.edit.drop_large(scene, self.largest)


def _motion(options: argparse.Namespace) -> "Motion | None":
    from cvtgs.edit import Motion

    if options.scale is None and options.rotate is None and options.translate is None:
        return None
    if options.scale is not None and not 0 < options.scale < math.inf:
        raise InvalidArgumentError(f"--scale must be above 0 and finite, found {options.scale}.")
    a, b, c = _numbers("--rotate", options.rotate or "0,0,0", 3)
    x, y, z = _numbers("--translate", options.translate or "0,0,0", 3)
    return Motion.of_angles((a, b, c), scale=options.scale or 1.0, shift=(x, y, z))


def _numbers(name: str, text: str, count: int) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise InvalidArgumentError(f"{name} must be {_NUMBERS[name]}, found {text!r}.")
    return numbers
