"""Project Gaussians in one compiled loop; the arithmetic of ``projection.py``, in float64."""

import math

import numpy as np
from numpy.typing import NDArray

from cvtgs.math.activations import LOGIT_LIMIT
from cvtgs.math.spherical_harmonics import SH_C0, SH_C1, SH_C2, SH_C3
from cvtgs.rendering.arrays import Array, GaussianArrays, Setting
from cvtgs.rendering.compiled import parallel, prange, serial
from cvtgs.rendering.rules import DILATION, MIN_ALPHA, NEAR_PLANE

C2A, C2B = SH_C2
C3A, C3B, C3C, C3D = SH_C3


@serial
def rotation_of(quat: Array, out: Array) -> float:
    """Write the rotation matrix of a quaternion of any length; give its length."""
    largest = max(abs(quat[0]), abs(quat[1]), abs(quat[2]), abs(quat[3]))
    w, x, y, z = quat[0] / largest, quat[1] / largest, quat[2] / largest, quat[3] / largest
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    out[0, 0], out[0, 1], out[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    return float(norm * largest)


@serial
def rest_basis_at(x: float, y: float, z: float, degree: int, out: Array) -> None:
    """Write the view-dependent SH basis functions of a unit vector."""
    out[0], out[1], out[2] = -SH_C1 * y, SH_C1 * z, -SH_C1 * x
    if degree > 1:
        out[3], out[4], out[6] = C2A * x * y, -C2A * y * z, -C2A * x * z
        out[5], out[7] = C2B * (2 * z * z - x * x - y * y), 0.5 * C2A * (x * x - y * y)
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        out[8], out[14] = -C3A * y * (3 * xx - yy), -C3A * x * (xx - 3 * yy)
        out[9], out[13] = C3B * x * y * z, 0.5 * C3B * z * (xx - yy)
        out[10], out[12] = -C3C * y * (4 * zz - xx - yy), -C3C * x * (4 * zz - xx - yy)
        out[11] = C3D * z * (2 * zz - 3 * xx - 3 * yy)


@serial
def axes_of(rotation: Array, log_scales: Array, camera: Array, local: Array, out: Array) -> None:
    """Write the own axes of a Gaussian in the camera (rows 0 to 2) and in the image (3, 4)."""
    x_slope = min(max(local[0] / local[2], camera[6, 0]), camera[6, 1])
    y_slope = min(max(local[1] / local[2], camera[7, 0]), camera[7, 1])
    for k in range(3):
        for j in range(3):
            out[j, k] = (
                camera[j, 0] * rotation[0, k]
                + camera[j, 1] * rotation[1, k]
                + camera[j, 2] * rotation[2, k]
            )
        scale = math.exp(log_scales[k]) / local[2]
        out[3, k] = camera[4, 0] * (out[0, k] - x_slope * out[2, k]) * scale
        out[4, k] = camera[4, 1] * (out[1, k] - y_slope * out[2, k]) * scale


@serial
def covariance_of(axes: Array) -> tuple[float, float, float, float]:
    """Return a, b, d of the dilated covariance ``(a b; b d)``, and the bare determinant over d."""
    a, b, d = DILATION, 0.0, DILATION
    for k in range(3):
        a += axes[3, k] * axes[3, k]
        b += axes[3, k] * axes[4, k]
        d += axes[4, k] * axes[4, k]
    bare = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        minor = axes[3, i] * axes[4, j] - axes[3, j] * axes[4, i]
        bare += minor * minor / d
    return a, b, d, bare


@serial
def survival_of(axes: Array) -> float:
    """Return the share of its opacity that an antialiased Gaussian keeps."""
    a, _, d, bare = covariance_of(axes)
    return math.sqrt(bare / (bare + DILATION * (a + d - DILATION) / d))


@serial
def color_of(
    sh: tuple[Array, Array], direction: Array, degree: int, basis: Array, out: Array
) -> None:
    """Write red, green and blue, which may be below 0."""
    for channel in range(3):
        out[channel] = 0.5 + SH_C0 * sh[0][0, channel]
    if degree > 0:
        rest_basis_at(direction[0], direction[1], direction[2], degree, basis)
        for j in range((degree + 1) * (degree + 1) - 1):
            for channel in range(3):
                out[channel] += basis[j] * sh[1][j, channel]


@serial
def local_of(mean: Array, camera: Array, offset: Array, local: Array) -> None:
    """Write the way from the camera to a point, along the world's and the camera's axes."""
    for k in range(3):
        offset[k] = mean[k] - camera[3, k]
    for j in range(3):
        local[j] = camera[j, 0] * offset[0] + camera[j, 1] * offset[1] + camera[j, 2] * offset[2]


@serial
def normalize_in_place(vector: Array) -> float:
    """Scale a vector to unit length; give its length before."""
    norm = math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    for k in range(3):
        vector[k] /= norm
    return norm


@serial
def sigmoid(logit: float) -> float:
    """Activate a logit within the limits of ``activations``."""
    return 1 / (1 + math.exp(-min(max(logit, -LOGIT_LIMIT), LOGIT_LIMIT)))


@serial
def splat_of(axes: Array, local: Array, camera: Array, opacity: float, out: Array) -> bool:
    """Write all of a packed splat but its colour; tell whether it touches the image."""
    a, b, d, bare = covariance_of(axes)
    schur = bare + DILATION * (a + d - DILATION) / d
    x = camera[4, 0] * local[0] / local[2] + camera[5, 0]
    y = camera[4, 1] * local[1] / local[2] + camera[5, 1]
    reach = 2 * math.log(opacity / MIN_ALPHA)
    wide, high = math.sqrt(reach * a), math.sqrt(reach * d)
    if not (x + wide >= 0 and x - wide <= camera[8, 0] and schur < math.inf):
        return False
    if not (y + high >= 0 and y - high <= camera[8, 1]):
        return False
    out[0], out[1], out[9] = x, y, local[2]
    out[2], out[3], out[4] = -0.5 / schur, -b / d, -0.5 / d
    out[5] = math.log(opacity)
    return True


@parallel
def project_all(
    gaussians: GaussianArrays, setting: Setting, packed: Array, seen: NDArray[np.bool_]
) -> None:
    """Write a packed splat for every Gaussian, and which of them are in view."""
    means, quats, log_scales, logits, sh0, rest = gaussians
    camera, _, degree, antialiased = setting
    for i in prange(len(means)):
        scratch = np.empty((11, 3))
        offset, local, color = scratch[0], scratch[1], scratch[2]
        rotation, axes = scratch[3:6], scratch[6:11]
        seen[i] = False
        local_of(means[i], camera, offset, local)
        opacity = sigmoid(logits[i])
        if not (local[2] >= NEAR_PLANE and local[2] < math.inf and opacity >= MIN_ALPHA):
            continue
        length = rotation_of(quats[i], rotation)
        if not (length > 0 and length < math.inf):
            continue
        axes_of(rotation, log_scales[i], camera, local, axes)
        if antialiased:
            opacity *= survival_of(axes)
        if not (opacity >= MIN_ALPHA and splat_of(axes, local, camera, opacity, packed[i])):
            continue
        normalize_in_place(offset)
        color_of((sh0[i], rest[i]), offset, degree, np.empty(15), color)
        for channel in range(3):
            packed[i, 6 + channel] = max(0.0, color[channel])
        seen[i] = True
