"""Check arguments of public functions: types and shapes as annotated, ranges, selected rows."""

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from inspect import Parameter, signature
from types import NoneType, UnionType
from typing import Any, ParamSpec, TypeVar, get_args

import numpy as np
import torch
from jaxtyping import Int, jaxtyped
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.errors import InvalidArgumentError
from cvtgs.text import shown

Rows = slice | Sequence[int] | NDArray[Any] | Tensor  # or a mask
P = ParamSpec("P")
Result = TypeVar("Result")

_WORDS = {"Float": "floats", "Bool": "booleans", "Int": "signed integers", "Integer": "integers"}


def checked(function: Callable[P, Result]) -> Callable[P, Result]:
    """Check classes of arguments, and dtypes and shapes of tensors, as annotated; nothing waits."""
    given = {name: item.annotation for name, item in signature(function).parameters.items()}
    kinds = {name: kind for name, kind in given.items() if _is_class(kind)}

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> Result:
        check_kinds(kinds, dict(zip(given, args, strict=False)) | kwargs)
        return function(*args, **kwargs)

    return call


def check_kinds(kinds: Mapping[str, Any], values: Mapping[str, object]) -> None:
    """Raise unless named values are instances of classes, or tensors of shapes, of jaxtyping."""
    sizes: dict[str, int] = {}
    with jaxtyped("context"):
        for name, value in values.items():
            kind = kinds.get(name, object)
            if not isinstance(value, kind):
                accepted = get_args(kind) or [kind]
                wanted = " or ".join(dict.fromkeys(_in_words(one, sizes) for one in accepted))
                found = type(value).__name__
                if isinstance(value, Tensor):
                    found = f"{value.dtype} of shape {tuple(value.shape)}"
                raise InvalidArgumentError(f"{name} must be {wanted}, found {found}.")
            if isinstance(value, Tensor):  # a letter stands for one length in all arguments
                letters = getattr(kind, "dim_str", "").split()
                sizes |= dict(zip(letters, value.shape, strict=False))


def _is_class(annotation: object) -> bool:
    """Return whether an annotation names classes of libraries, or None, and nothing else."""
    classes = get_args(annotation) if isinstance(annotation, UnionType) else (annotation,)
    return annotation is not Parameter.empty and all(
        kind is NoneType or (isinstance(kind, type) and kind.__module__ != "builtins")
        for kind in classes
    )


def _in_words(kind: Any, sizes: Mapping[str, int]) -> str:
    if not hasattr(kind, "dim_str"):
        return "None" if kind is NoneType else f"of type {kind.__name__}"
    shape = ", ".join(str(sizes.get(letter, letter)) for letter in kind.dim_str.split())
    comma = "," if kind.dim_str and "," not in shape else ""
    return f"a tensor of {_WORDS[kind.__name__.partition('[')[0]]} of shape ({shape}{comma})"


def check_range(values: Tensor, most: float, name: str) -> None:
    """Raise unless all values are from 0 to a number; those on other devices than CPUs pass."""
    if values.device.type == "cpu" and len(values):
        low, high = map(Tensor.item, values.aminmax())
        if not (low >= 0 and high <= most):
            raise InvalidArgumentError(
                f"{name} must be between 0 and {most}, found {low} to {high}."
            )


def check_amounts(amounts: object, name: str, count: int, *, ignored: int = 0) -> None:
    """Raise unless all Gaussians but the first, ignored ones have a number of at least 0."""
    shape = tuple(amounts.shape) if isinstance(amounts, Tensor) else type(amounts).__name__
    if not isinstance(amounts, Tensor) or shape != (count,):
        raise InvalidArgumentError(
            f"{name} must be a tensor of one number for each of {count} Gaussians, found {shape}."
        )
    wrong = (~(amounts[ignored:] >= 0)).nonzero()[:, 0].tolist()  # NaN too
    if wrong:
        raise InvalidArgumentError(
            f"{name} must be at least 0; {len(wrong)} of {count} are not, the first is "
            f"{float(amounts[ignored + wrong[0]])} in row {ignored + wrong[0]}."
        )


def row_numbers(rows: Rows, count: int, *, things: str, device: torch.device) -> Int[Tensor, "m"]:
    """Return the numbers of selected rows, from 0 on; negative ones count from the end.

    Errors name them ``things``. Numbers on other devices than CPUs are not checked: it would wait.
    """
    if isinstance(rows, slice):
        these = range(count)[rows]
        stop = these.start + len(these) * these.step
        return torch.arange(these.start, stop, these.step, device=device)
    if isinstance(rows, int | str) or getattr(rows, "ndim", 1) != 1:
        single = f"; write [{rows}] for a single one" if isinstance(rows, int) else ""
        raise _row_error(rows, things, single)
    if isinstance(rows, np.ndarray):  # torch takes no reversed arrays and no foreign byte order
        rows = np.ascontiguousarray(rows, rows.dtype.newbyteorder("="))
    try:
        picked = torch.as_tensor(rows, device=device)
    except (TypeError, ValueError, RuntimeError):
        raise _row_error(rows, things) from None
    if picked.ndim != 1 and picked.numel():  # such as a single number
        raise _row_error(rows, things)
    if picked.dtype in (torch.bool, torch.uint8):
        return _rows_of_mask(picked, count, things)
    if len(picked) and (picked.is_floating_point() or picked.is_complex()):
        raise _row_error(rows, things)
    if picked.dtype not in (torch.int32, torch.int64):
        picked = picked.to(torch.int64)
    if device.type == "cpu" and len(picked):
        low, high = map(int, picked.aminmax())
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


def _row_error(rows: object, things: str, hint: str = "") -> InvalidArgumentError:
    return InvalidArgumentError(
        f"rows of {things} must be a slice, a mask or row numbers, found {shown(rows)}{hint}."
    )
