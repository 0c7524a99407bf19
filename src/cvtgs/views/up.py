"""The surfaces of a scene as voxels, and the up direction and floor found from them."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.math import parameters
from cvtgs.math.frames import RobustFrame
from cvtgs.math.parameters import divide
from cvtgs.math.segments import segment_sum
from cvtgs.scene import GaussianScene

VOXEL_SIZE = 0.1  # edge of a voxel, in robust radii
_EXTENT = 3.0  # Gaussians farther than this from the middle along an axis, in radii, get no voxel
_OPAQUE = 0.3  # a voxel is empty if its Gaussians together cover less than this share of a face
_FAINT_SHARE = 0.1  # in faint scenes, a voxel is empty below this share of the weighted mean cover
_GUESSES = 256
_REFINED = 24
_MOST_VOXELS = 6000
_THICKNESS = VOXEL_SIZE
_ALIGNED = 0.85
_LEAST_SCORE = 0.12  # of a ground plane: its share of all voxels times its roundness and width

_USUAL = ((0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))  # up directions of captures
_USUAL_EVIDENCE = (0.5, 0.35, 0.35)  # their weights relative to evidence in the scene
_USUAL_BONUS = (1.5, 1.5, 1.25)
_USUAL_COSINE = 0.85
_SNAP_COSINE = 0.99  # 8 degrees
_COLUMN = 0.15  # width of the columns in which a floor is searched, in robust radii
_BARE = 0.25  # columns lower than this show a bare floor, in robust radii
_LEVEL = 0.7
_BENEATH = 3.0  # penalty factor of the share of voxels beneath a floor
_LEAST_FLOOR = 0.25  # least share of all columns that end on a floor
_PLANE_WEIGHT = 0.5  # of the score of the largest plane
_GROWTH_WEIGHT = 1.25
_MOST_GROWTH = 0.4
_LOW_WEIGHT = 0.3
_MOST_SKEWNESS = 0.5
_TRUSTED_FLOOR = 0.4  # share of bare columns, beyond that of the other side, at which sizes end
_SKY = 0.12  # distant content this far above the middle on average, relative to distance, is a sky
_SKY_WEIGHT = 0.6


class Voxels(NamedTuple):
    """Points on the surfaces of a scene; each represents about the same area."""

    points: Float[Tensor, "v 3"]  # mean positions, in robust radii from the middle, float64
    normals: Float[Tensor, "v 3"]  # mean thinnest axes of the Gaussians, unit length
    log_sizes: Float[Tensor, "v"]  # mean log scales of the Gaussians


def voxelize(scene: GaussianScene, frame: RobustFrame) -> Voxels:
    """Return the non-empty voxels of the Gaussians near the middle."""
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
    log_sizes = part.log_scales.double().mean(dim=1)[order]
    log_sizes = segment_sum(weights * log_sizes, offsets) / totals
    return Voxels(points=means[seen], normals=normals, log_sizes=log_sizes[seen])


def among_others(points: Float[Tensor, "v 3"]) -> Bool[Tensor, "v"]:
    """Return which voxels have at least two others within two steps along every axis."""
    side = round(2 * _EXTENT / VOXEL_SIZE) + 1
    cells = ((points + _EXTENT) / VOXEL_SIZE).long().clamp(0, side - 1)
    grid = torch.zeros(1, side, side, side, dtype=torch.float32, device="cpu")
    grid[0].index_put_(
        tuple(cells.T), torch.ones(len(cells), dtype=torch.float32, device="cpu"), accumulate=True
    )
    counts = 5**3 * torch.nn.functional.avg_pool3d(grid, 5, stride=1, padding=2)[0]
    return counts[tuple(cells.T)] > 2.5


def _thinnest_axes(scene: GaussianScene) -> Float[Tensor, "n 3"]:
    matrices = parameters.rotation_matrices(scene.quats.double())
    thinnest = scene.log_scales.argmin(dim=1)
    return matrices.gather(2, thinnest[:, None, None].expand(-1, 3, 1))[:, :, 0]


class _Plane(NamedTuple):
    normal: Tensor
    height: float
    score: float


class Floor(NamedTuple):
    """The level on which most columns of voxels end."""

    height: float  # along ``up``, in robust radii from the middle
    share: float  # of all columns that end on it, reduced if there are voxels beneath it
    bare: float  # the same for columns with nothing on the floor


def find_up(
    voxels: Voxels, far: Float[Tensor, "k 3"], *, enclosed: bool = False
) -> Float[Tensor, "3"]:
    """Return the up direction, a unit vector: one of the axes, or normal to the largest plane.

    Scores add up: how usual it is, a bare floor, a large plane, a sky on one side; without a bare
    floor also large Gaussians below, unseen by captures, and low heights, as things stand on wide
    feet. These two say nothing of an ``enclosed`` scene, which is seen from its middle.
    """
    usual = voxels.points.new_tensor(_USUAL)
    if len(voxels.points) < 8:
        return usual[0]
    voxels = _thinned(voxels)
    axes = torch.eye(3, dtype=usual.dtype, device="cpu")
    ups = torch.cat([axes, 0.0 - axes])
    ground = _ground(voxels)
    if ground is not None and float((ups @ ground.normal).amax()) < _SNAP_COSINE:
        ups = torch.cat([ups, ground.normal[None], -ground.normal[None]])
    evidence = (ups @ usual.T).clamp_min(0).square() * usual.new_tensor(_USUAL_EVIDENCE)
    bare = usual.new_tensor([_lowest_level(voxels, up).bare for up in ups])
    scores = evidence.amax(dim=1) + bare
    if ground is not None:
        is_near = (ups @ ground.normal).abs() > _SNAP_COSINE
        scores += _PLANE_WEIGHT * ground.score * is_near.to(scores)
    growth = (ups @ _growth(voxels)).clamp(-_MOST_GROWTH, _MOST_GROWTH)
    low = _skewness(voxels.points @ ups.T).clamp(-_MOST_SKEWNESS, _MOST_SKEWNESS)
    if not enclosed:
        clear = bare - bare[(ups @ ups.T).argmin(dim=1)]  # a thin scene is bare on both sides
        doubt = (1 - clear.amax() / _TRUSTED_FLOOR).clamp_min(0)
        scores += doubt * (_GROWTH_WEIGHT * growth + _LOW_WEIGHT * low)
    if len(far):
        scores += _SKY_WEIGHT * ((ups @ far.mean(dim=0)) / _SKY).clamp(-1, 1)
    best: Tensor = ups[scores.argmax()]
    return best


def find_floor(voxels: Voxels, up: Float[Tensor, "3"]) -> float | None:
    """Return the height of the floor along ``up``, in robust radii from the middle, or None."""
    if len(voxels.points) < 8:
        return None
    level = _lowest_level(_thinned(voxels), up)
    return level.height if level.share >= _LEAST_FLOOR else None


def _lowest_level(voxels: Voxels, up: Float[Tensor, "3"]) -> Floor:
    """Return the level on which most columns end; shares count columns with a level end."""
    heights = voxels.points @ up
    columns = ((voxels.points @ torch.linalg.svd(up[None]).Vh[1:].T) / _COLUMN).floor().long()
    columns -= columns.amin(dim=0)
    keys = columns[:, 0] * (int(columns[:, 1].amax()) + 1) + columns[:, 1]
    numbers, column = torch.unique(keys, return_inverse=True)
    ends = heights.new_zeros(len(numbers))
    low = ends.scatter_reduce(0, column, heights, "amin", include_self=False)
    high = ends.scatter_reduce(0, column, heights, "amax", include_self=False)
    lowest = heights <= low[column] + _THICKNESS
    level = (voxels.normals @ up).abs()[lowest]
    level = ends.scatter_reduce(0, column[lowest], level, "amax", include_self=False)
    order = torch.sort(low).values
    counts = torch.searchsorted(order, order + 2 * _THICKNESS) - torch.arange(
        len(order), device="cpu"
    )
    height = float(order[counts.argmax()]) + _THICKNESS
    ending = ((low - height).abs() <= _THICKNESS) & (level > _LEVEL)
    beneath = float((heights < height - 1.5 * _THICKNESS).double().mean())
    trust = max(0.0, 1 - _BENEATH * beneath)
    bare = ending & (high - low < _BARE)
    return Floor(height, trust * float(ending.double().mean()), trust * float(bare.double().mean()))


def _growth(voxels: Voxels) -> Float[Tensor, "3"]:
    """Return the negative correlation of the sizes of Gaussians with each coordinate."""
    sizes = voxels.log_sizes - voxels.log_sizes.mean()
    points = voxels.points - voxels.points.mean(dim=0)
    spread = sizes.square().sum().sqrt() * points.square().sum(dim=0).sqrt()
    return -divide((sizes[:, None] * points).sum(dim=0), spread)


def _skewness(heights: Float[Tensor, "v d"]) -> Float[Tensor, "d"]:
    """Return the skewness of heights along some directions, without stray ones."""
    low, high = heights.quantile(heights.new_tensor([0.02, 0.98]), dim=0)
    away = heights.clamp(low, high)
    away = away - away.mean(dim=0)
    return divide(away.pow(3).mean(dim=0), away.square().mean(dim=0).pow(1.5))


def _thinned(voxels: Voxels) -> Voxels:
    step = -(-len(voxels.points) // _MOST_VOXELS)
    return Voxels(*(part[::step] for part in voxels))


def _ground(voxels: Voxels) -> _Plane | None:
    """Return the largest plane, or None: guess from single voxels and refine the best guesses."""
    step = -(-len(voxels.points) // _GUESSES)
    normals, through = voxels.normals[::step], voxels.points[::step]
    heights = (normals * through).sum(dim=1)
    guesses = zip(normals, heights, strict=True)
    counts = torch.stack([_members(voxels, *guess).sum() for guess in guesses])
    best = torch.sort(counts, descending=True, stable=True).indices[:_REFINED]
    planes = [_refined(voxels, normals[row], float(heights[row])) for row in best.tolist()]
    largest = max(planes, key=lambda plane: plane.score * _bonus(plane.normal))
    return largest if largest.score * _bonus(largest.normal) >= _LEAST_SCORE else None


def _refined(voxels: Voxels, normal: Tensor, height: float) -> _Plane:
    spread = torch.zeros(3, dtype=normal.dtype, device="cpu")
    axes = torch.eye(3, dtype=normal.dtype, device="cpu")
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
