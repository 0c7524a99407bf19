"""The smallest number that is enough, by few tries."""

import math
from collections.abc import Callable, Iterator

CLOSE = 1.03
"""Ends when what is enough and what is not are closer than this factor."""

FIRST_SHARE = 0.1
STEP = 8.0
_SHORTEST = 0.15


def smallest_enough(
    reach: Callable[[int], float], wanted: float, *, most: int
) -> Iterator[tuple[int, float]]:
    """Find the smallest number whose value reaches what is wanted.

    Values should rise with the number; about linearly with its logarithm needs the fewest tries.
    The search starts at a tenth, steps by a factor of eight until it has an end that is enough and
    one that is not, and then interpolates on logarithms, but never leaves more than 85 % of the
    bracket (regula falsi held to bisection's guarantee, as Dekker 1969).
    """
    low, low_value = 0, -math.inf
    high, high_value = most + 1, math.inf
    count = max(1, min(most, round(FIRST_SHARE * most)))
    while True:
        value = reach(count)
        yield count, value
        if value >= wanted:
            high, high_value = count, value
        else:
            low, low_value = count, value
        if high - low <= 1 or (low > 0 and high <= most and high <= CLOSE * low):
            return
        if high > most:
            count = min(most, math.ceil(STEP * low))
        elif low == 0:
            count = max(1, int(high / STEP))
        else:
            count = _between((low, low_value), (high, high_value), wanted)


def _between(low: tuple[int, float], high: tuple[int, float], wanted: float) -> int:
    start, end = math.log(low[0]), math.log(high[0])
    rise = high[1] - low[1]
    share = (wanted - low[1]) / rise if 0 < rise < math.inf else 0.5
    share = min(max(share, _SHORTEST), 1 - _SHORTEST)
    count = round(math.exp(start + share * (end - start)))
    return min(max(count, low[0] + 1), high[0] - 1)
