"""Automatic views: cameras for a scene of which nothing is layout."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from cvtgs.cameras import Cameras
from cvtgs.devices import one_thread
from cvtgs.errors import InvalidArgumentError
from cvtgs.scene import SceneLike
from cvtgs.views.candidates import (
    CandidateCameras,
    found_candidates,
    inside_candidates,
    outside_candidates,
)
from cvtgs.views.layout import SceneLayout
from cvtgs.views.positions import CameraPositions, as_positions
from cvtgs.views.scoring import score_cameras

_GOLDEN = 0.6180339887498949


def automatic_views(
    scene: SceneLike | CameraPositions,
    count: int = 8,
    *,
    width: int = 640,
    height: int = 480,
    seed: int = 0,
) -> Cameras:
    """Choose cameras that show a scene of which nothing else is known.

    Where the scene is, how large and which way is up comes from robust statistics of what is
    visible (:func:`cvtgs.views.up.find_up`), so flyaways, sky shells and haze do not matter. The
    cameras stand around the scene at several heights; if its middle is free, surfaces are all
    around and above, and larger Gaussians lie behind these than before them, they stand inside and
    look across. They stand only where :class:`cvtgs.views.CameraPositions` says they may.
    Every camera is scored by an image of 64 pixels: one that is inside of a Gaussian, has
    something near in its image, or sees nothing is replaced by the first good alternate, or by the
    best of them.

    The same scene, count, size and seed give the same cameras. Memory: a sample of at most
    30,000 Gaussians, and masks of the scene.

    Args:
        scene: Any scene with at least one valid Gaussian, a file or folder of one, or what
            :func:`cvtgs.views.find_view_positions` found of it.
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
    size, turn = (width, height), 0.5 + seed * _GOLDEN
    with one_thread():
        positions = as_positions(scene)
        candidates = choose_candidates(positions.layout, count, size=size, turn=turn)
        others = found_candidates(positions, count, size=size, seed=seed)
        cameras = _best(positions, [candidates, others])
    return replace(cameras, names=cameras.view_names)


def choose_candidates(
    layout: SceneLayout, count: int, *, size: tuple[int, int], turn: float
) -> CandidateCameras:
    """Return candidates inside a room if the scene is one."""
    if layout.room is None:
        return outside_candidates(layout, count, size=size, turn=turn)
    return inside_candidates(layout, layout.room, count, size=size, turn=turn)


def _best(positions: CameraPositions, candidates: Sequence[CandidateCameras]) -> Cameras:
    """Return the first good candidate of every view, else the one with the least penalty."""
    first = candidates[0].rounds[0]
    viewmats = first.viewmats.clone()
    waiting = torch.arange(len(first))
    least = torch.full((len(first),), math.inf, dtype=torch.float64)
    rounds = [pair for each in candidates for pair in zip(each.rounds, each.distances, strict=True)]
    for cameras, distances in rounds:
        rows = waiting[positions.admit(cameras.centers[waiting])]
        if len(rows) == 0:
            continue
        scores = score_cameras(
            positions.layout,
            cameras.select(rows),
            distances=distances[rows],
            inside=candidates[0].inside,
        )
        better = scores.good | (scores.penalties < least[rows])
        viewmats[rows[better]] = cameras.viewmats[rows[better]]
        least[rows] = torch.minimum(least[rows], scores.penalties)
        waiting = waiting[~torch.isin(waiting, rows[scores.good])]
    return replace(first, viewmats=viewmats)
