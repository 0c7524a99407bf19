"""How many Gaussians are left."""

import math
from collections.abc import Sequence
from fractions import Fraction

from cvtgs.errors import InvalidArgumentError


def target_count(total: int, rho: float | None, *, count: int | None = None) -> int:
    """Return the number of Gaussians to keep.

    ``rho`` is taken as the decimal number that was written: 0.07 of 100 Gaussians are 7, though
    the nearest double times 100 is a little more.

    Args:
        total: Number of Gaussians, N.
        rho: Ratio to keep, in (0, 1].
        count: Number to keep, 1 to N, instead of ``rho``.

    Returns:
        ``ceil(rho * N)``, or ``count``.

    Raises:
        InvalidArgumentError: Ratio or count is out of range, or both or neither are given.

    Example:
        >>> target_count(250, 0.01), target_count(10, 1e-9)
        (3, 1)
    """
    if (rho is None) == (count is None):
        raise InvalidArgumentError("give either rho or count, not both and not neither.")
    if count is not None:
        if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= total:
            raise InvalidArgumentError(
                f"count must be a whole number between 1 and the {total} Gaussians of the scene; "
                f"found {count!r}."
            )
        return count
    if not 0.0 < float(rho or 0.0) <= 1.0:
        raise InvalidArgumentError(f"rho must be above 0 and at most 1; found {rho!r}.")
    return math.ceil(Fraction(str(float(rho or 0.0))) * total)


def shortfall(valid: int, total: int, target: int) -> str:
    """Return why fewer Gaussians come out than asked for, or an empty text.

    Args:
        valid: Number of valid Gaussians.
        total: Number of Gaussians.
        target: Number of Gaussians to keep.

    Returns:
        One sentence without its full stop.

    Example:
        >>> shortfall(9, 10, 10)
        'only 9 of 10 Gaussians are valid'
    """
    return f"only {valid} of {total} Gaussians are valid" if valid < target else ""


def shared_out(total: int, shares: Sequence[float], *, rooms: Sequence[int]) -> list[int]:
    """Split a count in proportion to shares, by largest remainder, within what there is room for.

    Args:
        total: What to split; at least the number of rooms above 0, at most their sum.
        shares: Numbers, at least 0.
        rooms: The most that each may get; where it is not 0, at least 1 is given.

    Returns:
        One count per share; they add up to ``total``. Of equal remainders the first wins.

    Raises:
        InvalidArgumentError: The total cannot be split so.

    Example:
        >>> shared_out(10, [1.0, 1.0, 2.0], rooms=[9, 9, 9])
        [3, 2, 5]
        >>> shared_out(10, [0.0, 9.0, 1.0], rooms=[5, 3, 9])
        [1, 3, 6]
    """
    least = [min(1, room) for room in rooms]
    if not sum(least) <= total <= sum(rooms):
        raise InvalidArgumentError(
            f"a count to split must be between {sum(least)} and {sum(rooms)}, found {total}."
        )
    counts = list(least)
    exact = [Fraction(share) for share in shares]
    fixed: set[int] = set()
    while True:
        # Those whose quota lies outside their room get the nearest end of it; the others share.
        free = [k for k in range(len(rooms)) if k not in fixed]
        left = total - sum(counts[k] for k in fixed)
        weight = sum(exact[k] for k in free)
        quotas = {
            k: left * exact[k] / weight if weight else Fraction(left, len(free)) for k in free
        }
        high = [k for k in free if quotas[k] > rooms[k]]
        low = [k for k in free if quotas[k] < least[k]]
        over = sum(quotas[k] - rooms[k] for k in high)
        under = sum(least[k] - quotas[k] for k in low)
        if not high and not low:
            break
        ends = rooms if over >= under else least
        chosen = high if over >= under else low
        counts = [ends[k] if k in chosen else counts[k] for k in range(len(rooms))]
        fixed.update(chosen)
    for k in free:
        counts[k] = int(quotas[k])
    by_remainder = sorted(free, key=lambda k: counts[k] - quotas[k])
    for k in by_remainder[: total - sum(counts)]:
        counts[k] += 1
    return counts
