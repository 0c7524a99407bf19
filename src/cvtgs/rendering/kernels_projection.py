"""Compiled loops that project Gaussians, forward and backward: ``projection.py`` in float64."""

import math

import numpy as np
from numpy.typing import NDArray

from cvtgs.math.parameters import LOGIT_LIMIT, MIN_ALPHA, NEAR_PLANE
from cvtgs.math.spherical_harmonics import SH_C0, SH_C1, SH_C2, SH_C3
from cvtgs.rendering.compiled import (
    Array,
    GaussianArrays,
    RasterSettings,
    SplatArrays,
    parallel,
    prange,
    serial,
)

CHUNK = 256  # Gaussians per step of a parallel loop, which share their scratch arrays
LEAST = 1e-37  # smallest inverse of a variance, which float32 holds; that of huge Gaussians

C2A, C2B = SH_C2
C3A, C3B, C3C, C3D = SH_C3


@serial
def rotation_of(quat: Array, out: Array) -> float:
    """Write the rotation matrix of a quaternion of any length; return its length."""
    largest = max(abs(quat[0]), abs(quat[1]), abs(quat[2]), abs(quat[3]))
    w, x, y, z = quat[0] / largest, quat[1] / largest, quat[2] / largest, quat[3] / largest
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    out[0, 0] = 1 - 2 * (y * y + z * z)
    out[0, 1] = 2 * (x * y - w * z)
    out[0, 2] = 2 * (x * z + w * y)
    out[1, 0] = 2 * (x * y + w * z)
    out[1, 1] = 1 - 2 * (x * x + z * z)
    out[1, 2] = 2 * (y * z - w * x)
    out[2, 0] = 2 * (x * z - w * y)
    out[2, 1] = 2 * (y * z + w * x)
    out[2, 2] = 1 - 2 * (x * x + y * y)
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
    """Write a Gaussian's unit axes in camera space (rows 0 to 2) and its image axes (3, 4)."""
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
def covariance_of(axes: Array, dilation: float) -> tuple[float, float, float, float, float]:
    """Return a, b, d of the dilated covariance ``(a b; b d)``, and both determinants over d.

    The first is that of the dilated covariance, the second that of the undilated one.
    """
    a, b, d = dilation, 0.0, dilation
    for k in range(3):
        a += axes[3, k] * axes[3, k]
        b += axes[3, k] * axes[4, k]
        d += axes[4, k] * axes[4, k]
    bare = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        minor = axes[3, i] * axes[4, j] - axes[3, j] * axes[4, i]
        bare += minor * minor / d
    return a, b, d, bare + dilation * (a + d - dilation) / d, bare


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
    """Write the offset of a point from the camera, in world axes and in camera axes."""
    for k in range(3):
        offset[k] = mean[k] - camera[3, k]
    for j in range(3):
        local[j] = camera[j, 0] * offset[0] + camera[j, 1] * offset[1] + camera[j, 2] * offset[2]


@serial
def normalize_in_place(vector: Array) -> float:
    """Scale a vector to unit length in place; return its original length."""
    norm = math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    for k in range(3):
        vector[k] /= norm
    return norm


@serial
def sigmoid(logit: float) -> float:
    """Return the opacity of a logit, clamped to the limits of ``math.parameters``."""
    return 1 / (1 + math.exp(-min(max(logit, -LOGIT_LIMIT), LOGIT_LIMIT)))


@serial
def splat_of(axes: Array, local: Array, camera: Array, opacity: float, out: Array) -> bool:
    """Write a packed splat except its colour; return whether it touches the image."""
    a, b, d, schur, _ = covariance_of(axes, camera[8, 2])
    x = camera[4, 0] * local[0] / local[2] + camera[5, 0]
    y = camera[4, 1] * local[1] / local[2] + camera[5, 1]
    reach = 2 * math.log(opacity / MIN_ALPHA)
    wide, high = math.sqrt(reach * a), math.sqrt(reach * d)
    is_beside = x + wide >= 0 and x - wide <= camera[8, 0] and schur < math.inf
    if not (is_beside and y + high >= 0 and y - high <= camera[8, 1]):
        return False
    out[0], out[1], out[9] = x, y, local[2]
    out[2], out[3], out[4] = -max(0.5 / schur, LEAST), -b / d, -max(0.5 / d, LEAST)
    out[5] = math.log(opacity)
    return True


