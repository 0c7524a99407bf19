"""Counts of Gaussians: parsed from ratios and texts, checked, split, and spread over rows."""

import math
import operator
import re
from collections.abc import Iterable, Sequence
from decimal import Decimal
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from cvtgs.errors import InvalidArgumentError
from cvtgs.text import shown

if TYPE_CHECKING:  # the command line reads ratios before it sets up and loads torch
    from torch import Tensor

_UNITS = {"": 1, "k": 1000, "m": 1_000_000}
_COUNT = re.compile(r"\s*(\d{1,3}(?:,\d{3})+|\d[\d_]*(?:\.\d+)?(?:e\+?\d\d?)?)\s*([km]?)\s*")


def read_ratio(text: str) -> float:
    """Parse a ratio such as ``0.05`` or ``5%``, which may be out of range."""
    match = re.fullmatch(
        r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d{1,5})?|nan|inf)\s*(%?)\s*", text, re.I
    )
    if not match:
        raise InvalidArgumentError(f"a ratio must be a number such as 0.05 or 5%, found {text!r}.")
    return float(Decimal(match[1]) / (100 if match[2] else 1))


def read_count(text: str) -> int:
    """Parse a number of Gaussians such as ``50,000``, ``5e4``, ``50k`` or ``1.5M``; at least 1."""
    match = _COUNT.fullmatch(text.lower())
    count = Decimal(match[1].replace(",", "")) * _UNITS[match[2]] if match else Decimal(0)
    if count < 1 or count != int(count):
        raise InvalidArgumentError(
            f"a count must be a whole number above 0 such as 50000, 50k or 1.5M, found {text!r}."
        )
    return int(count)


def target_count(
    total: int, rho: float | None = None, *, count: int | None = None, max_count: int | None = None
) -> int:
    """Return the number of Gaussians to keep.

    ``rho`` is taken as the decimal number that was written: 0.07 of 100 Gaussians are 7, although
    the nearest double times 100 is slightly more. The quotient of a count and N gives that count.

    Args:
        total: Number of Gaussians, N.
        rho: Ratio to keep, in (0, 1].
        count: Number to keep, 1 to N, instead of ``rho``.
        max_count: Maximum number to keep, instead of ``rho`` and ``count``.

    Returns:
        ``ceil(rho * N)``, or ``count``, or ``min(max_count, N)``.

    Raises:
        InvalidArgumentError: A value is out of range, or not exactly one of the three is given.

    Example:
        >>> target_count(250, 0.01), target_count(10, 1e-9)
        (3, 1)
    """
    total = checked_whole(total, "total", least=0)
    values = {"rho": rho, "count": count, "max_count": max_count}
    given = [name for name, value in values.items() if value is not None]
    if len(given) != 1:
        found = " and ".join(given) or "none"
        raise InvalidArgumentError(f"give one of rho, count and max_count, found {found}.")
    if max_count is not None:
        return min(checked_whole(max_count, "max_count"), total)
    if count is not None:
        number = whole_number(count)
        if not 1 <= number <= total:
            is_larger = number > total
            found = (
                f"{number:,}; max_count (--max-count) may be larger" if is_larger else repr(count)
            )
            raise InvalidArgumentError(
                f"count must be a whole number between 1 and the {total:,} Gaussians of the scene; "
                f"found {found}."
            )
        return number
    if rho is None or not 0.0 < real_number(rho) <= 1.0:
        kind = "" if type(rho) in (int, float) else "a number "
        raise InvalidArgumentError(f"rho must be {kind}above 0 and at most 1; found {rho!r}.")
    near = round(float(rho) * total)
    if near and near / total == float(rho):  # for example that of a report
        return near
    return math.ceil(Fraction(written(rho)) * total)


def written(number: "float | Tensor") -> str:
    """Return a number as it would be written, also one of numpy or torch in float32."""
    value: Any = number
    if hasattr(value, "detach"):  # a tensor
        value = value.detach().cpu()
        lacking = str(value.dtype) == "torch.bfloat16"  # in numpy
        value = (value.float() if lacking else value).numpy().reshape(())[()]
    return str(value) if "float" in type(value).__name__ else str(float(value))


def written_ratios(rhos: Iterable[float]) -> list[float]:
    """Return ratios as the decimal numbers that were written; raise unless all are in (0, 1]."""
    try:
        ratios = list(rhos)
    except TypeError:  # also a tensor of one number
        raise InvalidArgumentError(
            f"ratios must be a list of numbers, found {shown(rhos)}."
        ) from None
    for rho in ratios:
        target_count(1, rho)
    return [float(written(rho)) for rho in ratios]


