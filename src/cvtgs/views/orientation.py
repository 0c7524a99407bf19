"""Which way is up in a scene, as far as the scene tells."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.views.voxels import SIZE, Voxels

_GUESSES = 256
_REFINED = 24
_MOST_VOXELS = 6000
_THICKNESS = SIZE
_ALIGNED = 0.85
_LEAST_SCORE = 0.12
"""What a ground must reach: its share of all voxels, times how round and how wide it is."""

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


class _Plane(NamedTuple):
    normal: Tensor
    height: float
    score: float


def find_up(voxels: Voxels, far: Float[Tensor, "k 3"]) -> Float[Tensor, "3"]:
    """Report which way is up.

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
    return -axis if _stands_on_its_head(voxels.points @ axis, at) else axis


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
    """Return the axis the sense that captures usually have: -y, else +z."""
    cosines = axis.new_tensor(_USUAL) @ axis
    # At right angles to both, either sense is as good: +x.
    senses = torch.cat([cosines[cosines.abs().argmax()][None], axis[:1]])
    return axis * torch.sign(senses[senses.abs() > 0][0])


def _stands_on_its_head(heights: Float[Tensor, "v"], ground: float) -> bool:
    """Return whether the scene says clearly that up is the other way."""
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
