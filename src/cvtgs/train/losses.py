"""What one training step makes small."""

import random

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.evaluate import psnr
from cvtgs.losses import relative_loss
from cvtgs.mergenet import MergeNet, Residuals
from cvtgs.render import render
from cvtgs.train.cases import Case
from cvtgs.train.config import LossConfig, TrainConfig
from cvtgs.train.crops import crop_cells
from cvtgs.train.views import Views


def scene_loss(
    net: MergeNet, case: Case, views: Views, *, config: TrainConfig, dice: random.Random
) -> Float[Tensor, ""]:
    """Render the corrected scene from some views, and compare a random crop of each.

    Each has a random background. Whole pictures are rendered: a camera that sees the crop only
    would draw what lies beside it differently.

    Args:
        net: The network.
        case: A scene at a ratio.
        views: Pictures of the full scene, squares of one size.
        config: Number of views, size of the crops, and what counts how much.
        dice: Draws views, crops and backgrounds.

    Returns:
        The loss.
    """
    residuals: Residuals = net(case.descriptors)
    corrected = case.corrected(residuals)
    losses = []
    for _ in range(config.views.per_step):
        background = _drawn_color(dice, case)
        view = views.select(dice.randrange(len(views.cameras)))
        y, x = (_drawn_slice(view.cameras.width, config.views.crop, dice) for _ in range(2))
        picture = render(corrected, view.cameras, background=background).rgb
        target = view.over(background)
        losses.append(picture_loss(picture[:, y, x], target[:, y, x], config.loss))
    return torch.stack(losses).mean() + _price(residuals, config.loss)


def local_loss(
    net: MergeNet, case: Case, *, config: TrainConfig, dice: random.Random
) -> Float[Tensor, ""]:
    """Render some cells, each alone, in random crops: members against the corrected Gaussian.

    Args:
        net: The network.
        case: A scene at a ratio.
        config: Number of cells, and what counts how much.
        dice: Draws cells, turns, crops and background.

    Returns:
        The loss.
    """
    number = min(config.cells, len(case.cells))
    rows = torch.tensor(sorted(dice.sample(range(len(case.cells)), number)))
    some = case.select(rows)
    residuals: Residuals = net(some.descriptors)
    crops = crop_cells(some, some.changed(residuals), dice=dice)
    background = _drawn_color(dice, case)
    with torch.no_grad():
        target = render(crops.members, crops.camera, background=background).rgb
    picture = render(crops.corrected, crops.camera, background=background).rgb
    return picture_loss(picture, target, config.loss) + _price(residuals, config.loss)


def picture_loss(
    picture: Float[Tensor, "1 h w 3"], target: Float[Tensor, "1 h w 3"], config: LossConfig
) -> Float[Tensor, ""]:
    """Compare a picture with what it should be.

    Args:
        picture: Picture of the corrected Gaussians.
        target: What it should be.
        config: What counts how much.

    Returns:
        The sum of logarithms of :class:`LossConfig`.
    """
    return relative_loss(
        picture,
        target,
        squared_weight=config.squared,
        image_weight=config.image,
        ssim_weight=config.ssim,
    )


def _price(residuals: Residuals, config: LossConfig) -> Float[Tensor, ""]:
    if not config.residual:
        return residuals.logits.new_zeros(())
    return config.residual * residuals.cost()


def _drawn_slice(size: int, crop: int, dice: random.Random) -> slice:
    start = dice.randint(0, max(0, size - crop))
    return slice(start, start + crop)


@torch.no_grad()
def scores(net: MergeNet, case: Case, views: Views) -> tuple[float, float]:
    """Tell how good the merged Gaussians look without and with the network, over grey.

    Args:
        net: The network.
        case: A scene at a ratio.
        views: Pictures of the full scene.

    Returns:
        PSNR before and after, the mean over the views.
    """
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
