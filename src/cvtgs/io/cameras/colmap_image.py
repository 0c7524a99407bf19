"""One registered image of a COLMAP model."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cvtgs.errors import FileFormatError


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapImage:
    """The pose of a photograph, from world to camera.

    Attributes:
        name: The photograph's name.
        camera: Number of its camera.
        quat: Rotation, w first; not zero, not necessarily of unit length.
        shift: Translation.
    """

    name: str
    camera: int
    quat: tuple[float, ...]
    shift: tuple[float, ...]


def checked_image(name: str, camera: int, *, pose: Sequence[float], where: str) -> ColmapImage:
    """Refuse poses that are none."""
    if not all(map(math.isfinite, pose)) or not any(pose[:4]):
        raise FileFormatError(
            f"{where}: the pose must be finite with a quaternion other than 0, "
            f"found {', '.join(f'{value:g}' for value in pose)}."
        )
    if not name:
        raise FileFormatError(f"{where}: the image must have a name, found none.")
    return ColmapImage(name=name, camera=camera, quat=tuple(pose[:4]), shift=tuple(pose[4:]))
