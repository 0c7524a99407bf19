"""Match opacities, then colours, to images of the full scene, without gradient descent."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.cells import Partition
from cvtgs.checks import check_amounts, checked
from cvtgs.config import MatchConfig
from cvtgs.counts import checked_whole
from cvtgs.errors import InvalidArgumentError
from cvtgs.math import parameters
from cvtgs.math.segments import segment_sum
from cvtgs.math.spherical_harmonics import SH_C0, evaluate, rest_basis
from cvtgs.rendering import BlendingWeights, ObservedViews, blending_weights, contributions, render
from cvtgs.rendering.render import check_observed, showing_rows
from cvtgs.report import MatchReport
from cvtgs.scene import GaussianScene

__all__ = ["Matched", "cell_contributions", "fit_colors", "match_opacities", "match_views"]

HELDOUT_EVERY = 8  # one image in this many is held out; none if there are fewer images
LAST_ITERATIONS = 3  # of conjugate gradients on all images, after those without the held-out ones
FLOOR = 0.02  # share of the median weight that is added to those that the ridge is proportional to
LEAST_PIXELS = 1.0  # added to contributions, so that barely visible Gaussians keep their opacity
LARGEST_FACTOR = 3.0  # limit of the contribution ratio, and of its inverse, in one round
POWER = 0.7  # of the ratio, below 1 so that rounds do not overshoot: neighbours change as well
LARGEST_DEPTH = 6.0  # no change raises an optical depth above this


class LinearView(NamedTuple):
    """One image as a linear function of changes of colours."""

    weights: BlendingWeights
    basis: Float[Tensor, "m k"]  # SH basis in the viewing direction of each Gaussian
    residual: Float[Tensor, "h w 3"]  # target image minus rendered image

    def paint(self, changes: Float[Tensor, "m k 3"]) -> Float[Tensor, "h w 3"]:
        """Return the change of the image for given changes of the coefficients."""
        return self.weights.paint(self._colors(changes))

    def normal(self, changes: Float[Tensor, "m k 3"]) -> Float[Tensor, "m k 3"]:
        """Return the product of the normal matrix of this image and the changes."""
        return self.basis[:, :, None] * self.weights.normal(self._colors(changes))[:, None]

    def gradient(self) -> Float[Tensor, "m k 3"]:
        """Return the transposed linear map applied to the residual."""
        return self.basis[:, :, None] * self.weights.collect(self.residual)[:, None]

    def _colors(self, changes: Float[Tensor, "m k 3"]) -> Float[Tensor, "m 3"]:
        if changes.shape[1] == 1:
            return self.basis * changes[:, 0]
        return (self.basis[:, :, None] * changes).sum(dim=1)


def linear_view(
    small: GaussianScene, camera: Cameras, wanted: Float[Tensor, "h w 3"]
) -> LinearView:
    """Return an image as a linear function of colours, exact where none is below 0."""
    weights = blending_weights(small, camera)
    offsets = small.means.double() - camera.centers.to(small.device).double()
    directions = torch.nn.functional.normalize(offsets, dim=1).to(small.dtype)
    painted = weights.paint(evaluate(small.sh0, small.shN, directions))
    constant = torch.full_like(directions[:, :1], SH_C0)
    basis = torch.cat([constant, rest_basis(directions, small.sh_degree)], dim=1)
    return LinearView(weights, basis, wanted.to(painted) - painted)


@checked
@torch.no_grad()
def fit_colors(
    small: GaussianScene, views: ObservedViews, *, config: MatchConfig, frozen: int = 0
) -> GaussianScene:
    """Fit the colours of a scene, all SH bands, to images by linear least squares.

    With the geometry fixed, an image is ``A c``: ``A`` holds the weights ``alpha * T`` times the
    SH basis. The changes ``x`` of the coefficients minimize ``|A x - r|^2 + |L x|^2``, where ``r``
    is the residual of the images. The ridge ``L`` grows with the weight of a Gaussian and is
    stronger for view-dependent bands. Every eighth image that shows something is held out: if the
    full changes help there, all images are used, else they are scaled down to the best step. Not
    part of CVT-GS.

    Memory: the blending weights of all images, and six times the colours.

    Args:
        small: The scene.
        views: Target images.
        config: Iterations and ridge.
        frozen: Number of Gaussians at the start of the scene that keep their colours.

    Returns:
        The scene with new colours; the same object if there are no iterations.

    Raises:
        InvalidArgumentError: An argument has another type, or ``frozen`` is out of range.

    Example:
        >>> from cvtgs.rendering import observe
        >>> from cvtgs.synthetic import scene as make
        >>> from cvtgs.views import automatic_views
        >>> scene = make("object", 200, sh_degree=0, seed=0)
        >>> views = observe(scene, automatic_views(scene, 4, width=48, height=48))
        >>> gray = scene.with_tensors({"sh0": torch.zeros_like(scene.sh0)}, {})
        >>> config = MatchConfig(color_iterations=30, color_ridge=1e-4)
        >>> found = fit_colors(gray, views, config=config)
        >>> bool((found.sh0 - scene.sh0).abs().median() < 0.05)
        True
    """
    check_observed(views, "views")
    frozen = checked_whole(frozen, "frozen", least=0, most=len(small), things="Gaussians")
    if not config.color_iterations:
        return small
    linear = [
        linear_view(small, camera, image)
        for camera, image in zip(views.cameras.singles(), views.rgb, strict=True)
    ]
    rows = heldout_rows(views.alpha)
    heldout = [linear[row] for row in rows]
    seen = [view for row, view in enumerate(linear) if row not in rows]
    problem = LeastSquares(seen, config=config, frozen=frozen)
    changes = problem.solve(config.color_iterations)
    if heldout:
        step = best_step(heldout, changes)
        if step > 0.5:  # the full step is better than none
            whole = LeastSquares(linear, config=config, frozen=frozen)
            changes = whole.solve(LAST_ITERATIONS, start=changes)
        else:
            changes = step * changes
    tensors = {"sh0": small.sh0 + changes[:, :1], "shN": small.shN + changes[:, 1:]}
    return small.with_tensors(tensors)


def heldout_rows(alpha: Float[Tensor, "c h w"]) -> Sequence[int]:
    """Return the rows of held-out images: every eighth that shows something, none of fewer."""
    shown = showing_rows(alpha)
    return shown[HELDOUT_EVERY // 2 :: HELDOUT_EVERY] if len(shown) >= HELDOUT_EVERY else []


def best_step(views: Sequence[LinearView], changes: Float[Tensor, "m k 3"]) -> float:
    """Return the step along the changes, 0 to 1, of least squared error in the images."""
    along = squares = 0.0
    for view in views:
        painted = view.paint(changes).double()
        along += float((painted * view.residual).sum())
        squares += float(painted.square().sum())
    return min(1.0, max(0.0, along / squares)) if squares > 0.0 else 0.0


class LeastSquares:
    """The normal equations of the colours with a ridge, for each of red, green and blue.

    Conjugate gradients (Hestenes and Stiefel 1952) with the diagonal as preconditioner.
    """

    def __init__(self, views: Sequence[LinearView], *, config: MatchConfig, frozen: int) -> None:
        self._views = views
        seen, squares = torch.zeros_like(views[0].basis), torch.zeros_like(views[0].basis)
        for view in views:
            powers, basis = view.weights.powers().to(view.basis), view.basis.square()
            seen += powers[:, :1] * basis[:, :1]
            squares += powers[:, 1:] * basis
        weighed = seen[seen[:, 0] > 0, 0]
        floor = FLOOR * weighed.median() if len(weighed) else seen.new_ones(())
        ridge = config.color_ridge * (seen + floor)
        ridge[:, 1:] *= config.band_ridge
        self._ridge = ridge[:, :, None]
        self._inverse = 1.0 / (squares[:, :, None] + self._ridge)
        self._inverse[:frozen] = 0.0  # so that no search direction has these rows

    def solve(
        self, iterations: int, *, start: Float[Tensor, "m k 3"] | None = None
    ) -> Float[Tensor, "m k 3"]:
        """Return the changes after some iterations, from a given start or from zero."""
        residual = torch.stack([view.gradient() for view in self._views]).sum(dim=0)
        found = torch.zeros_like(residual)
        if start is not None:
            found = start
            residual = residual - self._product(start)
        scaled = self._inverse * residual
        direction, old = scaled, _dots(residual, scaled)
        for _ in range(iterations):
            image = self._product(direction)
            length = _divided(old, _dots(direction, image)).to(found.dtype)
            found = found + length * direction
            residual = residual - length * image
            scaled = self._inverse * residual
            new = _dots(residual, scaled)
            direction = scaled + _divided(new, old).to(found.dtype) * direction
            old = new
        return found

    def _product(self, changes: Float[Tensor, "m k 3"]) -> Float[Tensor, "m k 3"]:
        total = self._ridge * changes
        for view in self._views:
            total += view.normal(changes)
        return total


def _dots(one: Float[Tensor, "m k 3"], other: Float[Tensor, "m k 3"]) -> Float[Tensor, "3"]:
    return (one.double() * other.double()).sum(dim=(0, 1))


def _divided(above: Float[Tensor, "3"], below: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Divide; 0 where rounding leaves nothing, or less, to divide by."""
    return torch.where(below > 0, above / below.clamp_min(1e-300), 0.0)


