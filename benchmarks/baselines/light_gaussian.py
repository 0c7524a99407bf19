"""LightGaussian's pruning (Fan, Wang, Wen, Zhu, Xu, Wang: arXiv 2311.17245, NeurIPS 2024).

The global significance of a Gaussian (the paper's equation of GS_j, number not known to us) is

    GS_j = sum over the pixels of all views that it hits of  opacity_j * T * gamma(V_j)

with T the transmittance in front of it, V_j its volume, and ``gamma(V) = V_norm ^ beta``, where
``V_norm = min(max(V / V_max90, 0), 1)`` and beta = 0.1. The M most significant ones are kept.

Differences from the paper:

- A hit is weighted by the blended alpha, ``opacity * G(pixel)``, instead of the opacity. The sum is
  then the contribution to the image, and no threshold is needed to define a hit.
- V_max90, "the 90 % largest of all sorted Gaussians", is read as the 90 % quantile: only the
  largest tenth is clipped, in line with the purpose of the clipping (excessive floaters).
- This protocol has no training views. Automatic views replace them, which differ from those used
  for scoring.
- The recovery training, distillation and quantisation that follow in the paper are left out.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.baselines.gaussians import keep_largest, usable
from cvtgs.rendering import contributions
from cvtgs.scene import GaussianScene
from cvtgs.views import automatic_views

VIEWS = 24
SIZE = 256
BETA = 0.1
QUANTILE = 0.9


def simplify(scene: GaussianScene, count: int, *, seed: int = 0) -> GaussianScene:
    """Keep the ``count`` Gaussians of largest global significance; the seed rotates the views."""
    valid = usable(scene, count)
    cameras = automatic_views(valid, VIEWS, width=SIZE, height=SIZE, seed=seed + 1)
    significance = contributions(valid, cameras) * volume_factor(valid.log_scales)
    return keep_largest(valid, significance, count=count)


def volume_factor(log_scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return ``gamma``: volume over the 90 % quantile of all, at most 1, to the power 0.1.

    Computed in logarithms, so that no volume under- or overflows. ``4 pi / 3`` cancels.
    """
    log_volumes = log_scales.double().sum(dim=1)
    ranked = log_volumes.sort().values
    largest = ranked[min(int(QUANTILE * len(ranked)), len(ranked) - 1)]
    return torch.exp(BETA * (log_volumes - largest).clamp_max(0.0))
