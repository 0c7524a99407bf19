"""Mixed views: some that people would choose, and others from all sides, from near and from far."""

import torch

from cvtgs.cameras import Cameras
from cvtgs.scene import GaussianScene
from cvtgs.views.anywhere import views_from_anywhere
from cvtgs.views.automatic import automatic_views

NEAR = (0.2, 1.4)
"""Distances of near views, robust radii: some stand within the scene."""


def mixed_views(scene: GaussianScene, count: int, *, size: int, seed: int = 0) -> Cameras:
    """Look at a scene as people would, and from where nobody would.

    A quarter are automatic views, a quarter looks from anywhere near, within the scene too, and
    half from anywhere around.

    Args:
        scene: A scene with at least one valid Gaussian.
        count: Number of views, at least 1.
        size: Side of the square images, pixels.
        seed: Which views.

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
        views_from_anywhere(scene, near, size=size, seed=seed + 1, reach=NEAR),
        views_from_anywhere(scene, max(0, count - usual - near), size=size, seed=seed),
    ]
    return Cameras(
        viewmats=torch.cat([group.viewmats for group in groups]),
        Ks=torch.cat([group.Ks for group in groups]),
        width=size,
        height=size,
    )
