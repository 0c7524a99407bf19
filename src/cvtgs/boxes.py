"""Axis-aligned boxes, and masks of the Gaussians whose centres lie in them."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pydantic
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.errors import InvalidArgumentError, input_errors
from cvtgs.text import MOST_LETTERS, shortened, shown

__all__ = [
    "Box",
    "inside",
    "read_boxes",
]

Corner = tuple[float, float, float]


class Box(pydantic.BaseModel):
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

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    min: Corner
    max: Corner

    def __init__(self, /, **values: Any) -> None:
        try:
            super().__init__(**values)
        except pydantic.ValidationError:
            found = ", ".join(f"{name}={shown(value)}" for name, value in values.items())
            raise InvalidArgumentError(
                "a box must have a min and a max of three finite numbers each, min nowhere above "
                f"max, found {found or 'neither'}."
            ) from None

    # Boxes of files are checked without a call of __init__, so errors name the place in the file.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @pydantic.model_validator(mode="after")
    def _in_order(self) -> "Box":
        if any(low > high for low, high in zip(self.min, self.max, strict=True)):
            raise ValueError("min must not be above max")
        return self


def checked_box(low: Sequence[float], high: Sequence[float], name: str) -> Box:
    """Build a box from numbers that the user gave; errors mention the name of the option."""
    try:
        return Box.model_validate({"min": tuple(low), "max": tuple(high)})
    except pydantic.ValidationError as error:
        raise InvalidArgumentError(
            f"{name} must be six finite numbers, the smallest x, y, z and then the "
            f"largest, found {', '.join(f'{number:g}' for number in (*low, *high))}."
        ) from error


def read_boxes(path: str | os.PathLike[str]) -> tuple[Box, ...]:
    """Read boxes from a JSON file.

    Args:
        path: A file that holds ``{"min": [x, y, z], "max": [x, y, z]}``, or a list of these.

    Returns:
        The boxes, at least one.

    Raises:
        InputNotFoundError: There is no such file.
        InputError: The file cannot be read.
        InvalidArgumentError: The file holds something else.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "box.json"
        ...     _ = file.write_text('{"min": [0, 0, 0], "max": [1, 2, 3]}')
        ...     read_boxes(file)
        (Box(min=(0.0, 0.0, 0.0), max=(1.0, 2.0, 3.0)),)
    """
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


def inside(boxes: Sequence[Box], means: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Return a mask of the centres that lie in any of some boxes.

    Args:
        boxes: The boxes.
        means: Positions, scene units.

    Returns:
        The mask.

    Example:
        >>> box = Box(min=(0, 0, 0), max=(1, 1, 1))
        >>> inside([box], torch.tensor([[0.5, 0.5, 1.0], [2.0, 0, 0]])).tolist()
        [True, False]
    """
    found = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    for box in boxes:
        low, high = (means.new_tensor(corner) for corner in (box.min, box.max))
        found |= ((means >= low) & (means <= high)).all(dim=1)
    return found


def check_mask(keep: Tensor, count: int) -> None:
    """Raise unless a value is a mask of the ``count`` Gaussians of a scene."""
    if not isinstance(keep, Tensor) or keep.dtype != torch.bool or keep.shape != (count,):
        shape = f"{keep.dtype} {tuple(keep.shape)}" if isinstance(keep, Tensor) else repr(keep)
        raise InvalidArgumentError(
            f"keep must be a boolean tensor of shape ({count},), found {shape[:80]}."
        )


def check_room(kept: int, *, target: int, total: int) -> None:
    """Check that the target leaves at least one Gaussian for the unprotected ones, if any."""
    needed = kept + (1 if kept < total else 0)
    if kept and min(target, total) < needed:
        raise InvalidArgumentError(
            f"{kept:,} Gaussians are protected, so the target must be at least {needed:,} of the "
            f"{total:,} Gaussians (rho {needed / total:.4g} or more), found {target:,}."
        )
