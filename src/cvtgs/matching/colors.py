"""Colours by linear least squares: an image is linear in the colours of its Gaussians."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.config import MatchConfig
from cvtgs.math.spherical_harmonics import SH_C0, evaluate, rest_basis
from cvtgs.rendering import BlendingWeights, ObservedViews, blending_weights
from cvtgs.scene import GaussianScene

HELDOUT_EVERY = 8
"""One image in this many is held out; none if there are fewer images."""

LAST_ITERATIONS = 3
"""Conjugate-gradient iterations on all images, after those without the held-out images."""

FLOOR = 0.02
"""Share of the median weight that is added to the weights to which the ridge is proportional."""


class LinearView(NamedTuple):
    """One image as a linear function of changes of colours.

    Attributes:
        weights: Blending weights of the scene.
        basis: ``(m, k)`` SH basis in the viewing direction of each Gaussian.
        residual: Target image minus rendered image.
    """

    weights: BlendingWeights
    basis: Float[Tensor, "m k"]
    residual: Float[Tensor, "h w 3"]

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
    """Return the image of one camera as a linear function of the colours.

    Colours below 0 are rendered as 0, so the function is exact only where no colour is below 0.
    """
    weights = blending_weights(small, camera)
    offsets = small.means.double() - camera.centers.to(small.device).double()
    directions = torch.nn.functional.normalize(offsets, dim=1).to(small.dtype)
    painted = weights.paint(evaluate(small.sh0, small.shN, directions))
    constant = torch.full_like(directions[:, :1], SH_C0)
    basis = torch.cat([constant, rest_basis(directions, small.sh_degree)], dim=1)
    return LinearView(weights, basis, wanted.to(painted) - painted)


def fit_colors(
    small: GaussianScene, views: ObservedViews, *, config: MatchConfig, frozen: int = 0
) -> GaussianScene:
    """Fit the colours of a scene, all SH bands, to images by linear least squares.

    With the geometry fixed, an image is ``A c``: ``A`` holds the weights ``alpha * T`` times the
    SH basis. The changes ``x`` of the coefficients minimize ``|A x - r|^2 + |L x|^2``, where ``r``
    is the residual of the images. The ridge ``L`` grows with the weight of a Gaussian and is
    stronger for view-dependent bands. Every eighth image is held out: if the full changes help
    there, all images are used, else the changes are scaled down to the best step. This is our own
    rule, not part of CVT-GS.

    Memory: the blending weights of all images, and six times the colours.

    Args:
        small: The scene.
        views: Target images.
        config: Iterations and ridge.
        frozen: Number of Gaussians at the start of the scene that keep their colours.

    Returns:
        The scene with new colours; the same object if there are no iterations.

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
    if not config.color_iterations:
        return small
    linear = [
        linear_view(small, camera, image)
        for camera, image in zip(views.cameras.singles(), views.rgb, strict=True)
    ]
    rows = heldout_rows(len(linear))
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


def heldout_rows(count: int) -> range:
    """Return the row numbers of the held-out images: every eighth, none of fewer than eight."""
    return range(HELDOUT_EVERY // 2, count if count >= HELDOUT_EVERY else 0, HELDOUT_EVERY)


def best_step(views: Sequence[LinearView], changes: Float[Tensor, "m k 3"]) -> float:
    """Return the step along the changes, 0 to 1, of least squared error in the images."""
    along = squares = 0.0
    for view in views:
        painted = view.paint(changes).double()
        along += float((painted * view.residual).sum())
        squares += float(painted.square().sum())
    return min(1.0, max(0.0, along / squares)) if squares > 0.0 else 0.0


class LeastSquares:
    """The normal equations of the colours with a ridge, and their solution.

    Conjugate gradients (Hestenes and Stiefel 1952) with the diagonal as preconditioner. Red, green
    and blue are solved together: they share the matrix, but have their own step lengths.
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
    return torch.where(below > 0, above / below.clamp_min(1e-300), 0.0)
