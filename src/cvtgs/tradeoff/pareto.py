"""The Pareto front: what nothing beats at once in cost and in gain."""

from collections.abc import Sequence


def on_front(costs: Sequence[float], gains: Sequence[float]) -> tuple[bool, ...]:
    """Report which of several choices no other beats.

    One beats another if it costs no more and gains no less, and is better in one of the two.

    Args:
        costs: What each costs; less is better.
        gains: What each gains, as many; more is better, and what is no number is never on it.

    Returns:
        Whether each is on the front.

    Example:
        >>> on_front([1.0, 2.0, 3.0], [20.0, 19.0, 25.0])
        (True, False, True)
    """
    pairs = list(zip(costs, gains, strict=True))
    return tuple(
        gain == gain and not any(_beats(other, (cost, gain)) for other in pairs)  # noqa: PLR0124
        for cost, gain in pairs
    )


def _beats(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one[0] <= other[0] and one[1] >= other[1] and one != other
