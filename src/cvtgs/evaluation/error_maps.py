"""Where two images differ, as colours."""

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
    """Colour the difference of two images."""
    difference = (one.astype(np.float32) - other.astype(np.float32)) / 255
    return colored(np.sqrt(np.square(difference).mean(axis=2)) / ERROR_SCALE)


def colored(values: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Turn numbers into colours."""
    places = np.linspace(0, 1, len(_MAGMA))
    steps = np.asarray(_MAGMA, dtype=np.float32)
    channels = [np.interp(values, places, steps[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=2).round().astype(np.uint8)


def css_gradient() -> str:
    """Return the colours as a CSS gradient from left to right."""
    return f"linear-gradient(90deg, {', '.join(f'rgb({r} {g} {b})' for r, g, b in _MAGMA)})"
