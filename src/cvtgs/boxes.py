"""Boxes and spheres, and masks of the Gaussians whose centres lie in them."""

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Any

import numpy as np
import pydantic
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.checks import check_kinds
from cvtgs.counts import finite_numbers
from cvtgs.errors import InvalidArgumentError, check_path, input_errors
from cvtgs.text import MOST_LETTERS, counted, shortened, shown

__all__ = ["Box", "Sphere", "inside", "read_boxes"]

Corner = tuple[float, float, float]

MaskLike = Bool[Tensor, "n"] | NDArray[np.bool_] | Sequence[bool]
"""A mask of the Gaussians of a scene."""


class Box(pydantic.BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """An axis-aligned box, faces included.

    Attributes:
        min: Least coordinates, scene units.
        max: Largest coordinates, none below those of ``min``.

    Raises:
        InvalidArgumentError: A corner does not consist of three finite numbers, or ``min`` is above
            ``max``.

    Example:
        >>> Box(min=(0, 0, 0), max=(1, 1, 1)).max
        (1.0, 1.0, 1.0)
    """

    min: Corner
    max: Corner

    if not TYPE_CHECKING:  # or type checkers would accept any argument

        def __init__(self, /, **values: object) -> None:
            try:
                super().__init__(**values)
            except pydantic.ValidationError:
                found = ", ".join(f"{name}={shown(value)}" for name, value in values.items())
                raise InvalidArgumentError(
                    "a box must have a min and a max of three finite numbers each, min nowhere "
                    f"above max, found {found or 'neither'}."
                ) from None

        # Boxes of files are checked without a call of __init__, so errors name the place there.
        __init__.__pydantic_base_init__ = True

    @pydantic.model_validator(mode="after")
    def _in_order(self) -> "Box":
        if any(low > high for low, high in zip(self.min, self.max, strict=True)):
            raise ValueError("min must not be above max")
        return self


@dataclass(frozen=True, slots=True, kw_only=True)
class Sphere:
    """A ball, surface included.

    Attributes:
        center: Centre, scene units.
        radius: Radius, scene units, at least 0.

    Raises:
        InvalidArgumentError: A number is not finite, or the radius is negative.

    Example:
        >>> Sphere(center=(0.0, 0.0, 0.0), radius=1.0).radius
        1.0
    """

    center: Corner
    radius: float

    def __post_init__(self) -> None:
        center, radius = finite_numbers(self.center, 3), finite_numbers([self.radius], 1)
        if center is None or radius is None or radius[0] < 0:
            raise InvalidArgumentError(
                f"a sphere needs a centre of 3 finite numbers and a radius of at least 0, "
                f"found {shown(self.center)} and {shown(self.radius)}."
            )
        object.__setattr__(self, "center", center)
        object.__setattr__(self, "radius", radius[0])


def read_boxes(path: str | os.PathLike[str]) -> tuple[Box, ...]:
    """Read boxes from a JSON file.

    Args:
        path: A file that holds ``{"min": [x, y, z], "max": [x, y, z]}``, or a list of these.

    Returns:
        The boxes, at least one.

    Raises:
        InputNotFoundError: There is no such file.
        InputError: The file cannot be read.
        InvalidArgumentError: The file holds something else, or ``path`` is no path.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "box.json"
        ...     _ = file.write_text('{"min": [0, 0, 0], "max": [1, 2, 3]}')
        ...     read_boxes(file)
        (Box(min=(0.0, 0.0, 0.0), max=(1.0, 2.0, 3.0)),)
    """
    check_path(path)
    try:
        with input_errors(path):
            values = json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:  # RecursionError: lists nested too deeply
        raise InvalidArgumentError(f"{path}: must be valid JSON, found: {error}.") from None
    listed = values if isinstance(values, list) else [values]
    try:
        boxes = tuple(Box.model_validate(value) for value in listed)
    except pydantic.ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(str(part) for part in problem["loc"])
        where = shortened(where if where.isprintable() else repr(where), MOST_LETTERS)
        raise InvalidArgumentError(
            f'{path}: must hold boxes like {{"min": [x, y, z], "max": [x, y, z]}}; '
            f"{where + ': ' if where else ''}"
            f"{problem['msg'].lower().removeprefix('value error, ')}."
        ) from None
    if not boxes:
        raise InvalidArgumentError(f"{path}: must hold at least one box, found none.")
    return boxes


def inside(
    regions: Sequence[Box | Sphere] | Box | Sphere, means: Float[Tensor, "n 3"]
) -> Bool[Tensor, "n"]:
    """Return a mask of the centres that lie in any of some boxes and spheres.

    Args:
        regions: The boxes and spheres, or a single one.
        means: Positions, scene units.

    Returns:
        The mask.

    Raises:
        InvalidArgumentError: A region is something else, or positions are no floats of shape
            ``(n, 3)``.

    Example:
        >>> box = Box(min=(0, 0, 0), max=(1, 1, 1))
        >>> inside([box], torch.tensor([[0.5, 0.5, 1.0], [2.0, 0, 0]])).tolist()
        [True, False]
    """
    regions = listed(regions, Box | Sphere, required="regions must be boxes or spheres")
    check_kinds({"means": Float[Tensor, "n 3"]}, {"means": means})
    found = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    for region in regions:
        if isinstance(region, Box):
            low, high = (means.new_tensor(corner) for corner in (region.min, region.max))
            found |= ((means >= low) & (means <= high)).all(dim=1)
        else:
            away = means.double() - means.new_tensor(region.center, dtype=torch.float64)
            found |= away.square().sum(dim=1) <= region.radius * region.radius
    return found


def listed(values: Any, kinds: type | UnionType, *, required: str) -> list[Any]:
    """Return one value, or several, as a list; raise unless all are of some kinds."""
    several = isinstance(values, Iterable) and not isinstance(values, kinds)
    found = list(values) if several else [values]
    for value in found:
        if not isinstance(value, kinds):
            raise InvalidArgumentError(f"{required}, found {shown(value)}.")
    return found


def checked_mask(keep: MaskLike, count: int) -> Bool[Tensor, "n"]:
    """Return a mask of the ``count`` Gaussians of a scene as a tensor; raise if it is none."""
    mask: Tensor | None
    try:
        mask = keep if isinstance(keep, Tensor) else torch.from_numpy(np.array(keep, order="C"))
    except (TypeError, ValueError, RuntimeError):  # no array, or not one of numbers
        mask = None
    if mask is None or mask.dtype != torch.bool or mask.shape != (count,):
        found = shown(keep) if mask is None else f"{mask.dtype} {tuple(mask.shape)}"
        raise InvalidArgumentError(
            f"keep must be a boolean tensor of shape ({count},), found {found}."
        )
    return mask


def check_room(kept: int, *, target: int, total: int) -> None:
    """Check that the target leaves at least one Gaussian for the unprotected ones, if any."""
    needed = kept + (1 if kept < total else 0)
    if kept and min(target, total) < needed:
        raise InvalidArgumentError(
            f"{counted(kept, 'Gaussian')} {'is' if kept == 1 else 'are'} protected, so the target "
            f"must be at least {needed:,} of the {total:,} Gaussians (rho {needed / total:.4g} or "
            f"more), found {target:,}."
        )
