"""The space in which Gaussians are near or far: position, and a little colour."""

from jaxtyping import Float
from torch import Tensor

from cvtgs.math.frames import RobustFrame
from cvtgs.math.spherical_harmonics import SH_C0


def embed(
    means: Float[Tensor, "n 3"],
    sh0: Float[Tensor, "n 1 3"] | None = None,
    *,
    frame: RobustFrame,
    contraction: float = 0.0,
    color: float = 0.0,
) -> Float[Tensor, "n d"]:
    """Place Gaussians in the space of the tessellation.

    Args:
        means: Positions, scene units.
        sh0: Constant SH band; None leaves colour out.
        frame: Centre and radius of the scene.
        contraction: How much positions beyond the robust radius are pulled in, from 0 to 1.
        color: Length of one unit of colour in robust radii; 0 leaves colour out.

    Returns:
        Coordinates in robust radii, in the dtype of ``means``; d = 3, or 6 with colour.

    Example:
        >>> import torch
        >>> frame = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=2.0)
        >>> embed(torch.ones(1, 3), frame=frame).tolist()
        [[0.5, 0.5, 0.5]]
    """
    colored = sh0 is not None and color > 0.0
    points = means.new_empty(len(means), 6 if colored else 3)
    for start in range(0, len(means), CHUNK):
        part = slice(start, start + CHUNK)
        local = means[part]
        place = frame.contract(local, contraction) if contraction else frame.normalize(local)
        points[part, :3] = place.clamp_(-FARTHEST, FARTHEST)
        if sh0 is not None and colored:
            rgb = (SH_C0 * sh0[part, 0].double()).clamp(-0.5, 0.5 + COLOR_HEADROOM)
            points[part, 3:] = color * rgb
    return points


CHUNK = 1 << 16
"""Gaussians that are placed together, to bound memory."""

FARTHEST = 1e30
"""In robust radii: flyaways beyond are placed here, so that no float32 overflows."""

COLOR_HEADROOM = 0.5
"""Colours brighter than 1 plus this are treated as equally bright."""
