"""The space in which Gaussians are near or far: position, and a little colour."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.math.frames import RobustFrame
from cvtgs.math.spherical_harmonics import SH_C0


def embed(
    means: Float[Tensor, "n 3"],
    sh0: Float[Tensor, "n 1 3"],
    frame: RobustFrame,
    *,
    color: float,
    contracted: bool,
) -> Float[Tensor, "n d"]:
    """Place Gaussians in the space of the tessellation.

    Args:
        means: Positions, scene units.
        sh0: Constant SH band.
        frame: Centre and radius of the scene.
        color: Length of one unit of colour in robust radii; 0 leaves colour out.
        contracted: Whether positions beyond the robust radius are pulled in.

    Returns:
        float64 coordinates in robust radii; d = 3, or 6 with colour.

    Example:
        >>> frame = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=2.0)
        >>> embed(
        ...     torch.ones(1, 3), torch.zeros(1, 1, 3), frame, color=0.0, contracted=False
        ... ).tolist()
        [[0.5, 0.5, 0.5]]
    """
    position = frame.contract(means) if contracted else frame.normalize(means)
    if color == 0.0:
        return position
    rgb = (SH_C0 * sh0[:, 0].double()).clamp(-0.5, 0.5 + COLOR_HEADROOM)
    return torch.cat([position, color * rgb], dim=1)


COLOR_HEADROOM = 0.5
"""Colours brighter than 1 plus this are treated as equally bright."""
