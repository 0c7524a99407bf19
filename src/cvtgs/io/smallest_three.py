"""Unit quaternions without their largest component, as three formats store them."""

import numpy as np
from jaxtyping import Float, Int

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])

HALF_RANGE = np.float32(np.sqrt(0.5))
"""No other component is larger than this."""


def drop_largest(
    quats: Float[np.ndarray, "n 4"],
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Leave out the largest component, after making it positive."""
    rows = np.arange(len(quats))
    largest = np.abs(quats).argmax(axis=1)
    signs = np.where(quats[rows, largest] < 0, -1, 1).astype(quats.dtype)
    others = quats[rows[:, None], _OTHERS[largest]] * signs[:, None]
    return largest, others


def restore_largest(
    largest: Int[np.ndarray, "n"], others: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 4"]:
    """Put the largest component back, the inverse of :func:`drop_largest`."""
    quats = np.empty((len(others), 4), others.dtype)
    rows = np.arange(len(others))
    quats[rows[:, None], _OTHERS[largest]] = others
    squares = np.einsum("ij,ij->i", others, others)
    quats[rows, largest] = np.sqrt(np.maximum(1 - squares, 0))
    return quats
