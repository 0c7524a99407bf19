"""Views: pictures of full scenes that networks are compared with."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.render import render
from cvtgs.scene import GaussianScene
from cvtgs.views import automatic_views, views_from_anywhere


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
