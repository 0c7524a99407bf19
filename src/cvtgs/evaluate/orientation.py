"""Which way is up in a scene, as far as the scene tells."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.evaluate.voxels import SIZE, Voxels
from cvtgs.math.activations import divide

_GUESSES = 256
_REFINED = 24
_MOST_VOXELS = 6000
_THICKNESS = SIZE
_ALIGNED = 0.85
_LEAST_SUPPORT = 0.08
"""Share of all voxels that a ground must hold."""

_FLAT = 0.25
"""A scene whose smallest variance is below this share of the next lies flat."""

_LEVEL = 0.02
"""Mass that lies this near the middle of its height tells nothing about up and down."""

_USUAL = ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
_USUAL_BONUS = (1.5, 1.25)
_USUAL_COSINE = 0.85
_SNAP_COSINE = 0.9986  # 3 degrees


class _Plane(NamedTuple):
    normal: Tensor
    height: float
    support: float


def find_up(voxels: Voxels) -> Float[Tensor, "3"]:
    """Say which way is up.

    The axis is at right angles to the ground, the plane with the largest area; planes that lie as
    captures usually have it (y-down, then z-up) are preferred where areas are similar. Without a
    ground it is the direction in which the scene is flat. Up is where the ground has the scene on
    it; between a floor and a ceiling it is away from the one that has more standing on it.
    Without any evidence, up is -y.

    Args:
        voxels: The surfaces of the scene.

    Returns:
        A unit vector, float64; exactly along a coordinate axis if within 3 degrees of one.

    Example:
        >>> from cvtgs.evaluate.voxels import voxels_of
        >>> from cvtgs.math.frames import robust_frame
        >>> from cvtgs.synthetic import demo_scene
        >>> scene = demo_scene(3000)
        >>> [round(part) for part in find_up(voxels_of(scene, robust_frame(scene.means))).tolist()]
        [0, -1, 0]
    """
    usual = voxels.points.new_tensor(_USUAL)
    if len(voxels.points) < 8:
        return usual[0]
    voxels = _thinned(voxels)
    ground = _ground(voxels)
    if ground is None:
        return _by_flatness(voxels.points)
    axis = _snapped(ground.normal)
    evidence = _evidence_of_up(voxels.points, axis, ground)
    if abs(evidence) < _LEVEL:
        evidence = float((usual @ axis).abs().argmax() == 0) * float(axis @ usual[0])
        evidence = evidence or float(axis @ usual[1]) or 1.0
    return axis * (1.0 if evidence > 0 else -1.0)


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
    largest = max(planes, key=lambda plane: plane.support * _bonus(plane.normal))
    return largest if largest.support >= _LEAST_SUPPORT else None


def _refined(voxels: Voxels, normal: Tensor, height: float) -> _Plane:
    for _ in range(3):
        members = _members(voxels, normal, height)
        if int(members.sum()) < 3:
            break
        points = voxels.points[members]
        middle = points.mean(dim=0)
        normal = torch.linalg.eigh((points - middle).T @ (points - middle)).eigenvectors[:, 0]
        height = float(middle @ normal)
    return _Plane(normal, height, float(_members(voxels, normal, height).double().mean()))


def _members(voxels: Voxels, normal: Tensor, height: Tensor | float) -> Bool[Tensor, "v"]:
    near = (voxels.points @ normal - height).abs() < _THICKNESS
    return near & ((voxels.normals @ normal).abs() > _ALIGNED)


def _bonus(normal: Tensor) -> float:
    cosines = (normal.new_tensor(_USUAL) @ normal).abs().tolist()
    bonuses = zip(cosines, _USUAL_BONUS, strict=True)
    return max([1.0, *(bonus for cosine, bonus in bonuses if cosine > _USUAL_COSINE)])


def _evidence_of_up(points: Tensor, axis: Tensor, ground: _Plane) -> float:
    """Give a number whose sign says whether the axis points up, and whose size how sure that is."""
    heights = points @ axis
    at = ground.height * (1.0 if float(axis @ ground.normal) > 0 else -1.0)
    above = float((heights > at + 1.5 * _THICKNESS).double().mean())
    below = float((heights < at - 1.5 * _THICKNESS).double().mean())
    side = float(divide(heights.new_tensor(above - below), heights.new_tensor(above + below)))
    low, high = heights.quantile(heights.new_tensor([0.01, 0.99], dtype=heights.dtype)).tolist()
    opposite = low if abs(at - high) < abs(at - low) else high
    lid = float(((heights - opposite).abs() < 1.5 * _THICKNESS).double().mean())
    if lid < 0.5 * ground.support:
        return side
    between = heights[(heights > low + 2 * _THICKNESS) & (heights < high - 2 * _THICKNESS)]
    if len(between) == 0:
        return 0.0
    return (0.5 * (low + high) - float(between.mean())) / max(high - low, 1e-9)


def _by_flatness(points: Tensor) -> Float[Tensor, "3"]:
    middle = points.median(dim=0).values
    values, vectors = torch.linalg.eigh((points - middle).T @ (points - middle))
    usual = points.new_tensor(_USUAL)
    if float(values[0]) > _FLAT * float(values[1]):
        return usual[0]
    axis = _snapped(vectors[:, 0])
    cosines = usual @ axis
    return axis * torch.sign(cosines[cosines.abs().argmax()])


def _snapped(normal: Tensor) -> Float[Tensor, "3"]:
    largest = normal.abs().argmax()
    if float(normal.abs()[largest]) < _SNAP_COSINE:
        return torch.nn.functional.normalize(normal, dim=0)
    axis = torch.zeros_like(normal)
    axis[largest] = torch.sign(normal[largest])
    return axis
