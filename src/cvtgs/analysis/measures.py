"""Figures: what is measured on a scene to decide what it calls for."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.math import parameters
from cvtgs.math.frames import RobustFrame
from cvtgs.math.spherical_harmonics import REST_COUNTS, SH_C0
from cvtgs.scene import GaussianScene

UNBOUNDED_DISTANCE = 3.0
"""In robust radii: what lies beyond is far away."""

SAMPLE = 1 << 14
"""Gaussians, spread over the rows, that are looked at first."""

HASHED = 1 << 12
"""Duplicates are counted among at least so many Gaussians."""

CHUNK = 1 << 14

LEAST_CONTRAST = 1e-6
"""Scenes of one colour count as having this contrast."""


def band_losses(scene: GaussianScene, *, enough: float) -> tuple[float, ...]:
    """Return the most that leaving out a band of the spherical harmonics can change a colour.

    A pixel mixes colours with weights that add up to 1 at most, so no pixel changes by more. By
    the addition theorem (Unsöld 1927), a band of degree l with coefficients c changes a channel
    by at most ``sqrt((2 l + 1) / (4 pi) sum c^2)``; the sum is over all channels here. That is
    divided by the standard deviation of the constant colours, weighted by opacity, if it is below
    1.

    Args:
        scene: The Gaussians, with valid rows.
        enough: The search ends as soon as the highest band has this, since it and all below it
            are needed then; the figures are those of the Gaussians that were looked at so far.

    Returns:
        One number for each degree above 0.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 100, sh_degree=1, seed=0)
        >>> dull = scene.with_tensors({"shN": torch.zeros_like(scene.shN)}, {})
        >>> band_losses(scene, enough=1e-4)[0] > 1e-4, band_losses(dull, enough=1e-4)
        (True, (0.0,))
    """
    if scene.sh_degree == 0:
        return ()
    step = len(scene) // SAMPLE
    spread = [scene.shN[::step]] if step > 1 else []
    unit = min(1.0, max(_contrast(scene), LEAST_CONTRAST))
    losses = [0.0] * scene.sh_degree
    for part in (*spread, *scene.shN.split(CHUNK)):
        found = (_largest_change(part, degree) / unit for degree in range(1, len(losses) + 1))
        losses = [max(pair) for pair in zip(losses, found, strict=True)]
        if losses[-1] >= enough:
            break
    return tuple(losses)


def far_share(means: Float[Tensor, "n 3"], masses: Float[Tensor, "n"], frame: RobustFrame) -> float:
    """Return the share of mass that lies far away.

    Args:
        means: Positions, scene units.
        masses: Masses.
        frame: Centre and radius of the scene.

    Returns:
        A number in [0, 1].

    Example:
        >>> frame = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=1.0)
        >>> far_share(torch.tensor([[0.0, 0, 0], [9, 0, 0]]), torch.tensor([1.0, 3.0]), frame)
        0.75
    """
    far = frame.distances(means) > UNBOUNDED_DISTANCE
    return float(parameters.divide((masses * far).sum(), masses.sum()))


def faint_share(
    opacities: Float[Tensor, "n"], masses: Float[Tensor, "n"], *, below: float
) -> float:
    """Return the share of mass that faint Gaussians hold."""
    masses = masses.double()
    return float(parameters.divide((masses * (opacities < below)).sum(), masses.sum()))


def duplicate_share(means: Float[Tensor, "n 3"], sh0: Float[Tensor, "n 1 3"]) -> float:
    """Return the share of Gaussians that lie exactly where another of the same colour does.

    Large scenes are estimated from a sample by a hash of the position, which duplicates share.

    Args:
        means: Positions.
        sh0: Constant colours.

    Returns:
        A number in [0, 1).

    Example:
        >>> duplicate_share(torch.zeros(4, 3), torch.zeros(4, 1, 3))
        0.75
    """
    bits = max(0, math.floor(math.log2(max(1, len(means)) / HASHED)))
    rows, hashes = [], []
    for start in range(0, len(means), CHUNK << 2):
        keys = _hash(means[start : start + (CHUNK << 2)])
        chosen = (keys & ((1 << bits) - 1) == 0).nonzero()[:, 0]
        rows.append(chosen + start)
        hashes.append(keys[chosen])
    sample = torch.cat(rows)
    sample = sample[torch.sort(torch.cat(hashes), stable=True).indices]
    if len(sample) == 0:
        return 0.0
    place, color = means[sample], sh0[sample, 0]
    same = (place[1:] == place[:-1]).all(dim=1) & (color[1:] == color[:-1]).all(dim=1)
    return float(same.sum()) / len(sample)


def _largest_change(rest: Float[Tensor, "n k 3"], degree: int) -> float:
    """Bound what a band changes a channel by; sums over whole rows are fast."""
    band = rest[:, REST_COUNTS[degree - 1] : REST_COUNTS[degree]]
    if band.numel() == 0:
        return 0.0
    squares = float(band.square().sum(dim=(1, 2)).amax())
    return math.sqrt((2 * degree + 1) / (4 * math.pi) * squares)


def _contrast(scene: GaussianScene) -> float:
    """Return the standard deviation of the constant colours of some Gaussians."""
    rows = slice(None, None, max(1, len(scene) // SAMPLE))
    colors = SH_C0 * scene.sh0[rows, 0].double()
    shares = parameters.opacity_from_logit(scene.logit_opacities[rows]).double()
    shares = (shares / shares.sum())[:, None]
    mean = (shares * colors).sum(dim=0)
    return float((shares * (colors - mean).square()).sum(dim=0).mean().sqrt())


def _hash(means: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """Mix the bits of positions; equal ones give equal numbers, which may be negative."""
    whole = torch.int32 if means.dtype == torch.float32 else torch.int64
    x, y, z = means.contiguous().view(whole).unbind(1)
    mixed = x * 73856093 + y * 19349663 + z * 83492791  # wraps round
    return mixed ^ (mixed >> 13)
