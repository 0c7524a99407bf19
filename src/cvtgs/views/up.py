"""The surfaces of a scene as voxels, and which way is up among them."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.math import parameters
from cvtgs.math.frames import RobustFrame
from cvtgs.math.parameters import divide
from cvtgs.math.segments import segment_sum
from cvtgs.scene import GaussianScene

VOXEL_SIZE = 0.1
"""Edge of a voxel, in robust radii."""

_EXTENT = 3.0
"""Gaussians farther than this from the middle, in robust radii, are left out of the voxels."""

_OPAQUE = 0.3
"""A voxel whose Gaussians together hide less than this is empty."""

_FAINT_SHARE = 0.1
"""In faint scenes a voxel is empty below this share of what voxels hide on average, by mass."""

_GUESSES = 256
_REFINED = 24
_MOST_VOXELS = 6000
_THICKNESS = VOXEL_SIZE
_ALIGNED = 0.85
_LEAST_SCORE = 0.12
"""Least score of a ground: its share of all voxels, times how round and how wide it is."""

_ONE_SIDED = 0.6
"""Up is not as usual only if the ground has so much more above it than below."""

_TOP_HEAVY = 0.04
"""Or if what is between floor and ceiling stands this far from the middle, of their distance."""

_SKY = 0.12
"""What is far away is a sky if it lies this far above the middle on average, of its distance."""

_USUAL = ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
_USUAL_BONUS = (1.5, 1.25)
_USUAL_COSINE = 0.85
_SNAP_COSINE = 0.9954  # 5.5 degrees


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Voxels:
    """Points on the surfaces of a scene; each stands for about the same area.

    Attributes:
        points: ``(v, 3)`` mean positions, in robust radii from the middle, float64.
        normals: ``(v, 3)`` directions in which the Gaussians there are thinnest, unit length.
    """

    points: Float[Tensor, "v 3"]
    normals: Float[Tensor, "v 3"]


def voxelize(scene: GaussianScene, frame: RobustFrame) -> Voxels:
    """Return the voxels of the Gaussians near the middle that are not empty."""
    points = frame.normalize(scene.means)
    near = (points.abs() < _EXTENT).all(dim=1)
    part, points = scene.select(near), points[near]
    cells = ((points + _EXTENT) / VOXEL_SIZE).long()
    side = round(2 * _EXTENT / VOXEL_SIZE) + 1
    keys = (cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2]
    order = torch.sort(keys, stable=True).indices
    sizes = torch.unique_consecutive(keys[order], return_counts=True)[1]
    offsets = torch.cat([sizes.new_zeros(1), sizes.cumsum(0)])
    weights = part.opacities.double()[order]
    hidden = (part.masses / (VOXEL_SIZE * frame.radius) ** 2)[order]
    axes = _thinnest_axes(part)[order]
    totals = segment_sum(weights, offsets)
    means = segment_sum(weights[:, None] * points[order], offsets) / totals[:, None]
    spreads = weights[:, None, None] * axes[:, :, None] * axes[:, None, :]
    tensors = segment_sum(spreads.flatten(1), offsets).reshape(-1, 3, 3)
    amounts = segment_sum(hidden, offsets)
    typical = float(divide(amounts.square().sum(), amounts.sum()))
    seen = amounts > min(_OPAQUE, _FAINT_SHARE * typical)
    normals = torch.linalg.eigh(tensors[seen]).eigenvectors[:, :, 2]
    return Voxels(points=means[seen], normals=normals)


def _thinnest_axes(scene: GaussianScene) -> Float[Tensor, "n 3"]:
    matrices = parameters.rotation_matrices(scene.quats.double())
    thinnest = scene.log_scales.argmin(dim=1)
    return matrices.gather(2, thinnest[:, None, None].expand(-1, 3, 1))[:, :, 0]


class _Plane(NamedTuple):
    normal: Tensor
    height: float
    score: float


def find_up(voxels: Voxels, far: Float[Tensor, "k 3"]) -> Float[Tensor, "3"]:
    """Return the direction that is up, as a unit vector.

    The axis is at right angles to the ground, the plane with the largest area; planes that lie
    as captures usually have it (y-down, then z-up) are preferred where areas are similar. Up is
    as captures usually have it, -y or else +z, unless the scene hangs below its ground, or more
    below a ceiling than on a floor, or the sky is below. Without a ground, up is -y.
    """
    usual = voxels.points.new_tensor(_USUAL)
    if len(voxels.points) < 8:
        return usual[0]
    voxels = _thinned(voxels)
    ground = _ground(voxels)
    if ground is None:
        return usual[0]
    axis = _usual_sense(_snapped(ground.normal))
    at = ground.height * (1.0 if float(axis @ ground.normal) > 0 else -1.0)
    if len(far) and abs(float((far @ axis).mean())) > _SKY:
        return axis * torch.sign((far @ axis).mean())
    return -axis if _is_upside_down(voxels.points @ axis, at) else axis


def _thinned(voxels: Voxels) -> Voxels:
    step = -(-len(voxels.points) // _MOST_VOXELS)
    return Voxels(points=voxels.points[::step], normals=voxels.normals[::step])


def _ground(voxels: Voxels) -> _Plane | None:
    """Find the largest plane by guessing from single voxels and refining the best guesses."""
    step = -(-len(voxels.points) // _GUESSES)
    normals, through = voxels.normals[::step], voxels.points[::step]
    heights = (normals * through).sum(dim=1)
    counts = torch.stack(
        [
            _members(voxels, normal, height).sum()
            for normal, height in zip(normals, heights, strict=True)
        ]
    )
    best = torch.sort(counts, descending=True, stable=True).indices[:_REFINED]
    planes = [_refined(voxels, normals[row], float(heights[row])) for row in best.tolist()]
    largest = max(planes, key=lambda plane: plane.score * _bonus(plane.normal))
    return largest if largest.score * _bonus(largest.normal) >= _LEAST_SCORE else None


def _refined(voxels: Voxels, normal: Tensor, height: float) -> _Plane:
    spread = torch.zeros(3, dtype=normal.dtype)
    axes = torch.eye(3, dtype=normal.dtype)
    for _ in range(3):
        points = voxels.points[_members(voxels, normal, height)]
        if len(points) < 3:
            break
        middle = points.mean(dim=0)
        spread, axes = torch.linalg.eigh(_scatter(points))
        normal = axes[:, 0]
        height = float(middle @ normal)
    support = float(_members(voxels, normal, height).double().mean())
    heights = voxels.points @ normal
    for end in heights.quantile(heights.new_tensor([0.01, 0.99])).tolist():
        if abs(end - height) > 5 * _THICKNESS:
            support += 0.5 * float(_members(voxels, normal, end).double().mean())
    lengths = spread.clamp_min(0).sqrt()
    everything = (axes.T @ _scatter(voxels.points) @ axes).diagonal().clamp_min(1e-12).sqrt()
    roundness = float(lengths[1] / lengths[2].clamp_min(1e-6))
    width = float((lengths[1:] / everything[1:]).clamp(max=1).amin())
    return _Plane(normal, height, max(support * roundness * width**2, support**2))


def _scatter(points: Float[Tensor, "v 3"]) -> Float[Tensor, "3 3"]:
    away = points - points.mean(dim=0)
    return away.T @ away / len(points)


def _members(voxels: Voxels, normal: Tensor, height: Tensor | float) -> Bool[Tensor, "v"]:
    near = (voxels.points @ normal - height).abs() < _THICKNESS
    return near & ((voxels.normals @ normal).abs() > _ALIGNED)


def _bonus(normal: Tensor) -> float:
    cosines = (normal.new_tensor(_USUAL) @ normal).abs().tolist()
    bonuses = zip(cosines, _USUAL_BONUS, strict=True)
    return max([1.0, *(bonus for cosine, bonus in bonuses if cosine > _USUAL_COSINE)])


def _usual_sense(axis: Tensor) -> Tensor:
    """Return the axis or its opposite, whichever captures usually have: -y, else +z."""
    cosines = axis.new_tensor(_USUAL) @ axis
    # At right angles to both, either sense is as good: +x.
    senses = torch.cat([cosines[cosines.abs().argmax()][None], axis[:1]])
    return axis * torch.sign(senses[senses.abs() > 0][0])


def _is_upside_down(heights: Float[Tensor, "v"], ground: float) -> bool:
    """Return whether there is clear evidence that up is the other way."""
    low, high = heights.quantile(heights.new_tensor([0.01, 0.99])).tolist()
    opposite = low if abs(ground - high) < abs(ground - low) else high
    lid = float(((heights - opposite).abs() < _THICKNESS).double().mean())
    floor = float(((heights - ground).abs() < _THICKNESS).double().mean())
    if lid > 0.5 * floor and high - low > 5 * _THICKNESS:
        between = heights[(heights > low + 2 * _THICKNESS) & (heights < high - 2 * _THICKNESS)]
        lift = float(between.mean()) - 0.5 * (low + high) if len(between) else 0.0
        return bool(lift > _TOP_HEAVY * (high - low))
    above = float((heights > ground + 1.5 * _THICKNESS).double().mean())
    below = float((heights < ground - 1.5 * _THICKNESS).double().mean())
    return bool(below - above > _ONE_SIDED * (above + below))


def _snapped(normal: Tensor) -> Float[Tensor, "3"]:
    largest = normal.abs().argmax()
    if float(normal.abs()[largest]) < _SNAP_COSINE:
        return torch.nn.functional.normalize(normal, dim=0)
    axis = torch.zeros_like(normal)
    axis[largest] = torch.sign(normal[largest])
    return axis
