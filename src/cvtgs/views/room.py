"""Whether a scene is a room that is seen from inside, and what encloses a point."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.math.frames import RobustFrame
from cvtgs.math.parameters import divide
from cvtgs.scene import GaussianScene
from cvtgs.views.up import Voxels

ENCLOSED = 0.7
"""A room hides this share of the upper half of what a camera in its middle could see."""

FREE = 0.12
"""Clearance that a camera needs, in robust radii."""

_NEAR = 2.2
"""Surfaces farther than this are not walls, in robust radii."""

_GROWS = 0.1
"""In a room the sizes of Gaussians grow with their distance by this correlation: what lies behind
the surfaces, where no image was taken, is large. In a hollow object they shrink."""

_FARTHEST = 6.0
_VISIBLE = 0.1
_MOST_POINTS = 10_000
_CELLS = 10
_LEAST_IN_CELL = 8
_BANDS = 5
_SECTORS = 12


class SizedPoints(NamedTuple):
    """The positions and mean log scales of the Gaussians that are not faint, float64."""

    means: Float[Tensor, "n 3"]
    log_sizes: Float[Tensor, "n"]


def sized_points(sample: GaussianScene) -> SizedPoints:
    """Return every k-th Gaussian that is not faint, at most 10,000."""
    rows = (sample.opacities > _VISIBLE).nonzero()[:, 0]
    rows = rows[:: max(1, -(-len(rows) // _MOST_POINTS))]
    return SizedPoints(sample.means[rows].double(), sample.log_scales[rows].double().mean(dim=1))


def find_room(
    voxels: Voxels,
    sized: SizedPoints,
    frame: RobustFrame,
    *,
    middle: Float[Tensor, "3"],
    up: Float[Tensor, "3"],
) -> Float[Tensor, "3"] | None:
    """Return the middle at the height of the eyes if there is room and surfaces are all around."""
    points = voxels.points
    if len(points) == 0:
        return None
    heights = points @ up
    low, high = heights.quantile(heights.new_tensor([0.02, 0.98])).tolist()
    center = middle - (middle @ up) * up
    steps = torch.linspace(-0.3, 0.3, 5, dtype=points.dtype)
    offsets = torch.cartesian_prod(steps, steps) @ torch.linalg.svd(up[None]).Vh[1:]
    lifts = torch.tensor([0.45, 0.55, 0.65], dtype=points.dtype) * (high - low) + low
    eyes = ((center + offsets)[:, None] + lifts[:, None] * up).reshape(-1, 3)
    clearance = torch.cdist(eyes, points).amin(dim=1)
    best = eyes[clearance.argmax()]
    if float(clearance.amax()) < FREE or enclosure(best, points, up) < ENCLOSED:
        return None
    if size_growth(sized, frame.center + frame.radius * best, frame.radius) < _GROWS:
        return None
    eye: Tensor = center + (0.58 * (high - low) + low) * up
    return eye


def enclosure(
    eye: Float[Tensor, "3"], points: Float[Tensor, "v 3"], up: Float[Tensor, "3"]
) -> float:
    """Return the share of the upper half of all directions in which there is a surface."""
    offsets = points - eye
    offsets = offsets[torch.linalg.vector_norm(offsets, dim=1) < _NEAR]
    directions = torch.nn.functional.normalize(offsets, dim=1)
    axes = torch.linalg.svd(up[None]).Vh[1:]
    rise = directions @ up
    x, y = (directions @ axes.T).unbind(1)
    sectors = ((torch.atan2(y, x) / math.tau + 0.5) * _SECTORS).long().clamp(0, _SECTORS - 1)
    bands = (rise * _BANDS).long().clamp(0, _BANDS - 1)  # bands of equal solid angle
    filled = torch.zeros(_BANDS, _SECTORS, dtype=torch.bool)
    filled[bands[rise > 0], sectors[rise > 0]] = True
    return float(filled.double().mean())


def size_growth(sized: SizedPoints, eye: Float[Tensor, "3"], radius: float) -> float:
    """Return the mean correlation of sizes with distances from a point, direction by direction."""
    offsets = sized.means - eye
    distances = torch.linalg.vector_norm(offsets, dim=1)
    near = (distances < _FARTHEST * radius) & (distances > 0)
    offsets, distances, sizes = offsets[near], distances[near].log(), sized.log_sizes[near]
    cells = _cells_of_cube(offsets)
    count = 6 * _CELLS**2
    numbers = torch.bincount(cells, minlength=count)

    def sums(values: Tensor) -> Tensor:
        return torch.bincount(cells, weights=values, minlength=count)

    distances = distances - divide(sums(distances), numbers.double())[cells]
    sizes = sizes - divide(sums(sizes), numbers.double())[cells]
    products = (sums(distances.square()) * sums(sizes.square())).sqrt()
    correlations = divide(sums(distances * sizes), products)
    enough = (numbers >= _LEAST_IN_CELL) & (products > 0)
    return float(correlations[enough].mean()) if bool(enough.any()) else 0.0


def _cells_of_cube(offsets: Float[Tensor, "n 3"]) -> Tensor:
    """Return the cell that each direction has on a cube around the point."""
    axes = offsets.abs().argmax(dim=1)
    depth = offsets.gather(1, axes[:, None])[:, 0]
    others = torch.stack(
        [
            torch.where(axes == 0, offsets[:, 1], offsets[:, 0]),
            torch.where(axes == 2, offsets[:, 1], offsets[:, 2]),
        ]
    )
    rows, columns = ((others / depth.abs() + 1) * 0.5 * _CELLS).long().clamp(0, _CELLS - 1)
    cells: Tensor = ((2 * axes + (depth > 0)) * _CELLS + rows) * _CELLS + columns
    return cells
