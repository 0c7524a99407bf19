"""Widening: an opaque cell of many members must cover its cell, not only match its moments."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cells.moments import Members
from cvtgs.math.activations import opacity_from_optical_depth


def widening_factors(
    members: Members, depths: Float[Tensor, "m"], *, strength: float
) -> Float[Tensor, "m"]:
    """Give the factor by which the scales of every merged Gaussian grow.

    Args:
        members: Members of the cells.
        depths: Optical depths of the merged Gaussians, before widening.
        strength: The constant ``c`` of
            ``1 + c (1 - exp(-tau))^2 min(log10(n) / 2, 1)``; 0 widens nothing.

    Returns:
        Factors, at least 1; exactly 1 for cells of one member.
    """
    counts = members.offsets.diff().double()
    crowding = (torch.log10(counts) / 2).clamp_max(1.0)
    return 1 + strength * opacity_from_optical_depth(depths).square() * crowding
