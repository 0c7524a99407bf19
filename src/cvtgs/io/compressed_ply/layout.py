"""Names and bit fields of compressed PLY files."""

import numpy as np
from jaxtyping import Float, UInt32

CHUNK_ROWS = 256
"""So many Gaussians share the ranges of a chunk."""

RANGES = tuple(
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
)
"""Properties of a chunk; the oldest files end before the colours."""

UNCOLORED = 12

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
"""Properties of a vertex, 32 bits each."""

THREE_BITS = (11, 10, 11)
"""Of positions and scales."""

COLOR_BITS = (8, 8, 8, 8)
"""Of red, green, blue and opacity."""

QUAT_BITS = (10, 10, 10)
"""Of the three smaller components of a rotation; the upper two bits say which is missing."""


def pack(
    fractions: Float[np.ndarray, "n k"], bits: tuple[int, ...], *, high: UInt32[np.ndarray, "n"]
) -> UInt32[np.ndarray, "n"]:
    """Put fractions side by side into 32 bits."""
    words = high
    for column, size in zip(fractions.T, bits, strict=True):
        most = (1 << size) - 1
        field = np.clip(np.floor(column * most + 0.5), 0, most).astype(np.uint32)
        words = (words << np.uint32(size)) | field
    return words


def unpack(words: UInt32[np.ndarray, "n"], bits: tuple[int, ...]) -> Float[np.ndarray, "n k"]:
    """Take fractions out of 32 bits, the inverse of :func:`pack`."""
    fractions = np.empty((len(words), len(bits)), np.float32)
    shift = sum(bits)
    for column, size in enumerate(bits):
        shift -= size
        most = (1 << size) - 1
        fractions[:, column] = ((words >> np.uint32(shift)) & np.uint32(most)) / np.float32(most)
    return fractions
