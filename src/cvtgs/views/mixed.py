"""Random views of a scene, and a mixture of them with automatic ones."""

import math

import torch

from cvtgs.cameras import Cameras, look_at
from cvtgs.math.frames import robust_frame
from cvtgs.scene import GaussianScene
from cvtgs.views.automatic import automatic_views

NEAR = (0.2, 1.4)
"""Distances of near views, robust radii: some are within the scene."""


def random_views(
    scene: GaussianScene,
    count: int,
    *,
    size: int,
    seed: int,
    reach: tuple[float, float] = (1.1, 3.0),
) -> Cameras:
    """Return cameras at random directions and distances, below the scene and near it too.

    A scene optimized on automatic views alone gets worse on all other sides.

    Args:
        scene: The scene.
        count: Number of views.
        size: Side of the square images, pixels.
        seed: Of the random numbers.
        reach: Smallest and largest distance, robust radii.

    Returns:
        Cameras, float64, in any direction around the middle of the opaque Gaussians. They look at
        points up to a quarter of a radius from it, with a field of view of 50 degrees.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> len(random_views(scene("object", 1000), 3, size=64, seed=0))
        3
    """
    generator = torch.Generator().manual_seed(seed)
    opaque = scene.opacities > 0.1
    frame = robust_frame(scene.means[opaque] if bool(opaque.any()) else scene.means)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    nearest, farthest = reach
    steps = torch.rand(count, 1, generator=generator)
    distances = frame.radius * (nearest + (farthest - nearest) * steps)
    center = frame.center.cpu()
    targets = center + 0.25 * frame.radius * (torch.rand(count, 3, generator=generator) - 0.5)
    up = torch.randn(3, generator=generator).double()
    focal = 0.5 * size / math.tan(math.radians(25))
    intrinsics = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    eyes = center + distances.double() * directions.double()
    return Cameras(
        viewmats=look_at(eyes, targets, up),
        Ks=intrinsics.double().repeat(count, 1, 1),
        width=size,
        height=size,
    )


def mixed_views(scene: GaussianScene, count: int, *, size: int, seed: int = 0) -> Cameras:
    """Return automatic and random views together.

    A quarter are automatic views, a quarter random views from near, within the scene too, and
    half random views from around it.

    Args:
        scene: A scene with at least one valid Gaussian.
        count: Number of views, at least 1.
        size: Side of the square images, pixels.
        seed: Of the random numbers.

    Returns:
        The cameras, in this order.

    Raises:
        InvalidArgumentError: Count or size is below 1.
        InvalidSceneError: The scene has no valid row.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> len(mixed_views(scene("object", 1000), 5, size=64))
        5
    """
    usual, near = max(1, count // 4), count // 4
    groups = [
        automatic_views(scene, usual, width=size, height=size, seed=seed),
        random_views(scene, near, size=size, seed=seed + 1, reach=NEAR),
        random_views(scene, max(0, count - usual - near), size=size, seed=seed),
    ]
    return Cameras(
        viewmats=torch.cat([group.viewmats for group in groups]),
        Ks=torch.cat([group.Ks for group in groups]),
        width=size,
        height=size,
    )
