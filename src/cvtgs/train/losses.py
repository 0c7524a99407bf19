"""What one training step makes small."""

import random

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.evaluate import psnr
from cvtgs.losses import image_loss
from cvtgs.mergenet import MergeNet, Residuals
from cvtgs.render import render
from cvtgs.train.cases import Case, Views
from cvtgs.train.config import LossConfig
from cvtgs.train.crops import crop_cells

FAINTEST_SQUARED = 1e-5
FAINTEST_IMAGE = 1e-3
"""What is added to the errors of the reference, so that pictures without any do not count."""


def scene_loss(
    net: MergeNet, case: Case, views: Views, *, config: LossConfig, dice: random.Random
) -> Float[Tensor, ""]:
    """Render the corrected scene from one view, over a random background.

    Args:
        net: The network.
        case: A scene at a ratio.
        views: Pictures of the full scene.
        config: What counts how much.
        dice: Draws view and background.

    Returns:
        The loss; about 1 for a network that changes nothing.
    """
    row = dice.randrange(len(views.cameras))
    background = _drawn_color(dice, case)
    target = views.over(background, slice(row, row + 1))
    camera = views.cameras.select(torch.tensor([row]))
    residuals: Residuals = net(case.descriptors)
    with torch.no_grad():
        before = render(case.reference.merged, camera, background=background).rgb
    after = render(case.corrected(residuals), camera, background=background).rgb
    return relative_loss(before, after, target, config) + config.residual * residuals.cost()


def local_loss(
    net: MergeNet, case: Case, count: int, *, config: LossConfig, dice: random.Random
) -> Float[Tensor, ""]:
    """Render some cells, each alone, in random crops: members against the corrected Gaussian.

    Args:
        net: The network.
        case: A scene at a ratio.
        count: Cells to take at most.
        config: What counts how much.
        dice: Draws cells, turns, crops and background.

    Returns:
        The loss; about 1 for a network that changes nothing.
    """
    number = min(count, len(case.cells))
    rows = torch.tensor(sorted(dice.sample(range(len(case.cells)), number)))
    some = case.select(rows)
    residuals: Residuals = net(some.descriptors)
    crops = crop_cells(some, some.changed(residuals), dice=dice)
    background = _drawn_color(dice, case)
    with torch.no_grad():
        target = render(crops.members, crops.camera, background=background).rgb
        before = render(crops.merged, crops.camera, background=background).rgb
    after = render(crops.corrected, crops.camera, background=background).rgb
    return relative_loss(before, after, target, config) + config.residual * residuals.cost()


def relative_loss(
    before: Float[Tensor, "1 h w 3"],
    after: Float[Tensor, "1 h w 3"],
    target: Float[Tensor, "1 h w 3"],
    config: LossConfig,
) -> Float[Tensor, ""]:
    """Compare two pictures with a target, so that every scene and ratio counts the same.

    Args:
        before: Picture of the merged Gaussians.
        after: Picture of the corrected ones.
        target: What it should be.
        config: What counts how much.

    Returns:
        The loss of ``after`` in units of that of ``before``.
    """
    error, old_error = ((picture - target).square().mean() for picture in (after, before))
    squared = error / (old_error + FAINTEST_SQUARED)
    image = image_loss(after, target) / (image_loss(before, target) + FAINTEST_IMAGE)
    return config.squared * squared + config.image * image


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
    grey = views.cameras.Ks.new_full((3,), 0.5)
    target = views.over(grey, slice(None))
    before, after = case.reference.merged, case.corrected(net(case.descriptors))
    found = [
        psnr(render(scene, views.cameras, background=grey).rgb, target).mean()
        for scene in (before, after)
    ]
    return float(found[0]), float(found[1])


def _drawn_color(dice: random.Random, case: Case) -> Float[Tensor, "3"]:
    return case.reference.merged.means.new_tensor([dice.random() for _ in range(3)])
