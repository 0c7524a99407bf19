"""Conversion between the optical depth of a Gaussian at its centre and summed over its image."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.math import parameters

FULL_DEPTH = math.pi**2 / 6
"""The optical depth of an opaque Gaussian summed over an image, as a multiple of its area."""


def integrated_depth(depths: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the optical depth of Gaussians summed over an image, as a multiple of their area.

    A Gaussian transmits ``1 - a g(x)`` of the light, with g = 1 at its centre. The integral of
    ``-log(1 - a g(x))``, divided by its projected area ``2 pi sigma_1 sigma_2``, is the dilogarithm
    ``Li2(a)``: it grows like a, and ends at ``pi^2 / 6``, however large the depth at the centre.
    """
    others = -parameters.positive_log(parameters.opacity_from_optical_depth(depths))  # -log(a)
    small = torch.minimum(depths, others)
    square = small.square()
    series = 1 / 3600 - square * (1 / 211680 - square / 10886400)
    values = small - square / 4 + small * square * (1 / 36 - square * series)
    return torch.where(depths <= others, values, FULL_DEPTH - depths * others - values)


def depth_from_integrated(values: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the optical depth at the centre, the inverse of :func:`integrated_depth`."""
    tiny = torch.finfo(values.dtype).tiny
    values = values.clamp_max(FULL_DEPTH)
    depths = torch.maximum(values, -parameters.positive_log(1 - values / FULL_DEPTH)).clamp(
        tiny, parameters.LOGIT_LIMIT
    )
    for _ in range(6):  # Newton, from below
        slopes = depths / torch.expm1(depths)
        depths = depths + (values - integrated_depth(depths)) / slopes
        depths = depths.clamp(tiny, parameters.LOGIT_LIMIT)
    return depths
