"""The surfaces of a scene as a few thousand points that count area, not Gaussians."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.math import parameters
from cvtgs.math.frames import RobustFrame
from cvtgs.math.parameters import divide
from cvtgs.math.segments import segment_sum
from cvtgs.scene import GaussianScene

REACH = 3.0
"""In robust radii: what lies beyond is not looked at."""

SIZE = 0.1
"""Edge of a voxel, in robust radii."""

OPAQUE = 0.3
"""A voxel whose Gaussians hide less than this together is empty."""

_FAINT_SHARE = 0.1
"""In faint scenes a voxel is empty below this share of what voxels hide on average, by mass."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Voxels:
    """Places where a scene has something to see; each stands for about the same area.

    Attributes:
        points: ``(v, 3)`` mean positions, in robust radii from the middle, float64.
        normals: ``(v, 3)`` directions in which the Gaussians there are thinnest, unit length.
    """

    points: Float[Tensor, "v 3"]
    normals: Float[Tensor, "v 3"]


def voxels_of(scene: GaussianScene, frame: RobustFrame) -> Voxels:
    """Gather the Gaussians near the middle in voxels."""
    places = frame.normalize(scene.means)
    near = (places.abs() < REACH).all(dim=1)
    part, places = scene.select(near), places[near]
    cells = ((places + REACH) / SIZE).long()
    side = round(2 * REACH / SIZE) + 1
    keys = (cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2]
    order = torch.sort(keys, stable=True).indices
    sizes = torch.unique_consecutive(keys[order], return_counts=True)[1]
    offsets = torch.cat([sizes.new_zeros(1), sizes.cumsum(0)])
    weights = part.opacities.double()[order]
    hidden = (part.masses / (SIZE * frame.radius) ** 2)[order]
    axes = _thinnest_axes(part)[order]
    totals = segment_sum(weights, offsets)
    means = segment_sum(weights[:, None] * places[order], offsets) / totals[:, None]
    spreads = weights[:, None, None] * axes[:, :, None] * axes[:, None, :]
    tensors = segment_sum(spreads.flatten(1), offsets).reshape(-1, 3, 3)
    amounts = segment_sum(hidden, offsets)
    typical = float(divide(amounts.square().sum(), amounts.sum()))
    seen = amounts > min(OPAQUE, _FAINT_SHARE * typical)
    normals = torch.linalg.eigh(tensors[seen]).eigenvectors[:, :, 2]
    return Voxels(points=means[seen], normals=normals)


def _thinnest_axes(scene: GaussianScene) -> Float[Tensor, "n 3"]:
    matrices = parameters.quats_to_matrices(parameters.normalize_quats(scene.quats.double()))
    thinnest = scene.log_scales.argmin(dim=1)
    return matrices.gather(2, thinnest[:, None, None].expand(-1, 3, 1))[:, :, 0]