@parallel
def project_all(
    gaussians: GaussianArrays,
    settings: RasterSettings,
    packed: Array,
    depths: NDArray[np.float64],
    visible: NDArray[np.bool_],
) -> None:
    """Write the packed splat of every Gaussian, its depth, and whether it is in view."""
    means, quats, log_scales, logits, sh0, rest = gaussians
    camera, _, degree, antialiased = settings
    for chunk in prange((len(means) + CHUNK - 1) // CHUNK):
        scratch, basis = np.empty((11, 3)), np.empty(15)
        offset, local, color = scratch[0], scratch[1], scratch[2]
        rotation, axes = scratch[3:6], scratch[6:11]
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(means))):
            visible[i] = False
            local_of(means[i], camera, offset, local)
            opacity = sigmoid(logits[i])
            if not (local[2] >= NEAR_PLANE and local[2] < math.inf and opacity >= MIN_ALPHA):
                continue
            length = rotation_of(quats[i], rotation)
            if not (length > 0 and length < math.inf):
                continue
            axes_of(rotation, log_scales[i], camera, local, axes)
            if antialiased:
                _, _, _, schur, bare = covariance_of(axes, camera[8, 2])
                opacity *= math.sqrt(bare / schur)
            if not (opacity >= MIN_ALPHA and splat_of(axes, local, camera, opacity, packed[i])):
                continue
            normalize_in_place(offset)
            color_of((sh0[i], rest[i]), offset, degree, basis, color)
            for channel in range(3):
                packed[i, 6 + channel] = max(0.0, color[channel])
            depths[i] = local[2]
            visible[i] = math.isfinite(color[0] + color[1] + color[2])


@serial
def rest_slopes_at(x: float, y: float, z: float, degree: int, out: Array) -> None:
    """Write the derivatives of the view-dependent SH functions by x, y and z."""
    out[:] = 0
    out[0, 1], out[1, 2], out[2, 0] = -SH_C1, SH_C1, -SH_C1
    if degree > 1:
        out[3, 0], out[3, 1] = C2A * y, C2A * x
        out[4, 1], out[4, 2] = -C2A * z, -C2A * y
        out[5, 0], out[5, 1], out[5, 2] = -2 * C2B * x, -2 * C2B * y, 4 * C2B * z
        out[6, 0], out[6, 2] = -C2A * z, -C2A * x
        out[7, 0], out[7, 1] = C2A * x, -C2A * y
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        out[8, 0], out[8, 1] = -6 * C3A * x * y, -3 * C3A * (xx - yy)
        out[9, 0], out[9, 1], out[9, 2] = C3B * y * z, C3B * x * z, C3B * x * y
        out[10, 0], out[10, 2] = 2 * C3C * x * y, -8 * C3C * y * z
        out[10, 1] = -C3C * (4 * zz - xx - 3 * yy)
        out[11, 0], out[11, 1] = -6 * C3D * x * z, -6 * C3D * y * z
        out[11, 2] = C3D * (6 * zz - 3 * xx - 3 * yy)
        out[12, 0], out[12, 1] = -C3C * (4 * zz - 3 * xx - yy), 2 * C3C * x * y
        out[12, 2] = -8 * C3C * x * z
        out[13, 0], out[13, 1], out[13, 2] = C3B * x * z, -C3B * y * z, 0.5 * C3B * (xx - yy)
        out[14, 0], out[14, 1] = -3 * C3A * (xx - yy), 6 * C3A * x * y


