"""View-dependent colours of Gaussians, reduced to the few numbers that tell neighbours apart."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.devices import HOST, move_together, one_thread
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import GaussianScene

LARGEST_COLOR = 1.5
"""Limit of a colour, and of the norm of coefficients, so that a few extreme ones do not decide."""

MAX_COMPONENTS = 12
"""Largest number of components."""

LEAST_SPREAD = 0.01
"""Smallest standard deviation of a component that counts, in units of RGB."""

LEAST_SHARE = 0.1
"""Smallest share of the variance of a component that neighbours have in common; less is chance."""

SAMPLED_PAIRS = 1 << 14
"""Approximate number of pairs of neighbours in which components are sought."""


@one_thread()
def view_components(
    scene: GaussianScene, rows: Int[Tensor, "n"], masses: Float[Tensor, "n"]
) -> Float[Tensor, "c k"]:
    """Find the components of view-dependent colour that neighbouring Gaussians have in common.

    In some scenes, the bands above the constant one show highlights and reflections that
    neighbours share. In others they are mostly noise of the training, which makes neighbours look
    different where images do not. So the components are principal ones, and each counts by the
    share of its variance that is common to neighbours: the variance minus half of the mean squared
    difference of neighbours (the nugget of a variogram, Matheron 1963), over the variance.

    Args:
        scene: The Gaussians.
        rows: Row numbers, in the order of a space-filling curve.
        masses: Mass of each as seen in images.

    Returns:
        The matrix that maps the coefficients of a Gaussian, flattened, to its components; float64,
        on the CPU. It has no column if nothing is common to neighbours.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 100, sh_degree=1, seed=0)
        >>> view_components(scene, torch.arange(100), scene.masses).shape[0]
        9
    """
    width = scene.shN[:1].numel()
    if width == 0 or len(rows) < 2:
        return torch.zeros(width, 0, dtype=torch.float64, device=HOST)
    step = max(1, len(rows) // SAMPLED_PAIRS)
    first = torch.arange(0, len(rows) - 1, step, device=rows.device)
    both = torch.cat([first, first + 1])
    bands = scene.shN.index_select(0, rows.index_select(0, both))
    bands, weights = move_together([bands, masses.index_select(0, both)], HOST)
    colors, weights = _project(bands.double(), torch.eye(width, device=HOST)), weights.double()
    weights = weights / weights.sum().clamp_min(torch.finfo(torch.float64).tiny)
    centered = colors - weights @ colors
    variances, axes = torch.linalg.eigh(centered.T @ (centered * weights[:, None]))
    (ones, others), pairs = colors.chunk(2), weights.view(2, -1).sum(dim=0)
    common = variances - 0.5 * pairs @ ((ones - others) @ axes).square()
    chosen = torch.sort(common, descending=True, stable=True).indices[:MAX_COMPONENTS]
    least = (LEAST_SHARE * variances).clamp_min(LEAST_SPREAD**2)
    chosen = chosen[common[chosen] > least[chosen]]
    components: Tensor = axes[:, chosen] * (common / variances)[chosen].sqrt()
    return components


def view_colors(
    scene: GaussianScene, rows: Int[Tensor, "r"], components: Float[Tensor, "c k"]
) -> Float[Tensor, "r k"]:
    """Return the components of the view-dependent colour of some Gaussians, in units of RGB.

    The sum of the squared differences of two Gaussians is at most the squared difference of their
    view-dependent colours, averaged over all directions.

    Args:
        scene: The Gaussians; bands beyond those of the components are ignored.
        rows: Row numbers.
        components: Result of :func:`view_components`, on the device of the scene.

    Returns:
        One row per Gaussian, float64.
    """
    return _project(scene.shN.index_select(0, rows), components)


def _project(bands: Float[Tensor, "n b 3"], components: Float[Tensor, "c k"]) -> Tensor:
    """Return components, in units in which the mean of a squared colour is the sum of squares."""
    coefficients = bands.flatten(1)[:, : len(components)]
    norms = SH_C0 * torch.linalg.vector_norm(coefficients, dim=1, keepdim=True)
    factors = SH_C0 * LARGEST_COLOR / norms.double().clamp_min(LARGEST_COLOR)
    projected = coefficients @ components.to(coefficients.dtype)
    colors: Tensor = (projected.double() * factors).nan_to_num(0.0, 0.0, 0.0)
    return colors  # zeros where squares overflow
