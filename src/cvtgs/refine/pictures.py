"""Pictures of the full scene: some to learn from, rendered when needed, and some that decide."""

import random
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.config import RefineConfig
from cvtgs.refine.looking import Outlook
from cvtgs.render import render
from cvtgs.scene import GaussianScene

BEST_PSNR = 60.0
"""Pictures that are nearer to each other count as equal, dB."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picture:
    """One picture of the full scene; the background is left open.

    Attributes:
        camera: From where.
        rgb: ``(1, h, w, 3)`` colours over black.
        alpha: ``(1, h, w)`` opacity.
    """

    camera: Cameras
    rgb: Float[Tensor, "1 h w 3"]
    alpha: Float[Tensor, "1 h w"]

    def over(self, background: Float[Tensor, "3"]) -> Float[Tensor, "1 h w 3"]:
        """Put the picture over a background.

        Args:
            background: Red, green, blue.

        Returns:
            The picture, in the dtype of the background.
        """
        rgb, alpha = self.rgb.to(background.dtype), self.alpha.to(background.dtype)
        return rgb + (1 - alpha)[..., None] * background


@torch.no_grad()
def take_picture(full: GaussianScene, camera: Cameras) -> Picture:
    """Render the full scene once.

    Args:
        full: The scene.
        camera: One camera.

    Returns:
        The picture, in the scene's dtype.
    """
    found = render(full, camera)
    return Picture(camera=camera, rgb=found.rgb, alpha=found.alpha)


class Album:
    """Pictures to learn from: a new one now and then, else one that is there.

    Memory: 8 bytes per pixel of at most ``config.pictures`` pictures; of one, if every step has a
    new one.

    Args:
        full: The full scene.
        outlook: Where new pictures are taken from, at least one.
        config: How often, and how many are kept.
        seed: Which of them are looked at again.
    """

    def __init__(
        self, full: GaussianScene, outlook: Outlook, *, config: RefineConfig, seed: int
    ) -> None:
        always_new = outlook.endless and config.steps_per_picture == 1
        self._full = full
        self._cameras = outlook.learning
        self._steps_per_picture = config.steps_per_picture
        self._most = 1 if always_new else config.pictures
        self._dice = random.Random(seed)
        self._kept: list[Picture] = []
        self._drawn = 0
        self.taken = 0

    def draw(self) -> Picture:
        """Give a picture to learn from.

        Returns:
            A new one for every ``steps_per_picture``, if there are cameras left, else an old one.
        """
        is_turn = self._drawn % self._steps_per_picture == 0
        self._drawn += 1
        camera = next(self._cameras, None) if is_turn else None
        if camera is None:
            return self._dice.choice(self._kept)
        if len(self._kept) == self._most:
            self._kept.pop(self._dice.randrange(len(self._kept)))
        picture = take_picture(self._full, camera)
        self._kept.append(
            Picture(camera=camera, rgb=picture.rgb.half(), alpha=picture.alpha.half())
        )
        self.taken += 1
        return self._kept[-1]

    def draw_color(self) -> Float[Tensor, "3"]:
        """Give a background.

        Returns:
            Red, green, blue in [0, 1], with dtype and device of the scene.
        """
        return self._full.means.new_tensor([self._dice.random() for _ in range(3)])


@torch.no_grad()
def scores(scene: GaussianScene, pictures: tuple[Picture, ...]) -> Float[Tensor, "p"]:
    """Tell how near a scene comes to each picture of the full one.

    Args:
        scene: The scene.
        pictures: Pictures of the full one.

    Returns:
        PSNR of every picture over black and over white, each at most 60 dB, float64.
    """
    values = []
    for picture in pictures:
        found = take_picture(scene, picture.camera)
        for shade in (0.0, 1.0):
            background = scene.means.new_full((3,), shade)
            error = found.over(background).clamp(0, 1) - picture.over(background).clamp(0, 1)
            values.append(-10 * torch.log10(error.double().square().mean()))
    return torch.stack(values).clamp(max=BEST_PSNR)


def best_counted(first: Float[Tensor, "p"]) -> float:
    """Give the PSNR beyond which a picture counts no further: 10 dB above the median.

    Else the one view that shows an even wall, at 50 dB, decides for all others.

    Args:
        first: PSNR of the pictures of the scene that came in.

    Returns:
        A limit, at most 60 dB.

    Example:
        >>> best_counted(torch.tensor([24.0, 25.0, 50.0]))
        35.0
    """
    return min(BEST_PSNR, float(first.median()) + 10.0)
