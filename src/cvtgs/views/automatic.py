"""Automatic views: candidates around a scene or inside a room, and the choice of the best."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.counts import checked_whole
from cvtgs.devices import one_thread
from cvtgs.scene import SceneLike
from cvtgs.views.layout import SceneLayout, level_axes
from cvtgs.views.positions import REACH, CameraPositions, as_positions, checked_seed
from cvtgs.views.scoring import cameras_at, score_cameras

_ELEVATIONS = (20.0, 35.0, 12.0, 28.0)
_OUTSIDE = (
    # turn (share of a slot), further elevation (degrees), factor of the distance
    (0.0, 0.0, 1.0),
    (0.0, 12.0, 1.0),
    (0.3, 4.0, 1.0),
    (-0.3, 4.0, 1.0),
    (0.0, 8.0, 0.75),
    (0.0, 25.0, 1.0),
    (0.3, 16.0, 0.75),
    (-0.3, 16.0, 0.75),
    (0.0, 20.0, 1.4),
    (0.0, 45.0, 1.0),
    (0.0, 15.0, 0.5),
    (0.0, 50.0, 1.5),
)
_INSIDE = (
    # turn (share of a slot), share of the distance to the wall behind, lift (share of the height)
    (0.0, 0.65, 0.0),
    (0.0, 0.75, 0.08),
    (0.3, 0.65, 0.04),
    (-0.3, 0.65, 0.04),
    (0.0, 0.5, 0.0),
    (0.0, 0.55, 0.12),
    (0.3, 0.4, 0.04),
    (-0.3, 0.4, 0.04),
    (0.0, 0.8, -0.08),
    (0.0, 0.25, 0.08),
    (0.0, 0.0, 0.0),
)
OUTSIDE_FIELD = 45.0  # field of view around a scene along the shorter side of the image, degrees
INSIDE_FIELD = 62.0  # field of view inside a room along the shorter side of the image, degrees
_PLACE_RADIUS = 0.95
_OBJECT_RADIUS = 1.0
_INSIDE_PITCH = -10.0
_PATH_RADIUS = 0.15
_WALL_QUANTILE = 0.8  # of surface distances, a wall: the nearest are furniture, the farthest stray
_FARTHEST = 1.5
_FOUND = 2
# A camera for every view and its distance to its subject; the first round has the preferred ones,
# later ones have alternates
Round = tuple[Cameras, Float[Tensor, "c"]]


def outside_candidates(
    layout: SceneLayout, count: int, *, size: tuple[int, int], turn: float
) -> list[Round]:
    """Return cameras around the scene at several elevations, looking at its middle."""
    right, ahead = level_axes(layout.up)
    shown = layout.radius * (_OBJECT_RADIUS if layout.bounded else _PLACE_RADIUS)
    distance = shown / math.sin(math.radians(0.5 * OUTSIDE_FIELD))
    elevations = [_ELEVATIONS[slot % len(_ELEVATIONS)] for slot in range(count)]
    rounds = []
    for shift, lift, factor in _OUTSIDE:
        eyes = []
        for slot, elevation in enumerate(elevations):
            angle = 2 * math.pi * (slot + turn + shift) / count
            rise = math.radians(min(elevation + lift, 80.0))
            level = math.cos(angle) * right + math.sin(angle) * ahead
            eyes.append(math.cos(rise) * level + math.sin(rise) * layout.up)
        directions = torch.stack(eyes)
        cameras = cameras_at(
            layout.center + distance * factor * directions,
            -directions,
            layout.up,
            size=size,
            field=OUTSIDE_FIELD,
        )
        distances = torch.full((count,), distance * factor, dtype=torch.float32, device="cpu")
        rounds.append((cameras, distances))
    return rounds


def inside_candidates(
    layout: SceneLayout,
    middle: Float[Tensor, "3"],
    count: int,
    *,
    size: tuple[int, int],
    turn: float,
) -> list[Round]:
    """Return cameras in a room, moved back from its middle and looking across it."""
    right, ahead = level_axes(layout.up)
    pitch = math.radians(_INSIDE_PITCH)
    rounds = []
    for shift, back, lift in _INSIDE:
        angles = [2 * math.pi * (slot + turn + shift) / count for slot in range(count)]
        level = torch.stack([math.cos(angle) * right + math.sin(angle) * ahead for angle in angles])
        steps = back * _distances_to_walls(layout, middle, -level)
        eyes = middle - steps[:, None] * level + lift * layout.height * layout.up
        directions = math.cos(pitch) * level + math.sin(pitch) * layout.up
        cameras = cameras_at(eyes, directions, layout.up, size=size, field=INSIDE_FIELD)
        rounds.append((cameras, steps + 0.5 * layout.frame.radius))
    return rounds


def found_candidates(
    positions: CameraPositions, count: int, *, size: tuple[int, int], seed: int
) -> list[Round]:
    """Return cameras at known good positions, as alternates to the other candidates."""
    layout = positions.layout
    reach, field = (1.4, REACH[1]), OUTSIDE_FIELD
    if layout.room is not None:
        reach, field = REACH, INSIDE_FIELD
    rounds = []
    for turn in range(_FOUND):
        eyes = positions.near(count, reach, seed + turn)
        directions = layout.subject - eyes
        cameras = cameras_at(eyes, directions, layout.up, size=size, field=field)
        rounds.append((cameras, torch.linalg.vector_norm(directions, dim=1)))
    return rounds


def _distances_to_walls(
    layout: SceneLayout, start: Float[Tensor, "3"], directions: Float[Tensor, "c 3"]
) -> Float[Tensor, "c"]:
    """Return the distance to the wall in each direction, scene units."""
    points = layout.frame.center + layout.frame.radius * layout.voxels.points - start
    along = directions @ points.T
    aside = (points.square().sum(dim=1) - along.square()).clamp_min(0).sqrt()
    ahead = (along > 0) & (aside < _PATH_RADIUS * layout.frame.radius)
    distances = [
        row[there].quantile(_WALL_QUANTILE) if bool(there.any()) else row.new_zeros(())
        for row, there in zip(along, ahead, strict=True)
    ]
    return torch.stack(distances).clamp_max(_FARTHEST * layout.frame.radius)


_GOLDEN = 0.6180339887498949


@torch.no_grad()
def automatic_views(
    scene: SceneLike | CameraPositions,
    count: int = 8,
    *,
    width: int = 640,
    height: int = 480,
    seed: int = 0,
) -> Cameras:
    """Choose cameras for a scene of which nothing else is known.

    Position, size and up direction of the scene come from robust statistics of its visible
    Gaussians, so flyaways, sky shells and haze do not matter. The cameras stand around the scene at
    several elevations. They stand inside and look across if the middle is free, surfaces are all
    around and above, and the Gaussians behind these surfaces are larger than those before them.
    They stand only where :class:`cvtgs.views.CameraPositions` admits them, unless it admits no
    candidate. Every camera is scored by an image of 64 pixels. If it is inside a Gaussian, has a
    near obstacle in its image, or sees nothing, the first alternate without such a fault replaces
    it, or else the one of the best score.

    The same scene, count, size and seed give the same cameras. Memory: a sample of at most
    30,000 Gaussians, and masks of the scene.

    Args:
        scene: Any scene with at least one valid Gaussian, a file or folder of one, or the result
            of :func:`cvtgs.views.find_view_positions`.
        count: Number of views, at least 1.
        width: Width of the images, pixels.
        height: Height of the images, pixels.
        seed: Turns the cameras around the scene, so that another seed gives other views.

    Returns:
        The cameras, float64 on the CPU, named ``view 1`` and so on.

    Raises:
        InvalidArgumentError: Count or size is no whole number above 0, or the seed is no whole
            number.
        InvalidSceneError: The scene has no valid row, or reaches beyond 1e14 units.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> automatic_views(scene("object", 1000), 3, width=64, height=48).names
        ('view 1', 'view 2', 'view 3')
    """
    seed, count = checked_seed(seed), checked_whole(count, "count")
    width, height = checked_whole(width, "width"), checked_whole(height, "height")
    size, turn = (width, height), 0.5 + seed * _GOLDEN
    with one_thread():
        positions = as_positions(scene)
        rounds = choose_candidates(positions.layout, count, size=size, turn=turn)
        rounds += found_candidates(positions, count, size=size, seed=seed)
        cameras = _best(positions, rounds)
    return replace(cameras, names=cameras.view_names)


def choose_candidates(
    layout: SceneLayout, count: int, *, size: tuple[int, int], turn: float
) -> list[Round]:
    """Return candidates inside the scene if it is a room, else around it."""
    if layout.room is None:
        return outside_candidates(layout, count, size=size, turn=turn)
    return inside_candidates(layout, layout.room, count, size=size, turn=turn)


def _best(positions: CameraPositions, rounds: Sequence[Round]) -> Cameras:
    """Return the first good candidate of every view, or else that of lowest penalty."""
    first = rounds[0][0]
    viewmats = first.viewmats.clone()
    waiting = torch.arange(len(first), device="cpu")
    least = torch.full((len(first),), math.inf, dtype=torch.float64, device="cpu")
    for cameras, distances in rounds:
        rows = waiting[positions.admit(cameras.centers[waiting])]
        if len(rows) == 0:
            continue
        good, penalties = score_cameras(
            positions.layout, cameras.select(rows), distances=distances[rows]
        )
        better = good | (penalties < least[rows])
        viewmats[rows[better]] = cameras.viewmats[rows[better]]
        least[rows] = torch.minimum(least[rows], penalties)
        waiting = waiting[~torch.isin(waiting, rows[good])]
    return replace(first, viewmats=viewmats)