@serial
def color_gradient(
    grad: Array,
    offset: Array,
    degree: int,
    sh: tuple[Array, Array],
    out: tuple[Array, Array, Array],
    scratch: tuple[Array, Array],
) -> None:
    """Write the gradients by the SH coefficients; add that by the offset from the camera."""
    toward, (rows, basis) = out[2], scratch
    direction, color, kept, turn, slopes = rows[0], rows[1], rows[2], rows[3], rows[4:19]
    for k in range(3):
        direction[k], turn[k] = offset[k], 0
    norm = normalize_in_place(direction)
    color_of(sh, direction, degree, basis, color)
    for channel in range(3):
        kept[channel] = grad[channel] if color[channel] >= 0 else 0.0
        out[0][0, channel] = SH_C0 * kept[channel]
    if degree == 0:
        return
    rest_slopes_at(direction[0], direction[1], direction[2], degree, slopes)
    for j in range((degree + 1) * (degree + 1) - 1):
        worth = 0.0
        for channel in range(3):
            out[1][j, channel] = basis[j] * kept[channel]
            worth += kept[channel] * sh[1][j, channel]
        for k in range(3):
            turn[k] += worth * slopes[j, k]
    radial = turn[0] * direction[0] + turn[1] * direction[1] + turn[2] * direction[2]
    for k in range(3):
        toward[k] += (turn[k] - radial * direction[k]) / norm


@serial
def covariance_gradient(
    grad: Array, axes: Array, dilation: float, antialiased: bool
) -> tuple[float, float, float]:
    """Return the gradient by a, b, d of the covariance."""
    a, b, d, schur, bare = covariance_of(axes, dilation)
    shear, flat = -b / d, 1 / d
    of_schur = 0.5 * grad[2] / (schur * schur)
    of_a = of_schur
    of_b = 2 * shear * of_schur - flat * grad[3]
    of_d = of_schur * shear * shear - flat * shear * grad[3] + 0.5 * grad[4] * flat * flat
    if antialiased:
        # log survival = (log bare_det - log det) / 2; the packed splat holds log opacity.
        bare_det, det = bare * d, schur * d
        of_a += 0.5 * grad[5] * ((d - dilation) / bare_det - d / det)
        of_d += 0.5 * grad[5] * ((a - dilation) / bare_det - a / det)
        of_b += grad[5] * (b / det - b / bare_det)
    return of_a, of_b, of_d


@serial
def quaternion_gradient(quat: Array, length: float, of_rotation: Array, out: Array) -> None:
    """Convert the gradient by a rotation matrix to that by its quaternion of any length."""
    w, x, y, z = quat[0] / length, quat[1] / length, quat[2] / length, quat[3] / length
    g = of_rotation
    of_w = 2 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    of_x = 2 * (
        w * (g[2, 1] - g[1, 2]) + y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0])
        - 2 * x * (g[1, 1] + g[2, 2])
    )  # fmt: skip
    of_y = 2 * (
        w * (g[0, 2] - g[2, 0]) + x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1])
        - 2 * y * (g[0, 0] + g[2, 2])
    )  # fmt: skip
    of_z = 2 * (
        w * (g[1, 0] - g[0, 1]) + x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1])
        - 2 * z * (g[0, 0] + g[1, 1])
    )  # fmt: skip
    radial = of_w * w + of_x * x + of_y * y + of_z * z
    out[0], out[1] = (of_w - radial * w) / length, (of_x - radial * x) / length
    out[2], out[3] = (of_y - radial * y) / length, (of_z - radial * z) / length


