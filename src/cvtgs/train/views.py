"""Views: images of full scenes that networks are compared with."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.rendering import render
from cvtgs.scene import GaussianScene
from cvtgs.views import automatic_views, random_views


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Views:
    """Images of a full scene; the background is left open.

    Attributes:
        cameras: From where.
        rgb: ``(c, h, w, 3)`` colours over black, half precision.
        alpha: ``(c, h, w)`` opacity, half precision.
    """

    cameras: Cameras
    rgb: Float[Tensor, "c h w 3"]
    alpha: Float[Tensor, "c h w"]

    def over(self, background: Float[Tensor, "3"]) -> Float[Tensor, "c h w 3"]:
        """Put the images over a background."""
        return self.rgb.float() + (1 - self.alpha.float())[..., None] * background

    def select(self, row: int) -> "Views":
        """Take one image."""
        rows = torch.tensor([row], device=self.cameras.Ks.device)
        return Views(
            cameras=self.cameras.select(rows),
            rgb=self.rgb[row : row + 1],
            alpha=self.alpha[row : row + 1],
        )

    def to(self, device: torch.device) -> "Views":
        """Move the images to a device."""
        return Views(
            cameras=self.cameras.to(device), rgb=self.rgb.to(device), alpha=self.alpha.to(device)
        )


def look_at_scene(scene: GaussianScene, count: int, *, size: int, seed: int) -> Views:
    """Render a full scene once: every other view as people would look, the rest from anywhere."""
    around = random_views(scene, count // 2, size=size, seed=seed)
    usual = automatic_views(scene, count - count // 2, width=size, height=size, seed=seed)
    cameras = Cameras(
        viewmats=torch.cat([usual.viewmats, around.viewmats]),
        Ks=torch.cat([usual.Ks, around.Ks]),
        width=size,
        height=size,
    )
    with torch.no_grad():
        images = render(scene, cameras)
    return Views(cameras=cameras, rgb=images.rgb.cpu().half(), alpha=images.alpha.cpu().half())
