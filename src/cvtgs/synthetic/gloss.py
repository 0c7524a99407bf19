"""Highlights: colour that depends on the direction from which it is seen, as SH coefficients."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.math.spherical_harmonics import degree_of, rest_basis

_BANDS = (1.0, 0.9, 0.72, 0.5)
"""How much of each band a highlight keeps: falling, so that it does not ring."""


def highlights(
    directions: Float[Tensor, "n 3"], peaks: Float[Tensor, "n 3"], rest_count: int
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n k 3"]]:
    """Project round highlights on spherical harmonics.

    A lobe around direction ``d`` has coefficients ``w_l Y_lm(d)`` (Funk-Hecke theorem); the
    weights ``w_l`` are scaled so that the highlight has the wanted colour at its peak.
    """
    degree = degree_of(rest_count)
    if degree == 0:
        return 0.15 * peaks, torch.zeros(len(directions), 0, 3)
    weights = [_BANDS[band] for band in range(degree + 1) for _ in range(2 * band + 1)]
    peak = sum(weights) / (4 * math.pi)
    rest = rest_basis(directions, degree) * (torch.tensor(weights[1:]) / peak)
    return peaks / (4 * math.pi * peak), rest[:, :, None] * peaks[:, None, :]


def mirrored(
    toward_light: Float[Tensor, "3"], normals: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Return the viewing directions that see a light mirrored in a surface."""
    return toward_light - 2 * (normals @ toward_light)[:, None] * normals
