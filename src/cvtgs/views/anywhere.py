"""Views from anywhere: all sides of a scene, the ones that nobody would choose too."""

import math

import torch

from cvtgs.cameras import Cameras, look_at
from cvtgs.math.frames import robust_frame
from cvtgs.scene import GaussianScene


def views_from_anywhere(
    scene: GaussianScene,
    count: int,
    *,
    size: int,
    seed: int,
    reach: tuple[float, float] = (1.1, 3.0),
) -> Cameras:
    """Look at a scene from random directions and distances, from below and from near too.

    Whoever learns only from what automatic views show spoils all other sides.

    Args:
        scene: The scene.
        count: Number of views.
        size: Side of the square images, pixels.
        seed: Which views.
        reach: Smallest and largest distance, robust radii.

    Returns:
        Cameras, float64, in any direction around the middle of the opaque Gaussians, which look
        at places up to a quarter of a radius from it, over 50 degrees.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> len(views_from_anywhere(scene("object", 1000), 3, size=64, seed=0))
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
