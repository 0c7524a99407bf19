"""Points of the tessellation: the space in which Gaussians lie, and their weights."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.checks import checked
from cvtgs.counts import check_not_negative, check_share
from cvtgs.devices import row_chunks
from cvtgs.math.frames import RobustFrame
from cvtgs.math.spherical_harmonics import LARGEST_COLOR, SH_C0

CHUNK = 1 << 16  # Gaussians per chunk of the embedding, to bound memory
FARTHEST = 1e30  # limit of coordinates, in robust radii: flyaways must not overflow float32


@checked
def embed(
    means: Float[Tensor, "n 3"],
    sh0: Float[Tensor, "n 1 3"] | None = None,
    *,
    frame: RobustFrame,
    contraction: float = 0.0,
    color: float = 0.0,
) -> Float[Tensor, "n d"]:
    """Embed Gaussians in the space of the tessellation: position, and optionally colour.

    Args:
        means: Positions, scene units.
        sh0: Constant SH band; None leaves colour out.
        frame: Centre and radius of the scene.
        contraction: Strength of the contraction of positions beyond the robust radius, 0 to 1.
        color: Length of one unit of colour in robust radii; 0 leaves colour out.

    Returns:
        Coordinates in robust radii, in the dtype of ``means``; d = 3, or 6 with colour.

    Raises:
        InvalidArgumentError: ``contraction`` is not from 0 to 1, ``color`` is negative or not
            finite, or shapes or types do not fit.

    Example:
        >>> import torch
        >>> frame = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=2.0)
        >>> embed(torch.ones(1, 3), frame=frame).tolist()
        [[0.5, 0.5, 0.5]]
    """
    check_share(contraction, "contraction")
    check_not_negative(color, "color")
    colored = sh0 is not None and color > 0.0
    points = means.new_empty(len(means), 6 if colored else 3)
    for part in row_chunks(len(means), CHUNK, means.device):
        local = means[part]
        position = frame.contract(local, contraction) if contraction else frame.normalize(local)
        points[part, :3] = position.clamp_(-FARTHEST, FARTHEST)
        if sh0 is not None and colored:
            rgb = (SH_C0 * sh0[part, 0].double()).clamp(-0.5, LARGEST_COLOR - 0.5)
            points[part, 3:] = color * rgb
    return points


@checked
def gaussian_weights(
    opacities: Float[Tensor, "n"], areas: Float[Tensor, "n"], *, area_power: float
) -> Float[Tensor, "n"]:
    """Return opacity times area to a power: 0 is the opacity as in CVT-GS, 1 the mass.

    The mass estimates how much of an image a Gaussian paints. A power below 1 gives more cells to
    small Gaussians, which carry fine texture, at the expense of large, smooth surfaces.

    Args:
        opacities: Opacities.
        areas: Mean projected areas, any unit.
        area_power: The power, at least 0.

    Returns:
        Weights in float64.

    Raises:
        InvalidArgumentError: ``area_power`` is negative or not finite, or shapes or types do not
            fit.

    Example:
        >>> gaussian_weights(torch.tensor([0.5]), torch.tensor([4.0]), area_power=0.5).tolist()
        [1.0]
    """
    check_not_negative(area_power, "area_power")
    weights = opacities.double()
    return weights * areas**area_power if area_power else weights


@checked
def tessellation_weights(
    opacities: Float[Tensor, "n"], areas: Float[Tensor, "n"], *, area_power: float, floor: float
) -> Float[Tensor, "n"]:
    """Return the weight of every Gaussian.

    The weights of :func:`gaussian_weights` with mean 1, none below a floor.

    Args:
        opacities: Opacities.
        areas: Mean projected areas, any unit, possibly as seen from the middle of the scene.
        area_power: The weight is the opacity times the area to this power; 0 as in CVT-GS.
        floor: No weight is below this share of the mean weight.

    Returns:
        Weights in float64 with mean 1 (before the floor); 1 everywhere if all would be 0, or one is
        NaN.

    Raises:
        InvalidArgumentError: The floor or the power is below 0, or shapes do not fit.

    Example:
        >>> tessellation_weights(
        ...     torch.tensor([0.5, 0.5]), torch.tensor([1.0, 3.0]).double(),
        ...     area_power=1.0, floor=0.0,
        ... ).tolist()
        [0.5, 1.5]
    """
    check_not_negative(floor, "floor")
    if len(areas) == 0:
        return areas.double()
    largest_area = areas.amax().clamp_min(torch.finfo(torch.float64).tiny)
    raw = gaussian_weights(opacities, areas / largest_area, area_power=area_power)
    largest = raw.amax()
    scaled = raw / largest
    return torch.where(largest > 0, (scaled / scaled.mean()).clamp_min(floor), 1.0)
