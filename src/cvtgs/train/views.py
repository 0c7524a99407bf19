"""Views: pictures of full scenes that networks are compared with."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras, look_at
from cvtgs.evaluate import automatic_views
from cvtgs.math.frames import robust_frame
from cvtgs.render import render
from cvtgs.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Views:
    """Pictures of a full scene; the background is left open.

    Attributes:
        cameras: From where.
        rgb: ``(c, h, w, 3)`` colours over black, half precision.
        alpha: ``(c, h, w)`` opacity, half precision.
    """

    cameras: Cameras
    rgb: Float[Tensor, "c h w 3"]
    alpha: Float[Tensor, "c h w"]

    def over(self, background: Float[Tensor, "3"]) -> Float[Tensor, "c h w 3"]:
        """Put the pictures over a background.

        Args:
            background: Red, green, blue.

        Returns:
            Pictures in float32.
        """
        return self.rgb.float() + (1 - self.alpha.float())[..., None] * background

    def select(self, row: int) -> "Views":
        """Take one picture.

        Args:
            row: Which one.

        Returns:
            The picture and its camera.
        """
        rows = torch.tensor([row], device=self.cameras.Ks.device)
        return Views(
            cameras=self.cameras.select(rows),
            rgb=self.rgb[row : row + 1],
            alpha=self.alpha[row : row + 1],
        )

    def to(self, device: torch.device) -> "Views":
        """Move the pictures to a device.

        Args:
            device: Where to.

        Returns:
            The pictures there.
        """
        return Views(
            cameras=self.cameras.to(device), rgb=self.rgb.to(device), alpha=self.alpha.to(device)
        )


def look_at_scene(scene: GaussianScene, count: int, *, size: int, seed: int) -> Views:
    """Render a full scene once: every other view as people would look, the rest from anywhere.

    Args:
        scene: The scene.
        count: Number of views.
        size: Side of the square pictures, pixels.
        seed: Which views.

    Returns:
        The pictures, on the CPU.
    """
    around = views_from_anywhere(scene, count // 2, size=size, seed=seed)
    usual = automatic_views(scene, count - count // 2, width=size, height=size, seed=seed)
    cameras = Cameras(
        viewmats=torch.cat([usual.viewmats, around.viewmats]),
        Ks=torch.cat([usual.Ks, around.Ks]),
        width=size,
        height=size,
    )
    with torch.no_grad():
        pictures = render(scene, cameras)
    return Views(cameras=cameras, rgb=pictures.rgb.cpu().half(), alpha=pictures.alpha.cpu().half())


def views_from_anywhere(scene: GaussianScene, count: int, *, size: int, seed: int) -> Cameras:
    """Look at a scene from random directions and distances, from below and from near too.

    A network that only sees what automatic views show would spoil all other sides.

    Args:
        scene: The scene.
        count: Number of views.
        size: Side of the square pictures, pixels.
        seed: Which views.

    Returns:
        Cameras from 1.1 to 3 robust radii around the middle of the opaque Gaussians, which look
        at places up to a quarter of a radius from it, over 50 degrees.
    """
    generator = torch.Generator().manual_seed(seed)
    opaque = scene.opacities > 0.1
    frame = robust_frame(scene.means[opaque] if bool(opaque.any()) else scene.means)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    distances = frame.radius * (1.1 + 1.9 * torch.rand(count, 1, generator=generator))
    center = frame.center.float().cpu()
    targets = center + 0.25 * frame.radius * (torch.rand(count, 3, generator=generator) - 0.5)
    up = torch.randn(3, generator=generator)
    focal = 0.5 * size / math.tan(math.radians(25))
    intrinsics = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    return Cameras(
        viewmats=look_at(center + distances * directions, targets, up),
        Ks=intrinsics.repeat(count, 1, 1),
        width=size,
        height=size,
    )