@serial
def axes_gradient(
    covariance: tuple[float, float, float],
    axes: Array,
    log_scales: Array,
    place: tuple[Array, Array],
    out: tuple[Array, Array, Array],
) -> None:
    """Write the gradients by camera-space axes and log scales; add that by the local position."""
    of_a, of_b, of_d = covariance
    camera, local = place
    of_axes, of_log_scales, of_local = out
    x, y = local[0] / local[2], local[1] / local[2]
    x_slope = min(max(x, camera[6, 0]), camera[6, 1])
    y_slope = min(max(y, camera[7, 0]), camera[7, 1])
    of_x, of_y, size = 0.0, 0.0, 0.0
    for k in range(3):
        across = 2 * of_a * axes[3, k] + of_b * axes[4, k]
        down = 2 * of_d * axes[4, k] + of_b * axes[3, k]
        share = across * axes[3, k] + down * axes[4, k]
        of_log_scales[k] = share
        size += share
        scale = math.exp(log_scales[k]) / local[2]
        across *= camera[4, 0] * scale
        down *= camera[4, 1] * scale
        of_axes[0, k], of_axes[1, k] = across, down
        of_axes[2, k] = -x_slope * across - y_slope * down
        of_x -= across * axes[2, k]
        of_y -= down * axes[2, k]
    of_local[2] -= size / local[2]
    if camera[6, 0] <= x <= camera[6, 1]:
        of_local[0] += of_x / local[2]
        of_local[2] -= of_x * x / local[2]
    if camera[7, 0] <= y <= camera[7, 1]:
        of_local[1] += of_y / local[2]
        of_local[2] -= of_y * y / local[2]


@serial
def rotate_back(
    camera: Array, of_axes: Array, of_local: Array, of_rotation: Array, of_offset: Array
) -> None:
    """Convert gradients by rotation and position from camera to world axes."""
    for j in range(3):
        of_offset[j] = 0
        for k in range(3):
            of_offset[j] += camera[k, j] * of_local[k]
            of_rotation[j, k] = (
                camera[0, j] * of_axes[0, k]
                + camera[1, j] * of_axes[1, k]
                + camera[2, j] * of_axes[2, k]
            )


@parallel
def project_all_gradient(
    gaussians: GaussianArrays,
    settings: RasterSettings,
    splats: SplatArrays,
    per_intersection: Array,
    gradients: GaussianArrays,
) -> None:
    """Sum the gradients of each splat's intersections; write those by the scene's tensors."""
    means, quats, log_scales, logits, sh0, rest = gaussians
    of_means, of_quats, of_log_scales, of_logits, of_sh0, of_rest = gradients
    camera, _, degree, antialiased = settings
    rows, starts = splats.rows, splats.starts
    for chunk in prange((len(rows) + CHUNK - 1) // CHUNK):
        grad, scratch = np.empty(10), np.empty((18, 3))
        offset, local, of_local, of_offset = scratch[0], scratch[1], scratch[2], scratch[3]
        rotation, axes = scratch[4:7], scratch[7:12]
        of_axes, of_rotation = scratch[12:15], scratch[15:18]
        color_scratch = (np.empty((19, 3)), np.empty(15))
        for splat in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(rows))):
            i = rows[splat]
            grad[:] = 0
            for place in range(starts[splat], starts[splat + 1]):
                for column in range(10):
                    grad[column] += per_intersection[place, column]
            local_of(means[i], camera, offset, local)
            length = rotation_of(quats[i], rotation)
            axes_of(rotation, log_scales[i], camera, local, axes)
            opacity = sigmoid(logits[i])
            of_a, of_b, of_d = covariance_gradient(grad, axes, camera[8, 2], antialiased)
            if abs(logits[i]) < LOGIT_LIMIT:
                of_logits[i] = grad[5] * (1 - opacity)
            of_local[0] = grad[0] * camera[4, 0] / local[2]
            of_local[1] = grad[1] * camera[4, 1] / local[2]
            of_local[2] = grad[9] - (of_local[0] * local[0] + of_local[1] * local[1]) / local[2]
            out = (of_axes, of_log_scales[i], of_local)
            axes_gradient((of_a, of_b, of_d), axes, log_scales[i], (camera, local), out)
            rotate_back(camera, of_axes, of_local, of_rotation, of_offset)
            quaternion_gradient(quats[i], length, of_rotation, of_quats[i])
            sh, of_sh = (sh0[i], rest[i]), (of_sh0[i], of_rest[i], of_offset)
            color_gradient(grad[6:9], offset, degree, sh, of_sh, color_scratch)
            for k in range(3):
                of_means[i, k] = of_offset[k]