def check_share(value: object, name: str) -> None:
    """Raise unless a value is a number from 0 to 1."""
    if not 0.0 <= real_number(value) <= 1.0:
        raise InvalidArgumentError(f"{name} must be a number from 0 to 1, found {shown(value)}.")


def check_not_negative(value: object, name: str) -> None:
    """Raise unless a value is a finite number of at least 0."""
    if not 0.0 <= real_number(value) < math.inf:
        raise InvalidArgumentError(
            f"{name} must be a finite number of at least 0, found {shown(value)}."
        )


def is_truth_value(value: object) -> bool:
    """Check whether a value is True or False, also one of numpy or torch."""
    return "bool" in type(value).__name__ or "bool" in str(getattr(value, "dtype", ""))


def real_number(value: object) -> float:
    """Return a number as a float; NaN for anything else, such as texts and truth values."""
    if isinstance(value, str | bytes | bytearray) or is_truth_value(value):
        return math.nan
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError, RuntimeError):  # a tensor of several numbers
        return math.nan


def finite_numbers(values: Iterable[float], count: int) -> tuple[float, ...] | None:
    """Return finite numbers of any type as floats; None if they are others."""
    try:
        numbers = () if isinstance(values, str | bytes) else tuple(map(real_number, values))
    except TypeError:  # a single value
        return None
    return numbers if len(numbers) == count and all(map(math.isfinite, numbers)) else None


def whole_number(number: object) -> int:
    """Return a whole number of any type, or -1 if it is none."""
    if is_truth_value(number) or not hasattr(number, "__index__"):
        return -1
    try:
        return operator.index(number)
    except TypeError:  # a tensor of several or fractional numbers
        return -1


def checked_whole(
    value: object, name: str, *, least: int = 1, most: int | None = None, things: str = ""
) -> int:
    """Return a whole number; raise unless it is from 1 or 0 to a limit, the count of ``things``."""
    number = whole_number(value)
    if number < least or (most is not None and number > most):
        limits = "above 0" if least else "at least 0"
        if most is not None:
            limits = f"between {least} and " + (f"the {most:,} {things}" if things else f"{most:,}")
        raise InvalidArgumentError(f"{name} must be a whole number {limits}, found {shown(value)}.")
    return number


def shortfall(valid: int, total: int, target: int) -> str:
    """Return the reason why fewer Gaussians are kept than asked for; empty if there is none."""
    return f"only {valid:,} of {total:,} Gaussians are valid" if valid < target else ""


def spread_rows(length: int, count: int) -> tuple[int, ...]:
    """Return ``count`` evenly spaced row numbers below a length, or all if it is shorter."""
    count = min(count, length)
    return tuple((k * length) // count for k in range(count))


def shared_out(total: int, shares: Sequence[float], *, rooms: Sequence[int]) -> list[int]:
    """Split a count in proportion to shares, at most a limit each, and at least 1 if that is not 0.

    The largest remainders, of equal ones the first, are rounded up.
    """
    least = [min(1, room) for room in rooms]
    if not sum(least) <= total <= sum(rooms):
        raise InvalidArgumentError(
            f"a count to split must be between {sum(least)} and {sum(rooms)}, found {total}."
        )
    exact = [Fraction(share) for share in shares]
    counts = dict[int, int]()
    while True:
        # A quota outside its limits is fixed at the nearest limit; the others share the rest.
        free = [k for k in range(len(rooms)) if k not in counts]
        left = total - sum(counts.values())
        weight = sum(exact[k] for k in free)
        quotas = {
            k: left * exact[k] / weight if weight else Fraction(left, len(free)) for k in free
        }
        high = {k: rooms[k] for k in free if quotas[k] > rooms[k]}
        low = {k: least[k] for k in free if quotas[k] < least[k]}
        if not high and not low:
            break
        over = sum(quotas[k] - end for k, end in high.items())
        under = sum(end - quotas[k] for k, end in low.items())
        counts |= high if over >= under else low
    counts |= {k: int(quotas[k]) for k in free}
    by_remainder = sorted(free, key=lambda k: counts[k] - quotas[k])
    for k in by_remainder[: total - sum(counts.values())]:
        counts[k] += 1
    return [counts[k] for k in range(len(rooms))]
