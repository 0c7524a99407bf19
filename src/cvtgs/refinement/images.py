"""Images of the full scene: some to learn from, rendered when needed, and some that decide."""

import random
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.config import RefineConfig
from cvtgs.refinement.looking import Outlook
from cvtgs.rendering import render
from cvtgs.scene import GaussianScene

BEST_PSNR = 60.0
"""Images that are nearer to each other count as equal, dB."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Image:
    """One image of the full scene; the background is left open.

    Attributes:
        camera: From where.
        rgb: ``(1, h, w, 3)`` colours over black.
        alpha: ``(1, h, w)`` opacity.
    """

    camera: Cameras
    rgb: Float[Tensor, "1 h w 3"]
    alpha: Float[Tensor, "1 h w"]

    def over(self, background: Float[Tensor, "3"]) -> Float[Tensor, "1 h w 3"]:
        """Put the image over a background."""
        rgb, alpha = self.rgb.to(background.dtype), self.alpha.to(background.dtype)
        return rgb + (1 - alpha)[..., None] * background


@torch.no_grad()
def take_image(full: GaussianScene, camera: Cameras) -> Image:
    """Render the full scene once."""
    found = render(full, camera)
    return Image(camera=camera, rgb=found.rgb, alpha=found.alpha)


class ImageBuffer:
    """Images to learn from: a new one now and then, else one that is there.

    Memory: 8 bytes per pixel of at most ``config.images`` images; of one, if every step has a
    new one.
    """

    def __init__(
        self, full: GaussianScene, outlook: Outlook, *, config: RefineConfig, seed: int
    ) -> None:
        always_new = outlook.endless and config.steps_per_image == 1
        self._full = full
        self._cameras = outlook.learning
        self._steps_per_image = config.steps_per_image
        self._most = 1 if always_new else config.images
        self._dice = random.Random(seed)
        self._kept: list[Image] = []
        self._drawn = 0
        self.taken = 0

    def draw(self) -> Image:
        """Return an image to learn from."""
        is_turn = self._drawn % self._steps_per_image == 0
        self._drawn += 1
        camera = next(self._cameras, None) if is_turn else None
        if camera is None:
            return self._dice.choice(self._kept)
        if len(self._kept) == self._most:
            self._kept.pop(self._dice.randrange(len(self._kept)))
        image = take_image(self._full, camera)
        self._kept.append(Image(camera=camera, rgb=image.rgb.half(), alpha=image.alpha.half()))
        self.taken += 1
        return self._kept[-1]

    def draw_color(self) -> Float[Tensor, "3"]:
        """Return a background."""
        return self._full.means.new_tensor([self._dice.random() for _ in range(3)])


@torch.no_grad()
def scores(scene: GaussianScene, images: tuple[Image, ...]) -> Float[Tensor, "p"]:
    """Return how near a scene comes to each image of the full one."""
    values = []
    for image in images:
        found = take_image(scene, image.camera)
        for shade in (0.0, 1.0):
            background = scene.means.new_full((3,), shade)
            error = found.over(background).clamp(0, 1) - image.over(background).clamp(0, 1)
            values.append(-10 * torch.log10(error.double().square().mean()))
    return torch.stack(values).clamp(max=BEST_PSNR)


def best_counted(first: Float[Tensor, "p"]) -> float:
    """Return the PSNR beyond which an image counts no further: 10 dB above the median.

    Else the one view that shows an even wall, at 50 dB, decides for all others.
    """
    return min(BEST_PSNR, float(first.median()) + 10.0)
