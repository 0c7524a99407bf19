"""Morton (Z-order) codes: neighbours in space become neighbours in memory."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

BITS = 21
"""Bits per axis; three axes fill a 63-bit code."""

_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(points: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """Order points along a Morton curve through their bounding cube (Morton 1966).

    Args:
        points: Finite positions, best without far outliers (2^21 steps span the cube).

    Returns:
        Row numbers; equal codes keep their order.

    Example:
        >>> morton_order(torch.tensor([[1.0, 1, 1], [0, 0, 0], [1, 0, 0]])).tolist()
        [1, 2, 0]
    """
    low = points.amin(dim=0)
    side = (points.amax(dim=0) - low).amax().clamp_min(torch.finfo(points.dtype).tiny)
    code = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    for axis in range(3):
        steps = ((points[:, axis] - low[axis]) / side * (2**BITS - 1)).to(torch.int64)
        code |= _spread_bits(steps) << axis
    return torch.sort(code, stable=True).indices


def _spread_bits(values: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
    """Put two zero bits between any two of the 21 low bits."""
    for shift, mask in _SPREAD:
        values = (values | (values << shift)) & mask
    return values
