"""Match opacities so that each Gaussian contributes what its cell did, then match colours."""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.cells import Partition
from cvtgs.config import MatchConfig
from cvtgs.matching.colors import fit_colors, heldout_rows
from cvtgs.math import parameters
from cvtgs.math.segments import segment_sum
from cvtgs.rendering import ObservedViews, contributions, render
from cvtgs.report import MatchReport
from cvtgs.scene import GaussianScene

LEAST_PIXELS = 1.0
"""Added to actual and target contributions, so that barely visible Gaussians keep their opacity."""

LARGEST_FACTOR = 3.0
"""Limit of the contribution ratio, and of its inverse, in one round."""

POWER = 0.7
"""Exponent of the ratio, below 1 so that rounds do not overshoot: neighbours change as well."""

LARGEST_DEPTH = 6.0
"""No change raises an optical depth above this."""


class Matched(NamedTuple):
    """A matched scene and its report.

    Attributes:
        scene: The scene.
        report: The gain.
    """

    scene: GaussianScene
    report: MatchReport


def cell_contributions(
    contributions: Float[Tensor, "n"], partition: Partition
) -> Float[Tensor, "m"]:
    """Sum the contributions of the members of every cell to the images of the full scene.

    Args:
        contributions: Contribution of every Gaussian of the full scene, pixels.
        partition: Members of every cell.

    Returns:
        Contribution of every cell, pixels.

    Example:
        >>> cells = Partition.from_labels(torch.tensor([1, 0, 1]), 2)
        >>> cell_contributions(torch.tensor([1.0, 2.0, 4.0]), cells).tolist()
        [2.0, 5.0]
    """
    return segment_sum(contributions[partition.order], partition.offsets)


def match_views(
    small: GaussianScene,
    views: ObservedViews,
    targets: Float[Tensor, "m"],
    *,
    config: MatchConfig,
    frozen: int = 0,
) -> Matched:
    """Match a merged scene to images of the full one: opacities first, then colours.

    The new opacities are kept if they lower the mean squared error of the held-out images: every
    eighth, or all if there are fewer than eight. See :func:`fit_colors` for the colours.

    Args:
        small: The merged scene.
        views: Images of the full scene.
        targets: Target contribution of every Gaussian to these images, pixels.
        config: Rounds, iterations and ridge.
        frozen: Number of Gaussians at the start that stay bit for bit; their targets are ignored.

    Returns:
        The scene and the report.

    Example:
        >>> from cvtgs.rendering import observe
        >>> from cvtgs.synthetic import scene as make
        >>> from cvtgs.views import automatic_views
        >>> scene = make("object", 200, sh_degree=0, seed=0)
        >>> views = observe(scene, automatic_views(scene, 8, width=32, height=32))
        >>> config = MatchConfig(opacity_rounds=1)
        >>> match_views(scene, views, views.contributions, config=config).report.opacities_kept
        False
    """
    deciding = heldout_views(views)
    before = mean_squared_error(small, deciding)
    matched = match_opacities(small, views.cameras, targets, config=config, frozen=frozen)
    helps = matched is not small and mean_squared_error(matched, deciding) < before
    colored = fit_colors(matched if helps else small, views, config=config, frozen=frozen)
    after = before if colored is small else mean_squared_error(colored, deciding)
    report = MatchReport(
        views=len(views.cameras),
        opacities_kept=helps,
        psnr_before=psnr_from_error(before),
        psnr_after=psnr_from_error(after),
        backend=views.backend,
    )
    return Matched(colored, report)


def match_opacities(
    small: GaussianScene,
    cameras: Cameras,
    targets: Float[Tensor, "m"],
    *,
    config: MatchConfig,
    frozen: int = 0,
) -> GaussianScene:
    """Adjust opacities so that the contribution of every Gaussian approaches its target.

    A round multiplies the optical depth of every Gaussian by a power of the ratio of its target
    contribution to its actual one. This is our own rule, not part of CVT-GS.

    Args:
        small: The scene.
        cameras: Cameras of the images.
        targets: Target contributions, pixels, as :func:`cell_contributions` returns them.
        config: Number of rounds.
        frozen: Number of Gaussians at the start of the scene that stay unchanged.

    Returns:
        The scene with new opacities; the same object if there are no rounds.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> from cvtgs.views import automatic_views
        >>> scene = make("object", 200, sh_degree=0, seed=0)
        >>> views = automatic_views(scene, 2, width=32, height=32)
        >>> wanted = 0.5 * contributions(scene, views)
        >>> config = MatchConfig(opacity_rounds=8)
        >>> found = match_opacities(scene, views, wanted, config=config)
        >>> bool(contributions(found, views).sum() < 1.2 * wanted.sum())
        True
    """
    for _ in range(config.opacity_rounds):
        own = contributions(small, cameras)
        ratios = (targets + LEAST_PIXELS) / (own + LEAST_PIXELS)
        factors = ratios.clamp(1 / LARGEST_FACTOR, LARGEST_FACTOR).pow(POWER)
        factors[:frozen] = 1.0
        small = with_deeper_opacities(small, factors)
    return small


def with_deeper_opacities(small: GaussianScene, factors: Float[Tensor, "m"]) -> GaussianScene:
    """Multiply optical depths; a factor of 1 leaves a Gaussian unchanged, bit for bit."""
    depths = parameters.optical_depth_from_logit(small.logit_opacities.double())
    deeper = torch.minimum(depths * factors, depths.clamp_min(LARGEST_DEPTH))
    logits = parameters.logit_from_optical_depth(deeper).to(small.dtype)
    changed = torch.where(factors == 1.0, small.logit_opacities, logits)
    return small.with_tensors({"logit_opacities": changed})


def heldout_views(views: ObservedViews) -> ObservedViews:
    """Return every eighth view, or all views if there are fewer than eight."""
    count = len(views.cameras)
    rows = torch.tensor(heldout_rows(count) or range(count), device="cpu")
    cameras = views.cameras.select(rows)
    return replace(views, cameras=cameras, rgb=views.rgb[rows], alpha=views.alpha[rows])


def mean_squared_error(small: GaussianScene, views: ObservedViews) -> float:
    """Return the mean squared error of the images of a scene, over black, as PSNR counts it."""
    total = 0.0
    for camera, wanted in zip(views.cameras.singles(), views.rgb, strict=True):
        with torch.no_grad():
            image = render(small, camera).rgb[0]
        total += float((image.clamp(0, 1) - wanted.clamp(0, 1)).double().square().mean())
    return total / len(views.cameras)


def psnr_from_error(error: float) -> float:
    """Return the PSNR of a mean squared error, dB; at most 100."""
    return -10.0 * math.log10(max(error, 1e-10))
