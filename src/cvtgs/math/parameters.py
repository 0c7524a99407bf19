"""Parameters of Gaussians: stored and activated values, rotations, covariances and areas.

Values that may be 0 or infinite pass through the guarded logarithms, logits and divisions here.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.math.eigen import symmetric_eigen

OPACITY_MARGIN = 1e-6  # opacities stay this far from 0 and from 1

LOGIT_LIMIT = math.log((1.0 - OPACITY_MARGIN) / OPACITY_MARGIN)
"""The logit of the largest opacity, about 13.8."""

MIN_ALPHA = 1 / 255  # Gaussians of lower alpha in a pixel are not drawn there
NEAR_PLANE = 0.01  # Gaussians whose centre is at a smaller depth are not rendered; scene units
EIGENVALUE_FLOOR = 1e-12  # floor of eigenvalues as a share of the largest one (for scales: 1e-6)

AREA_EXPONENT = 1.6075
"""Thomsen's exponent, with which the ellipsoid surface formula is within 1.1 % for all shapes."""


def opacity_from_logit(logits: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Activate opacity logits, any numbers or infinity, to opacities in [1e-6, 1 - 1e-6].

    Example:
        >>> opacity_from_logit(torch.zeros(2)).tolist()
        [0.5, 0.5]
    """
    return torch.sigmoid(clamp_logits(logits))


def logit_from_opacity(opacities: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Convert opacities, clamped to [1e-6, 1 - 1e-6], to the finite logits that files store.

    Example:
        >>> logit_from_opacity(torch.tensor([0.5])).tolist()
        [0.0]
    """
    return torch.logit(opacities, eps=OPACITY_MARGIN)


def clamp_logits(logits: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Clamp logits, also infinite ones, to those of 1e-6 and 1 - 1e-6, +-13.8; NaN stays NaN.

    Example:
        >>> clamp_logits(torch.tensor([float("-inf"), 1.0])).tolist()
        [-13.815509796142578, 1.0]
    """
    return torch.clamp(logits, -LOGIT_LIMIT, LOGIT_LIMIT)


def optical_depth_from_logit(logits: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the optical depth ``-log(1 - a)``, from 1e-6 to 13.8, of ``a = sigmoid(logit)``.

    ``-log(1 - sigmoid(x))`` is ``softplus(x)``, which loses no digits at either end.

    Example:
        >>> round(optical_depth_from_logit(torch.zeros(1)).item(), 4)
        0.6931
    """
    return torch.nn.functional.softplus(clamp_logits(logits))


def opacity_from_optical_depth(depths: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the opacity ``1 - exp(-tau)``, the inverse of :func:`optical_depth_from_logit`.

    Opacities of depths of at least 0 are in [0, 1]; 1 only by rounding, from 17 on (float64: 37).

    Example:
        >>> round(opacity_from_optical_depth(torch.tensor([0.6931472])).item(), 4)
        0.5
    """
    return -torch.expm1(-depths)


def positive_log(values: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Take logarithms of numbers of at least 0, where 0 counts as the smallest normal number.

    Example:
        >>> positive_log(torch.tensor([1.0])).item()
        0.0
    """
    return torch.log(values.clamp_min(torch.finfo(values.dtype).tiny))


def divide(numerator: Float[Tensor, "*n"], denominator: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Divide by numbers of at least 0, where 0 counts as the smallest normal number: 0 / 0 is 0.

    Example:
        >>> divide(torch.tensor([0.0, 1.0]), torch.tensor([0.0, 2.0])).tolist()
        [0.0, 0.5]
    """
    return numerator / denominator.clamp_min(torch.finfo(denominator.dtype).tiny)


def logit_from_optical_depth(depths: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the opacity logit, in [-13.8, 13.8], of an optical depth of at least 0.

    ``logit(1 - exp(-tau))`` is ``tau + log(1 - exp(-tau))``, which loses no digits at either end.

    Example:
        >>> round(logit_from_optical_depth(torch.tensor([0.6931472])).item(), 4)
        0.0
    """
    return clamp_logits(depths + positive_log(opacity_from_optical_depth(depths)))


def normalize_quats(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Scale non-zero, finite quaternions to unit length, with the same sign.

    The largest component is divided out first, so that tiny and huge quaternions survive.

    Example:
        >>> normalize_quats(torch.tensor([[2.0, 0.0, 0.0, 0.0]])).tolist()
        [[1.0, 0.0, 0.0, 0.0]]
    """
    largest = quats.detach().abs().amax(dim=-1, keepdim=True)  # has no effect on the result
    scaled = quats / largest
    return scaled / scaled.square().sum(dim=-1, keepdim=True).sqrt()


def multiply_quats(a: Float[Tensor, "n 4"], b: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Return Hamilton products of quaternions, w first: the rotation ``b`` and then ``a``.

    Example:
        >>> i, j = torch.tensor([[0.0, 1, 0, 0]]), torch.tensor([[0.0, 0, 1, 0]])
        >>> multiply_quats(i, j).tolist()
        [[0.0, 0.0, 0.0, 1.0]]
    """
    w, v, other_w, other_v = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    real = w * other_w - (v * other_v).sum(dim=1, keepdim=True)
    return torch.cat([real, w * other_v + other_w * v + torch.linalg.cross(v, other_v)], dim=1)


def quats_to_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Return the rotation matrices of unit quaternions, w first; column ``k`` is axis ``k``.

    In memory, each entry is contiguous over all matrices, so that sums of products are fast.

    Example:
        >>> quats_to_matrices(torch.tensor([[1.0, 0.0, 0.0, 0.0]]))[0].diagonal().tolist()
        [1.0, 1.0, 1.0]
    """
    w, x, y, z = quats.T.contiguous().unbind()
    doubled_x, doubled_y, doubled_z = 2 * x, 2 * y, 2 * z
    xx, yy, zz = doubled_x * x, doubled_y * y, doubled_z * z
    xy, xz, yz = doubled_x * y, doubled_x * z, doubled_y * z
    wx, wy, wz = doubled_x * w, doubled_y * w, doubled_z * w
    entries = [
        1 - (yy + zz), xy - wz, xz + wy,
        xy + wz, 1 - (xx + zz), yz - wx,
        xz - wy, yz + wx, 1 - (xx + yy),
    ]  # fmt: skip
    return torch.stack(entries).reshape(3, 3, -1).permute(2, 0, 1)


def rotation_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Return the rotation matrices of quaternions of any length but 0, w first.

    Example:
        >>> rotation_matrices(torch.tensor([[2.0, 0.0, 0.0, 0.0]]))[0].diagonal().tolist()
        [1.0, 1.0, 1.0]
    """
    return quats_to_matrices(normalize_quats(quats))


def matrices_to_quats(rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """Return unit quaternions, w first and at least 0, of rotation matrices of determinant +1.

    A matrix gives the quaternion in four ways, each by way of one component; the largest component
    is chosen (Shepperd 1978), so no digits are lost near half turns.

    Example:
        >>> matrices_to_quats(torch.eye(3)[None]).tolist()
        [[1.0, 0.0, 0.0, 0.0]]
    """
    m00, m11, m22 = rotations.diagonal(dim1=-2, dim2=-1).unbind(-1)
    wx = rotations[:, 2, 1] - rotations[:, 1, 2]
    wy = rotations[:, 0, 2] - rotations[:, 2, 0]
    wz = rotations[:, 1, 0] - rotations[:, 0, 1]
    xy = rotations[:, 0, 1] + rotations[:, 1, 0]
    xz = rotations[:, 0, 2] + rotations[:, 2, 0]
    yz = rotations[:, 1, 2] + rotations[:, 2, 1]
    rows = (
        [1 + m00 + m11 + m22, wx, wy, wz],
        [wx, 1 + m00 - m11 - m22, xy, xz],
        [wy, xy, 1 - m00 + m11 - m22, yz],
        [wz, xz, yz, 1 - m00 - m11 + m22],
    )
    candidates = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=1)
    best = candidates.diagonal(dim1=1, dim2=2).argmax(dim=-1)
    quats = normalize_quats(candidates[torch.arange(len(best), device=best.device), best])
    # Adding 0 turns -0.0 into 0.0, so that equal frames have equal bits.
    return torch.where(quats[:, :1] < 0, -quats, quats) + 0.0


def build_covariances(
    scales: Float[Tensor, "n 3"], quats: Float[Tensor, "n 4"]
) -> Float[Tensor, "n 3 3"]:
    """Build ``R diag(s)^2 R^T`` of standard deviations and unit quaternions, w first.

    Example:
        >>> cov = build_covariances(torch.ones(1, 3), torch.tensor([[1.0, 0, 0, 0]]))
        >>> bool((cov[0] == torch.eye(3)).all())
        True
    """
    half = quats_to_matrices(quats) * scales[:, None, :]
    return half @ half.transpose(1, 2)


def decompose_covariances(
    covariances: Float[Tensor, "n 3 3"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
    """Split positive semi-definite covariances into scales and unit quaternions.

    The axes are canonical: scales descend, the largest component of each of the first two axes is
    positive, the third makes the frame right-handed, and w >= 0. Scales are at least 1e-6 times
    the largest one; a zero matrix gives tiny positive scales.

    Example:
        >>> scales, quats = decompose_covariances(torch.diag(torch.tensor([1.0, 9.0, 4.0]))[None])
        >>> scales.tolist()
        [[3.0, 2.0, 1.0]]
    """
    tiny = torch.finfo(covariances.dtype).tiny
    size = covariances.diagonal(dim1=1, dim2=2).amax(dim=1).clamp_min(tiny)
    values, axes = symmetric_eigen(covariances / size[:, None, None])
    values, axes = values.flip(-1), axes.flip(-1)
    values = torch.maximum(values, EIGENVALUE_FLOOR * values[:, :1].clamp_min(EIGENVALUE_FLOOR))
    scales = values.sqrt() * size.sqrt()[:, None]
    return scales, matrices_to_quats(canonical_axes(axes))


def mean_projected_area(scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the projected area of an ellipsoid of semi-axes, averaged over all directions.

    By Cauchy's theorem it is a quarter of the surface, which Thomsen's formula (2004)
    approximates: ``pi * (((s1 s2)^p + (s1 s3)^p + (s2 s3)^p) / 3)^(1/p)``, p = 1.6075.

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
    """Return the logarithm of :func:`mean_projected_area` of logarithms of semi-axes.

    Only of needles is the ratio limited: the product of the largest two scales counts as at least
    3e-24 of the square of the largest one, or 4e-192 in float64.

    Example:
        >>> round(log_mean_projected_area(torch.zeros(1, 3)).item(), 4)
        1.1447
    """
    largest = log_scales.amax(dim=1)
    a, b, c = (AREA_EXPONENT * (log_scales - largest[:, None])).unbind(-1)
    mean = (torch.exp(a + b) + torch.exp(a + c) + torch.exp(b + c)) / 3
    return 2 * largest + positive_log(mean) / AREA_EXPONENT + math.log(math.pi)


def canonical_axes(axes: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """Make frames of orthonormal columns right-handed, and fix their signs.

    The largest component of each of the first two axes is positive.

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
