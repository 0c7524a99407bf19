"""Row numbers that slices, masks and numbers stand for, in scenes and cameras."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from cvtgs.errors import InvalidArgumentError
from cvtgs.text import shown


def spread_rows(length: int, count: int) -> tuple[int, ...]:
    """Return ``count`` evenly spaced row numbers below a length, or all if it is shorter."""
    count = min(count, length)
    return tuple((k * length) // count for k in range(count))


def row_numbers(
    rows: slice | Sequence[int] | Tensor, count: int, *, things: str, device: torch.device
) -> Int[Tensor, "m"]:
    """Return the numbers of the selected rows, from 0 on, as int32 or int64.

    ``rows`` is a slice, a mask, or row numbers, of which negative ones count from the end.
    ``things`` names them in errors. Numbers on other devices than CPUs are not checked, since that
    would wait for the device.
    """
    if isinstance(rows, slice):
        these = range(count)[rows]
        stop = these.start + len(these) * these.step
        return torch.arange(these.start, stop, these.step, device=device)
    if isinstance(rows, int | str) or getattr(rows, "ndim", 1) != 1:
        single = f"; write [{rows}] for a single one" if isinstance(rows, int) else ""
        raise _error(rows, things, single)
    if isinstance(rows, np.ndarray):  # torch takes no reversed arrays and no foreign byte order
        rows = np.ascontiguousarray(rows, rows.dtype.newbyteorder("="))
    try:
        picked = torch.as_tensor(rows, device=device)
    except (TypeError, ValueError, RuntimeError):
        raise _error(rows, things) from None
    if picked.ndim != 1 and picked.numel():  # such as a single number
        raise _error(rows, things)
    if picked.dtype in (torch.bool, torch.uint8):
        return _rows_of_mask(picked, count, things)
    if len(picked) and (picked.is_floating_point() or picked.is_complex()):
        raise _error(rows, things)
    if picked.dtype not in (torch.int32, torch.int64):
        picked = picked.to(torch.int64)
    if device.type == "cpu" and len(picked):
        low, high = (int(end) for end in picked.aminmax())
        if low < -count or high >= count:
            raise InvalidArgumentError(
                f"row numbers of {count:,} {things} must be from {-count} to {count - 1}, "
                f"found {low if low < -count else high}."
            )
        if low >= 0:
            return picked
    return torch.where(picked < 0, picked + count, picked)


def _rows_of_mask(mask: Tensor, count: int, things: str) -> Int[Tensor, "m"]:
    if mask.dtype == torch.uint8:  # a mask in torch, row numbers in numpy
        raise InvalidArgumentError(
            f"a mask of {things} must be bool, and row numbers int32 or int64, found uint8."
        )
    if len(mask) != count:
        raise InvalidArgumentError(
            f"a mask must have an entry for each of {count:,} {things}, found {len(mask):,}."
        )
    return mask.nonzero()[:, 0]


def _error(rows: object, things: str, hint: str = "") -> InvalidArgumentError:
    return InvalidArgumentError(
        f"rows of {things} must be a slice, a mask or row numbers, found {shown(rows)}{hint}."
    )
