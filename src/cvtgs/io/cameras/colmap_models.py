"""COLMAP's camera models, as far as pinhole cameras can stand for them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from cvtgs.errors import FileFormatError
from cvtgs.io.cameras.views import Lens, checked_lens


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """A camera model.

    Attributes:
        number: What binary files call it.
        parameters: How many it has: focal lengths, principal point, distortion.
        focals: How many of them are focal lengths, 1 or 2.
    """

    number: int
    parameters: int
    focals: int


MODELS: Mapping[str, Model] = MappingProxyType(
    {
        "SIMPLE_PINHOLE": Model(number=0, parameters=3, focals=1),
        "PINHOLE": Model(number=1, parameters=4, focals=2),
        "SIMPLE_RADIAL": Model(number=2, parameters=4, focals=1),
        "RADIAL": Model(number=3, parameters=5, focals=1),
        "OPENCV": Model(number=4, parameters=8, focals=2),
        "FULL_OPENCV": Model(number=6, parameters=12, focals=2),
    }
)

_OTHERS = {
    5: "OPENCV_FISHEYE",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
}


def model_name(number: int) -> str:
    """Return the name of the model that a binary file calls by number."""
    names = {model.number: name for name, model in MODELS.items()} | _OTHERS
    return names.get(number, f"number {number}")


def find_model(name: str, where: str) -> Model:
    """Look a model up."""
    if name not in MODELS:
        raise FileFormatError(
            f"{where}: the camera model must be one of {', '.join(MODELS)}, found {name}; "
            f"undistort the images first (colmap image_undistorter)."
        )
    return MODELS[name]


def lens_of(
    model: Model, parameters: Sequence[float], *, width: int, height: int, where: str
) -> Lens:
    """Take the pinhole part of a camera."""
    focals, rest = parameters[: model.focals], parameters[model.focals :]
    cx, cy, *distortion = rest
    for value in distortion:
        if not math.isfinite(value):
            raise FileFormatError(f"{where}: the distortion must be finite, found {value}.")
    lens = Lens(
        fx=focals[0],
        fy=focals[-1],
        cx=cx,
        cy=cy,
        width=width,
        height=height,
        distorted=any(value != 0 for value in distortion),
    )
    return checked_lens(lens, where)
