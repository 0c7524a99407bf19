"""Between stored and readable parameters; every logit, log and guarded division lives here."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

OPACITY_MARGIN = 1e-6
"""Opacities stay this far from 0 and from 1."""

LOGIT_LIMIT = math.log((1.0 - OPACITY_MARGIN) / OPACITY_MARGIN)
"""The logit of the largest opacity, about 13.8."""


def opacity_from_logit(logits: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Activate opacity logits.

    Args:
        logits: Stored opacities, any shape, any real number or infinity.

    Returns:
        Opacities in [1e-6, 1 - 1e-6].

    Example:
        >>> opacity_from_logit(torch.zeros(2)).tolist()
        [0.5, 0.5]
    """
    return torch.sigmoid(clamp_logits(logits))


def logit_from_opacity(opacities: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Turn opacities into the logits that files store.

    Args:
        opacities: Opacities, clamped to [1e-6, 1 - 1e-6] first.

    Returns:
        Finite logits.

    Example:
        >>> logit_from_opacity(torch.tensor([0.5])).tolist()
        [0.0]
    """
    return torch.logit(opacities, eps=OPACITY_MARGIN)


def clamp_logits(logits: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Limit logits to those of opacities 1e-6 and 1 - 1e-6.

    Args:
        logits: Stored opacities; infinities are valid.

    Returns:
        Logits in [-13.8, 13.8]; NaN stays NaN.

    Example:
        >>> clamp_logits(torch.tensor([float("-inf"), 1.0])).tolist()
        [-13.815509796142578, 1.0]
    """
    return torch.clamp(logits, -LOGIT_LIMIT, LOGIT_LIMIT)


def optical_depth_from_logit(logits: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the optical depth ``-log(1 - a)`` of Gaussians with opacity ``a = sigmoid(logit)``.

    ``-log(1 - sigmoid(x))`` is ``softplus(x)``, which loses no digits at either end.

    Args:
        logits: Stored opacities.

    Returns:
        Optical depths, from 1e-6 to 13.8.

    Example:
        >>> round(optical_depth_from_logit(torch.zeros(1)).item(), 4)
        0.6931
    """
    return torch.nn.functional.softplus(clamp_logits(logits))


def opacity_from_optical_depth(depths: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the opacity ``1 - exp(-tau)``, the inverse of :func:`optical_depth_from_logit`.

    Args:
        depths: Optical depths, at least 0.

    Returns:
        Opacities in [0, 1).

    Example:
        >>> round(opacity_from_optical_depth(torch.tensor([0.6931472])).item(), 4)
        0.5
    """
    return -torch.expm1(-depths)


def positive_log(values: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Take logarithms of values that should be positive but may have underflowed.

    Args:
        values: Numbers, at least 0.

    Returns:
        Logarithms; those of 0 are the logarithm of the smallest normal number of the dtype.

    Example:
        >>> positive_log(torch.tensor([1.0])).item()
        0.0
    """
    return torch.log(values.clamp_min(torch.finfo(values.dtype).tiny))


def divide(numerator: Float[Tensor, "*n"], denominator: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Divide, taking 0 / 0 as 0.

    Args:
        numerator: Any numbers.
        denominator: Numbers, at least 0.

    Returns:
        The quotients; denominators below the smallest normal number count as that number.

    Example:
        >>> divide(torch.tensor([0.0, 1.0]), torch.tensor([0.0, 2.0])).tolist()
        [0.0, 0.5]
    """
    return numerator / denominator.clamp_min(torch.finfo(denominator.dtype).tiny)


def logit_from_optical_depth(depths: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the opacity logit of an optical depth (inverse of :func:`optical_depth_from_logit`).

    ``logit(1 - exp(-tau))`` is ``tau + log(1 - exp(-tau))``, which loses no digits at either end.

    Args:
        depths: Optical depths, at least 0.

    Returns:
        Logits in [-13.8, 13.8].

    Example:
        >>> round(logit_from_optical_depth(torch.tensor([0.6931472])).item(), 4)
        0.0
    """
    return clamp_logits(depths + positive_log(opacity_from_optical_depth(depths)))
