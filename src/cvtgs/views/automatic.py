"""Automatic views: cameras for a scene of which nothing is layout."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.devices import one_thread
from cvtgs.errors import InvalidArgumentError
from cvtgs.scene import SceneLike, as_scene
from cvtgs.views.candidates import CandidateCameras, inside_candidates, outside_candidates
from cvtgs.views.layout import SceneLayout, find_layout
from cvtgs.views.scoring import score_cameras

_ENCLOSED = 0.7
"""A room hides this share of the upper half of what a camera in its middle could see."""

_WITHIN = 0.5
"""From within a room this share of what is visible from around it is visible; in a vase, less."""

_NEAR = 2.2
"""Surfaces farther than this are not walls, in robust radii."""

_FREE = 0.12
"""Clearance that a camera needs, in robust radii."""

_BANDS = 5
_SECTORS = 12
_COMPARED = 6
_COMPARED_SIZE = (64, 64)
_GOLDEN = 0.6180339887498949


def automatic_views(
    scene: SceneLike,
    count: int = 8,
    *,
    width: int = 640,
    height: int = 480,
    seed: int = 0,
) -> Cameras:
    """Choose cameras that show a scene of which nothing else is layout.

    Where the scene is, how large and which way is up comes from robust statistics of what is
    visible (:func:`cvtgs.views.up.find_up`; y-down without evidence), so flyaways,
    sky shells and haze do not matter. The cameras stand around the scene at several heights; if
    its middle is free, surfaces are all around and above, and much of the scene can be seen from
    there, they stand inside and look across. Every camera is scored by an image of 64 pixels: one
    that is inside of a Gaussian, has something near in its image, or sees nothing is replaced by
    the first good alternate, or by the best of them.

    The same scene, count, size and seed give the same cameras. Memory: a sample of at most
    30,000 Gaussians, and masks of the scene.

    Args:
        scene: Any scene with at least one valid Gaussian, or a file or folder of one.
        count: Number of views, at least 1.
        width: Pixels per row.
        height: Rows.
        seed: Turns the cameras around the scene: another seed, other views.

    Returns:
        The cameras, float64 on the CPU, named ``view 1`` and so on.

    Raises:
        InvalidArgumentError: Count or size is below 1.
        InvalidSceneError: The scene has no valid row.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> automatic_views(scene("object", 1000), 3, width=64, height=48).names
        ('view 1', 'view 2', 'view 3')
    """
    for name, value in (("count", count), ("width", width), ("height", height)):
        if value < 1:
            raise InvalidArgumentError(f"{name} must be at least 1, found {value}.")
    scene, size, turn = as_scene(scene), (width, height), 0.5 + seed * _GOLDEN
    with one_thread():
        layout = find_layout(scene)
        candidates = choose_candidates(layout, count, size=size, turn=turn)
        cameras = _best(layout, candidates)
    return replace(cameras, names=cameras.view_names)


def choose_candidates(
    layout: SceneLayout, count: int, *, size: tuple[int, int], turn: float
) -> CandidateCameras:
    """Return candidates inside a room if the scene is one that is seen well from there."""
    around = outside_candidates(layout, count, size=size, turn=turn)
    middle = _middle_of_room(layout)
    if middle is None:
        return around
    outside = outside_candidates(layout, _COMPARED, size=_COMPARED_SIZE, turn=turn)
    inside = inside_candidates(layout, middle, _COMPARED, size=_COMPARED_SIZE, turn=turn)
    if _visible_share(layout, inside) < _WITHIN * _visible_share(layout, outside):
        return around
    return inside_candidates(layout, middle, count, size=size, turn=turn)


def _middle_of_room(layout: SceneLayout) -> Float[Tensor, "3"] | None:
    """Return the middle at the height of the eyes if there is room and surfaces are all around."""
    points = layout.voxels.points
    if len(points) == 0:
        return None
    heights = points @ layout.up
    low, high = heights.quantile(heights.new_tensor([0.02, 0.98])).tolist()
    center = (layout.center - layout.frame.center) / layout.frame.radius
    center = center - (center @ layout.up) * layout.up
    steps = torch.linspace(-0.3, 0.3, 5, dtype=points.dtype)
    level = torch.linalg.svd(layout.up[None]).Vh[1:]
    offsets = torch.cartesian_prod(steps, steps) @ level
    lifts = torch.tensor([0.45, 0.55, 0.65], dtype=points.dtype) * (high - low) + low
    eyes = (center + offsets)[:, None] + lifts[:, None] * layout.up
    eyes = eyes.reshape(-1, 3)
    clearance = torch.cdist(eyes, points).amin(dim=1)
    best = eyes[clearance.argmax()]
    points = points[torch.linalg.vector_norm(points - best, dim=1) < _NEAR]
    if float(clearance.amax()) < _FREE or _enclosure(points - best, layout.up) < _ENCLOSED:
        return None
    middle = center + (0.58 * (high - low) + low) * layout.up
    position: Tensor = layout.frame.center + layout.frame.radius * middle
    return position


def _enclosure(offsets: Float[Tensor, "v 3"], up: Float[Tensor, "3"]) -> float:
    """Return the share of the upper half of all directions in which there is a surface."""
    directions = torch.nn.functional.normalize(offsets, dim=1)
    axes = torch.linalg.svd(up[None]).Vh[1:]
    rise = directions @ up
    x, y = (directions @ axes.T).unbind(1)
    sectors = ((torch.atan2(y, x) / math.tau + 0.5) * _SECTORS).long().clamp(0, _SECTORS - 1)
    bands = (rise * _BANDS).long().clamp(0, _BANDS - 1)  # bands of equal solid angle
    filled = torch.zeros(_BANDS, _SECTORS, dtype=torch.bool)
    filled[bands[rise > 0], sectors[rise > 0]] = True
    return float(filled.double().mean())


def _visible_share(layout: SceneLayout, candidates: CandidateCameras) -> float:
    scores = score_cameras(
        layout,
        candidates.rounds[0],
        distances=candidates.distances[0],
        inside=candidates.inside,
    )
    return float(scores.visible.any(dim=0).double().mean())


def _best(layout: SceneLayout, candidates: CandidateCameras) -> Cameras:
    """Return the first good candidate of every view, else the one with the least penalty."""
    first = candidates.rounds[0]
    viewmats = first.viewmats.clone()
    waiting = torch.arange(len(first))
    least = torch.full((len(first),), math.inf, dtype=torch.float64)
    for cameras, distances in zip(candidates.rounds, candidates.distances, strict=True):
        if len(waiting) == 0:
            break
        scores = score_cameras(
            layout,
            cameras.select(waiting),
            distances=distances[waiting],
            inside=candidates.inside,
        )
        better = scores.good | (scores.penalties < least[waiting])
        viewmats[waiting[better]] = cameras.viewmats[waiting[better]]
        least[waiting] = torch.minimum(least[waiting], scores.penalties)
        waiting = waiting[~scores.good]
    return replace(first, viewmats=viewmats)
