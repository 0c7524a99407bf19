"""Covariances of Gaussians: from scale and rotation, back again, and their mean shadow."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.math import quaternions
from cvtgs.math.activations import positive_log

EIGENVALUE_FLOOR = 1e-12
"""Eigenvalues are kept above this share of the largest one (scales: above 1e-6)."""

AREA_EXPONENT = 1.6075
"""Thomsen's exponent: the ellipsoid surface formula is then within 1.1 % for every shape."""


def from_scales_and_quats(
    scales: Float[Tensor, "n 3"], quats: Float[Tensor, "n 4"]
) -> Float[Tensor, "n 3 3"]:
    """Build ``R diag(s)^2 R^T``.

    Args:
        scales: Standard deviations along the own axes.
        quats: Unit quaternions, w first.

    Returns:
        Symmetric covariance matrices, in squared units of ``scales``.

    Example:
        >>> cov = from_scales_and_quats(torch.ones(1, 3), torch.tensor([[1.0, 0, 0, 0]]))
        >>> bool((cov[0] == torch.eye(3)).all())
        True
    """
    half = quaternions.to_matrices(quats) * scales[:, None, :]
    return half @ half.transpose(1, 2)


def decompose(
    covariances: Float[Tensor, "n 3 3"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
    """Split covariances into scales and unit quaternions.

    The axes are canonical: scales descend, each of the first two axes points along the positive
    side of its largest component, the third makes the frame right-handed, and w >= 0. Scales are
    kept above 1e-6 of the largest one; a zero matrix gives the smallest normal scale.

    Args:
        covariances: Symmetric positive semi-definite matrices.

    Returns:
        Scales, largest first, and unit quaternions.

    Example:
        >>> scales, quats = decompose(torch.diag(torch.tensor([1.0, 9.0, 4.0]))[None])
        >>> scales.tolist()
        [[3.0, 2.0, 1.0]]
    """
    tiny = torch.finfo(covariances.dtype).tiny
    size = covariances.diagonal(dim1=1, dim2=2).amax(dim=1).clamp_min(tiny)
    values, axes = torch.linalg.eigh(covariances / size[:, None, None])
    values, axes = values.flip(-1), axes.flip(-1)
    values = torch.maximum(values, EIGENVALUE_FLOOR * values[:, :1].clamp_min(EIGENVALUE_FLOOR))
    scales = values.sqrt() * size.sqrt()[:, None]
    return scales, quaternions.from_matrices(canonical_axes(axes))


def mean_projected_area(scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the area of an ellipsoid's shadow, averaged over all directions.

    By Cauchy's theorem it is a quarter of the surface, which Thomsen's formula (2004)
    approximates: ``pi * (((s1 s2)^p + (s1 s3)^p + (s2 s3)^p) / 3)^(1/p)``, p = 1.6075.

    Args:
        scales: Semi-axes, for a Gaussian its standard deviations.

    Returns:
        Areas, in squared units of ``scales``.

    Example:
        >>> round(mean_projected_area(torch.ones(1, 3)).item(), 4)
        3.1416
    """
    largest = scales.amax(dim=1).clamp_min(torch.finfo(scales.dtype).tiny)
    a, b, c = (scales / largest[:, None]).unbind(-1)
    p = AREA_EXPONENT
    mean = ((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3
    return math.pi * mean ** (1 / p) * largest * largest


def log_mean_projected_area(log_scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the logarithm of :func:`mean_projected_area`, for scales of any magnitude.

    Args:
        log_scales: Natural logarithms of the semi-axes.

    Returns:
        Natural logarithms of the areas.

    Example:
        >>> round(log_mean_projected_area(torch.zeros(1, 3)).item(), 4)
        1.1447
    """
    largest = log_scales.amax(dim=1)
    a, b, c = (AREA_EXPONENT * (log_scales - largest[:, None])).unbind(-1)
    mean = (torch.exp(a + b) + torch.exp(a + c) + torch.exp(b + c)) / 3
    return 2 * largest + positive_log(mean) / AREA_EXPONENT + math.log(math.pi)


def canonical_axes(axes: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """Fix the signs of eigenvectors and make the frame right-handed.

    Args:
        axes: Axes as columns, at right angles.

    Returns:
        Rotations: each of the first two axes points along the positive side of its largest
        component.

    Example:
        >>> canonical_axes(-torch.eye(3)[None])[0].diagonal().tolist()
        [1.0, 1.0, 1.0]
    """
    first_two = axes[:, :, :2]
    dominant = first_two.abs().argmax(dim=1, keepdim=True)
    negative = torch.gather(first_two, 1, dominant) < 0
    first_two = torch.where(negative, -first_two, first_two)
    third = torch.linalg.cross(first_two[:, :, 0], first_two[:, :, 1])
    return torch.cat([first_two, third[:, :, None]], dim=2)