class Matched(NamedTuple):
    """A matched scene and its report.

    Attributes:
        scene: The scene.
        report: The gain.
    """

    scene: GaussianScene
    report: MatchReport


@checked
def cell_contributions(
    contributions: Float[Tensor, "n"], partition: Partition
) -> Float[Tensor, "m"]:
    """Sum the contributions of the members of every cell to the images of the full scene.

    Args:
        contributions: Contribution of every Gaussian of the full scene, pixels.
        partition: Members of every cell; Gaussians in no cell are ignored.

    Returns:
        Contribution of every cell, pixels.

    Raises:
        InvalidArgumentError: There are fewer contributions than members, or these are no floats.

    Example:
        >>> cells = Partition.from_labels(torch.tensor([1, 0, 1]), 2)
        >>> cell_contributions(torch.tensor([1.0, 2.0, 4.0]), cells).tolist()
        [2.0, 5.0]
    """
    if len(contributions) < len(partition.order):
        raise InvalidArgumentError(
            f"contributions must be one number for each Gaussian, at least the "
            f"{len(partition.order):,} in cells; found shape {tuple(contributions.shape)}."
        )
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
    eighth that shows something, or all if there are fewer. See :func:`fit_colors` for the colours.

    Args:
        small: The merged scene.
        views: Images of the full scene.
        targets: Target contribution of every Gaussian to these images, pixels.
        config: Rounds, iterations and ridge.
        frozen: Number of Gaussians at the start that stay bit for bit; their targets are ignored.

    Returns:
        The scene and the report.

    Raises:
        InvalidArgumentError: As for :func:`match_opacities` and :func:`fit_colors`.

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
    check_observed(views, "views")
    matched = match_opacities(small, views.cameras, targets, config=config, frozen=frozen)
    deciding = heldout_views(views)
    before = mean_squared_error(small, deciding)
    helps = matched is not small and mean_squared_error(matched, deciding) < before
    colored = fit_colors(matched if helps else small, views, config=config, frozen=frozen)
    after = before if colored is small else mean_squared_error(colored, deciding)
    report = MatchReport(
        views=len(views.cameras),
        heldout=len(deciding.cameras),
        opacities_kept=helps,
        psnr_before=psnr_from_error(before),
        psnr_after=psnr_from_error(after),
        backend=views.backend,
    )
    return Matched(colored, report)


@torch.no_grad()
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

    Raises:
        InvalidArgumentError: Targets have another shape or are below 0; ``frozen`` is too large.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> from cvtgs.views import automatic_views
        >>> scene = make("object", 200, sh_degree=0, seed=0)
        >>> views = automatic_views(scene, 2, width=32, height=32)
        >>> wanted = 0.5 * contributions(scene, views)
        >>> found = match_opacities(scene, views, wanted, config=MatchConfig(opacity_rounds=8))
        >>> bool(contributions(found, views).sum() < 1.2 * wanted.sum())
        True
    """
    frozen = checked_whole(frozen, "frozen", least=0, most=len(small), things="Gaussians")
    check_amounts(targets, "targets", len(small), ignored=frozen)
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
    """Return every eighth view that shows something, or all of these if there are fewer."""
    held = heldout_rows(views.alpha) or showing_rows(views.alpha)
    rows = torch.tensor(held, device="cpu")
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
