"""What one training step makes small."""

import random

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.evaluation import psnr
from cvtgs.losses import relative_loss
from cvtgs.mergenet import MergeNet, Residuals
from cvtgs.rendering import render
from cvtgs.train.cases import Case
from cvtgs.train.config import LossConfig, TrainConfig
from cvtgs.train.crops import crop_cells
from cvtgs.train.views import Views


def scene_loss(
    net: MergeNet, case: Case, views: Views, *, config: TrainConfig, dice: random.Random
) -> Float[Tensor, ""]:
    """Render the corrected scene from some views, and compare a random crop of each.

    Each has a random background. Whole images are rendered: a camera that sees the crop only
    would draw what lies beside it differently.
    """
    residuals: Residuals = net(case.descriptors)
    corrected = case.corrected(residuals)
    losses = []
    for _ in range(config.views.per_step):
        background = _drawn_color(dice, case)
        view = views.select(dice.randrange(len(views.cameras)))
        y, x = (_drawn_slice(view.cameras.width, config.views.crop, dice) for _ in range(2))
        image = render(corrected, view.cameras, background=background).rgb
        target = view.over(background)
        losses.append(view_loss(image[:, y, x], target[:, y, x], config.loss))
    return torch.stack(losses).mean() + _price(residuals, config.loss)


def local_loss(
    net: MergeNet, case: Case, *, config: TrainConfig, dice: random.Random
) -> Float[Tensor, ""]:
    """Render some cells, each alone, in random crops: members against the corrected Gaussian."""
    number = min(config.cells, len(case.cells))
    rows = torch.tensor(sorted(dice.sample(range(len(case.cells)), number)))
    some = case.select(rows)
    residuals: Residuals = net(some.descriptors)
    crops = crop_cells(some, some.changed(residuals), dice=dice)
    background = _drawn_color(dice, case)
    with torch.no_grad():
        target = render(crops.members, crops.camera, background=background).rgb
    image = render(crops.corrected, crops.camera, background=background).rgb
    return view_loss(image, target, config.loss) + _price(residuals, config.loss)


def view_loss(
    image: Float[Tensor, "1 h w 3"], target: Float[Tensor, "1 h w 3"], config: LossConfig
) -> Float[Tensor, ""]:
    """Compare an image with what it should be."""
    return relative_loss(
        image,
        target,
        squared_weight=config.squared,
        image_weight=config.image,
        ssim_weight=config.ssim,
    )


def _price(residuals: Residuals, config: LossConfig) -> Float[Tensor, ""]:
    if not config.residual:
        return residuals.d_logit_opacities.new_zeros(())
    return config.residual * residuals.cost()


def _drawn_slice(size: int, crop: int, dice: random.Random) -> slice:
    start = dice.randint(0, max(0, size - crop))
    return slice(start, start + crop)


@torch.no_grad()
def scores(net: MergeNet, case: Case, views: Views) -> tuple[float, float]:
    """Return how good the merged Gaussians look without and with the network, over grey."""
    grey = case.reference.merged.means.new_full((3,), 0.5)
    target = views.over(grey)
    before, after = case.reference.merged, case.corrected(net(case.descriptors))
    found = [
        psnr(render(scene, views.cameras, background=grey).rgb, target).mean()
        for scene in (before, after)
    ]
    return float(found[0]), float(found[1])


def _drawn_color(dice: random.Random, case: Case) -> Float[Tensor, "3"]:
    return case.reference.merged.means.new_tensor([dice.random() for _ in range(3)])
