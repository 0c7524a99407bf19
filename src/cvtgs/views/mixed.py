"""Random views of a scene, and a mixture of random and automatic views."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras, join_cameras, look_at
from cvtgs.counts import checked_whole
from cvtgs.scene import SceneLike
from cvtgs.views.automatic import automatic_views
from cvtgs.views.positions import CameraPositions, as_positions, checked_reach, checked_seed
from cvtgs.views.scoring import SMOOTH, splat_sizes

TRIED = 3  # number of candidate views per returned view
TOO_NEAR = 2.0  # a view is too close if upper-quartile distances are over this many times its own
# A view shows fog if its splats, in robust radii, are larger than this many times those of the
# sharpest tenth of the candidates, and larger than those of smooth sides
FOGGY = 1.4
NEAR = (0.2, 1.4)  # range of distances of near views, robust radii; some views are inside the scene
_AROUND = (1.1, 3.0)
_FIELD = 50.0
_OPEN_FIELD = 60.0
_ROOM_FIELD = 65.0
_AIM = 0.25
_LEAST_AIM = 0.3
_LEVEL = 0.5  # sine of the largest elevation at which every second camera in a room looks


@torch.no_grad()
def random_views(
    scene: SceneLike | CameraPositions,
    count: int,
    *,
    size: int,
    seed: int,
    reach: tuple[float, float] = _AROUND,
) -> Cameras:
    """Return cameras at random plausible viewpoints, including near ones.

    A scene optimized on automatic views alone gets worse on all other sides. No camera is beneath
    a floor or inside matter (:class:`cvtgs.views.CameraPositions`); without a floor, some look
    from below. In an open place, cameras are no higher than people hold them.

    Args:
        scene: The scene, or the result of :func:`find_view_positions`.
        count: Number of views.
        size: Side of the square images, pixels.
        seed: Seed of the random numbers.
        reach: Smallest and largest distance, robust radii; in a room, only the largest counts,
            since hardly a place in it is far from its middle.

    Returns:
        Cameras, float64, upright. They look at points up to a quarter of a radius from the middle,
        with a field of view of 50 degrees, in an open place of 60; in a room at random surfaces,
        every second camera within 30 degrees of the level, with 65 degrees.

    Raises:
        InvalidArgumentError: The count or the seed is no whole number, the count is negative, the
            size is no whole number above 0, or ``reach`` is no range.
        InvalidSceneError: The scene has no valid row, or reaches beyond 1e14 units.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> len(random_views(scene("object", 1000), 3, size=64, seed=0))
        3
    """
    seed, size = checked_seed(seed), checked_whole(size, "size")
    count = checked_whole(count, "count", least=0)
    positions = as_positions(scene)
    layout = positions.layout
    low, high = checked_reach(reach)
    reach = (low if layout.room is None else 0.0, high)
    eyes = positions.near(count, reach, seed)
    targets = _targets(positions, eyes, seed)
    field = _OPEN_FIELD if layout.is_open else _FIELD
    if layout.room is not None:
        field = _ROOM_FIELD
    focal = 0.5 * size / math.tan(math.radians(0.5 * field))
    intrinsics = torch.tensor(
        [[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]],
        dtype=torch.float32,
        device="cpu",
    )
    return Cameras(
        viewmats=look_at(eyes, targets, layout.up),
        Ks=intrinsics.double().repeat(count, 1, 1),
        width=size,
        height=size,
    )


def _targets(
    positions: CameraPositions, eyes: Float[Tensor, "c 3"], seed: int
) -> Float[Tensor, "c 3"]:
    """Return points near the middle; in a room, points on surfaces that are far enough away."""
    layout = positions.layout
    center, radius = layout.frame.center, layout.frame.radius
    generator = torch.Generator().manual_seed(seed + 1)
    if layout.room is None:
        draws = torch.rand(len(eyes), 3, generator=generator, dtype=torch.float32, device="cpu")
        return center + _AIM * radius * (draws - 0.5)
    points = center + radius * layout.voxels.points
    distances = torch.cdist(eyes, points)
    far = distances > _LEAST_AIM * radius
    # People look at walls more than at the ceiling or at their feet.
    rises = (points @ layout.up - (eyes @ layout.up)[:, None]).abs()
    level = far & (rises < _LEVEL * distances)
    level[1::2] = far[1::2]
    far = torch.where(level.any(dim=1, keepdim=True), level, far)
    order = torch.rand(far.shape, generator=generator, dtype=torch.float32, device="cpu") * far
    return points[order.argmax(dim=1)]


@torch.no_grad()
def mixed_views(
    scene: SceneLike | CameraPositions, count: int, *, size: int, seed: int = 0, sharp: bool = True
) -> Cameras:
    """Return automatic and random views together.

    A quarter are automatic views, a quarter random near views, some inside the scene, and half
    random views from around it. With ``sharp``, each kind has three candidates per view.
    Candidates that show large splats are used last, because a scene is fog where no image was
    taken, and nobody looks from there. Candidates much nearer than others are also used last.
    Among the remaining ones, views from all around are chosen.

    Args:
        scene: A scene with at least one valid Gaussian, or the result of
            :func:`find_view_positions`.
        count: Number of views, at least 1.
        size: Side of the square images, pixels.
        seed: Seed of the random numbers.
        sharp: Whether views of large splats are used last. Use False for scenes with merged parts,
            whose splats are large everywhere.

    Returns:
        The cameras, float64, without names: automatic, near, then other random views.

    Raises:
        InvalidArgumentError: Count or size is no whole number above 0, or the seed is no whole
            number.
        InvalidSceneError: The scene has no valid row, or reaches beyond 1e14 units.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> len(mixed_views(scene("object", 1000), 5, size=64))
        5
    """
    seed = checked_seed(seed)
    count, size = checked_whole(count, "count"), checked_whole(size, "size")
    positions = as_positions(scene)
    usual, near = max(1, count // 4), count // 4
    times = TRIED if sharp else 1
    far = max(0, count - usual - near)
    tried = [
        (automatic_views(positions, times * usual, width=size, height=size, seed=seed), usual),
        (random_views(positions, times * near, size=size, seed=seed + 1, reach=NEAR), near),
        (random_views(positions, times * far, size=size, seed=seed), far),
    ]
    tried = [(cameras, wanted) for cameras, wanted in tried if wanted]
    groups = _sharp_ones(positions, tried) if sharp else [cameras for cameras, _ in tried]
    return join_cameras(groups)


def _sharp_ones(positions: CameraPositions, tried: Sequence[tuple[Cameras, int]]) -> list[Cameras]:
    """Return the wanted number of views of each kind, faulty ones only if necessary."""
    sizes = [splat_sizes(positions.layout, cameras) for cameras, _ in tried]
    in_scene = torch.cat([size.in_scene for size in sizes])
    largest = max(SMOOTH, FOGGY * float(in_scene.quantile(0.1)))
    chosen = []
    for (cameras, wanted), size in zip(tried, sizes, strict=True):
        closeness = size.in_image / size.in_scene
        too_near = closeness / (TOO_NEAR * closeness.quantile(0.25))
        faults = torch.maximum(too_near, size.in_scene / largest).clamp_min(1.0)
        # Automatic views are ordered by angle: take one of each three first, then the others.
        spread = torch.arange(len(cameras), device="cpu").view(wanted, TRIED).T.flatten()
        best = faults[spread].sort(stable=True).indices[:wanted]
        chosen.append(cameras.select(spread[best].sort().values))
    return chosen
