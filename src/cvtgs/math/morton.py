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


def morton_order(
    points: Float[Tensor, "n 3"], ties: Float[Tensor, "n"] | None = None
) -> Int[Tensor, "n"]:
    """Order points along a Morton curve through their bounding cube (Morton 1966).

    Args:
        points: Finite positions, best without far outliers (2^21 steps span the cube).
        ties: Points of the same code come in ascending order of these, so that the order of the
            rows does not decide.

    Returns:
        Row numbers; what is equal in code and ties keeps its order.

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
    codes, order = torch.sort(code, stable=True)
    if ties is not None:
        same = torch.nn.functional.pad(codes[1:] == codes[:-1], (1, 1))
        places = (same[1:] | same[:-1]).nonzero()[:, 0]
        rows = order[places]
        rows = rows[torch.sort(ties[rows], stable=True).indices]
        order[places] = rows[torch.sort(code[rows], stable=True).indices]
    return order


def _spread_bits(values: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
    """Put two zero bits between any two of the 21 low bits."""
    for shift, mask in _SPREAD:
        values = (values | (values << shift)) & mask
    return values
