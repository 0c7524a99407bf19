"""What a Gaussian weighs in the tessellation."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.math.frames import RobustFrame


def tessellation_weights(
    opacities: Float[Tensor, "n"],
    areas: Float[Tensor, "n"],
    *,
    area_power: float,
    floor: float,
) -> Float[Tensor, "n"]:
    """Return the weight of every Gaussian.

    The mass (power 1) says how much of an image a Gaussian paints. A power below 1 gives small
    Gaussians, which carry fine texture, more cells at the cost of large, smooth surfaces.

    Args:
        opacities: Opacities.
        areas: Mean projected areas, any unit, possibly as they look from the middle.
        area_power: The weight is the opacity times the area to this power; 0 as in CVT-GS.
        floor: No weight is below this share of the mean weight.

    Returns:
        Weights in float64 with mean 1 (before the floor); all 1 if all would be 0.

    Example:
        >>> tessellation_weights(
        ...     torch.tensor([0.5, 0.5]), torch.tensor([1.0, 3.0]).double(),
        ...     area_power=1.0, floor=0.0,
        ... ).tolist()
        [0.5, 1.5]
    """
    raw = opacities.double()
    if area_power:
        raw = raw * (areas / areas.amax().clamp_min(torch.finfo(torch.float64).tiny)) ** area_power
    largest = raw.amax()
    if not bool(largest > 0):
        return torch.ones_like(raw)
    scaled = raw / largest
    return (scaled / scaled.mean()).clamp_min(floor)


def falloff(means: Float[Tensor, "n 3"], frame: RobustFrame) -> Float[Tensor, "n"]:
    """Return how much smaller a far Gaussian looks from the middle of the scene.

    Args:
        means: Positions, scene units.
        frame: Centre and radius of the scene.

    Returns:
        ``1 / max(1, d / R)^2`` in float64, with d the distance to the centre.

    Example:
        >>> frame = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=1.0)
        >>> falloff(torch.tensor([[2.0, 0, 0]]), frame).tolist()
        [0.25]
    """
    return frame.distances(means).clamp_min_(1.0).pow_(-2)
