"""Views that are held out, and the full scene as it looks from them."""

from typing import NamedTuple

import torch

from cvtgs.cameras import Cameras
from cvtgs.evaluation import psnr, ssim
from cvtgs.progress import ProgressEvent, ProgressListener
from cvtgs.rendering import render
from cvtgs.scene import GaussianScene
from cvtgs.views import automatic_views

HELDOUT_SEED = 307
"""Other views than those of evaluations, and than those that presets and refinements look at."""

VIEWS, WIDTH, HEIGHT = 8, 640, 480
"""As many and as large as ``cvtgs evaluate`` takes: scores depend on the size of images."""

MOST_PSNR = 60.0
"""Images that are closer than this are as good as equal."""

STAGE = "look"


class Quality(NamedTuple):
    """How close images come to those of the full scene.

    Attributes:
        psnr: Mean over the views, dB, at most 60 each.
        ssim: Mean over the views.
    """

    psnr: float
    ssim: float


class Judge:
    """Scores small scenes; the full scene is rendered only once.

    Memory: ``12 c h w`` bytes for the images.
    """

    def __init__(
        self, full: GaussianScene, cameras: Cameras | None, *, listener: ProgressListener
    ) -> None:
        self._cameras = cameras or automatic_views(
            full, VIEWS, width=WIDTH, height=HEIGHT, seed=HELDOUT_SEED
        )
        self._images = []
        for row in range(len(self._cameras)):
            listener(ProgressEvent(stage=STAGE, done=row, total=len(self._cameras)))
            self._images.append(self._image(full, row))
        listener(ProgressEvent(stage=STAGE, done=len(self._cameras), total=len(self._cameras)))

    def score(self, small: GaussianScene) -> Quality:
        """Score a small scene."""
        decibels, similarities = [], []
        for row, truth in enumerate(self._images):
            image = self._image(small, row)
            decibels.append(min(float(psnr(image, truth)), MOST_PSNR))
            similarities.append(float(ssim(image, truth)))
        return Quality(sum(decibels) / len(decibels), sum(similarities) / len(similarities))

    @torch.no_grad()
    def _image(self, scene: GaussianScene, row: int) -> torch.Tensor:
        camera = self._cameras.select(torch.tensor([row]))
        return render(scene, camera).rgb.clamp(0, 1)
