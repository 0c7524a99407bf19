"""Where two pictures differ, as colours."""

import numpy as np
from jaxtyping import Float, UInt8

ERROR_SCALE = 0.3
"""The difference that gets the brightest colour; larger ones get it too."""

# Ten steps of "magma" (van der Walt and Smith 2015, CC0): equal steps look equally different.
_MAGMA = (
    (0, 0, 4),
    (24, 15, 62),
    (69, 16, 119),
    (114, 31, 129),
    (159, 47, 127),
    (205, 64, 113),
    (241, 96, 93),
    (253, 149, 103),
    (254, 201, 141),
    (252, 253, 191),
)


def error_map(
    one: UInt8[np.ndarray, "h w 3"], other: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Colour the difference of two pictures.

    Args:
        one: ``(h, w, 3)`` a picture.
        other: ``(h, w, 3)`` another of the same size.

    Returns:
        Colours of the root of the mean square difference over red, green and blue, from black
        (none) to light yellow (0.3 of the range and more).

    Example:
        >>> error_map(np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1, 3), np.uint8)).tolist()
        [[[0, 0, 4]]]
    """
    difference = (one.astype(np.float32) - other.astype(np.float32)) / 255
    return colored(np.sqrt(np.square(difference).mean(axis=2)) / ERROR_SCALE)


def colored(values: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Turn numbers into colours.

    Args:
        values: ``(h, w)`` numbers, clipped to [0, 1].

    Returns:
        ``(h, w, 3)`` colours, from black to light yellow.

    Example:
        >>> colored(np.ones((1, 1), np.float32)).tolist()
        [[[252, 253, 191]]]
    """
    places = np.linspace(0, 1, len(_MAGMA))
    steps = np.asarray(_MAGMA, dtype=np.float32)
    channels = [np.interp(values, places, steps[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=2).round().astype(np.uint8)


def css_gradient() -> str:
    """Give the colours as a CSS gradient from left to right.

    Returns:
        For example ``linear-gradient(90deg, rgb(0 0 4), rgb(252 253 191))``.

    Example:
        >>> css_gradient()[:36]
        'linear-gradient(90deg, rgb(0 0 4), r'
    """
    return f"linear-gradient(90deg, {', '.join(f'rgb({r} {g} {b})' for r, g, b in _MAGMA)})"
