"""Real spherical harmonics in the order and scale that 3DGS files use."""

import math

from cvtgs.errors import InvalidArgumentError

SH_C0 = 0.5 / math.sqrt(math.pi)
"""The constant band: the colour of degree 0 is ``0.5 + SH_C0 * sh0``."""

REST_COUNTS = (0, 3, 8, 15)
"""Coefficients per colour channel above the constant band, by degree."""


def degree_of(rest_count: int) -> int:
    """Give the degree of a scene by its number of view-dependent coefficients per channel.

    Args:
        rest_count: Coefficients per channel above the constant one.

    Returns:
        The degree, 0 to 3.

    Raises:
        InvalidArgumentError: The number belongs to no degree.

    Example:
        >>> degree_of(15)
        3
    """
    if rest_count not in REST_COUNTS:
        raise InvalidArgumentError(
            f"a scene has 0, 3, 8 or 15 view-dependent SH coefficients per channel "
            f"(degree 0 to 3), found {rest_count}."
        )
    return REST_COUNTS.index(rest_count)
