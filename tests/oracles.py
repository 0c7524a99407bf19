"""Slow, scalar, float64 answers to compare with; nothing here imports cvtgs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import spence

Array = NDArray[np.float64]

OPACITY_MARGIN = 1e-6
AREA_EXPONENT = 1.6075


@dataclass(frozen=True, slots=True, kw_only=True)
class Gaussian:
    """One activated Gaussian, with its optical depth ``-log(1 - a)`` instead of its opacity."""

    mean: Array
    covariance: Array
    depth: float
    sh: Array

    @property
    def opacity(self) -> float:
        return -math.expm1(-self.depth)

    @property
    def scales(self) -> Array:
        """Standard deviations along the principal axes, largest first."""
        values = np.linalg.eigvalsh(self.covariance)[::-1]
        return np.sqrt(np.maximum(values, 0.0))

    @property
    def area(self) -> float:
        return thomsen_area(self.scales)

    @property
    def mass(self) -> float:
        return self.opacity * self.area


def clamped_opacity(logit: float) -> float:
    """``sigmoid(logit)`` between 1e-6 and 1 - 1e-6, without overflow."""
    if logit >= 0:
        value = 1.0 / (1.0 + math.exp(-min(logit, 700.0)))
    else:
        value = math.exp(max(logit, -700.0)) / (1.0 + math.exp(max(logit, -700.0)))
    return min(max(value, OPACITY_MARGIN), 1.0 - OPACITY_MARGIN)


def rotation(quat: Sequence[float]) -> Array:
    """Rotation matrix of a quaternion w, x, y, z of any length, by rotating the axes."""
    w, x, y, z = (float(v) / math.hypot(*map(float, quat)) for v in quat)
    columns = []
    for axis in np.eye(3):
        # q v q* = v + 2 w (u x v) + 2 u x (u x v), with u the vector part (Rodrigues).
        u = np.array([x, y, z])
        cross = np.cross(u, axis)
        columns.append(axis + 2.0 * w * cross + 2.0 * np.cross(u, cross))
    return np.stack(columns, axis=1)


def quaternion_product(a: Sequence[float], b: Sequence[float]) -> list[float]:
    """Hamilton product: the rotation ``b``, then the rotation ``a``."""
    aw, ax, ay, az = map(float, a)
    bw, bx, by, bz = map(float, b)
    return [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]


def covariance(log_scales: Sequence[float], quat: Sequence[float]) -> Array:
    """``sum over axes of s^2 r r^T``."""
    matrix = np.zeros((3, 3))
    for log_scale, axis in zip(log_scales, rotation(quat).T, strict=True):
        matrix += math.exp(2.0 * float(log_scale)) * np.outer(axis, axis)
    return matrix


def thomsen_area(scales: Sequence[float]) -> float:
    """A quarter of the surface of an ellipsoid by Thomsen's formula."""
    a, b, c = (float(s) for s in scales)
    p = AREA_EXPONENT
    return math.pi * (((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3.0) ** (1.0 / p)


def mean_shadow(scales: Sequence[float], steps: int = 400) -> float:
    """Area of an ellipsoid's shadow, averaged over directions by integration on a grid.

    The shadow along the unit direction d has area ``pi |(bc dx, ac dy, ab dz)|``.
    """
    a, b, c = (float(s) for s in scales)
    height = (np.arange(steps) + 0.5) / steps  # equal steps in z are equal steps in area
    angle = (np.arange(steps) + 0.5) / steps * (math.pi / 2.0)  # one octant stands for all
    z, phi = np.meshgrid(height, angle, indexing="ij")
    ring = np.sqrt(1.0 - z * z)
    shadow = np.sqrt(
        (b * c * ring * np.cos(phi)) ** 2 + (a * c * ring * np.sin(phi)) ** 2 + (a * b * z) ** 2
    )
    return math.pi * float(shadow.mean())


def gaussian(
    mean: Sequence[float],
    quat: Sequence[float],
    log_scales: Sequence[float],
    logit: float,
    sh: Array,
) -> Gaussian:
    """Activate one stored row."""
    return Gaussian(
        mean=np.array(mean, dtype=np.float64),
        covariance=covariance(log_scales, quat),
        depth=-math.log1p(-clamped_opacity(float(logit))),
        sh=np.array(sh, dtype=np.float64),
    )


def member_weights(cell: Sequence[Gaussian], *, area_power: float) -> list[float]:
    """Weights that sum to 1: opacity times area to a power."""
    raw = [g.opacity * g.area**area_power for g in cell]
    total = math.fsum(raw)
    return [value / total for value in raw]


def merge(
    cell: Sequence[Gaussian], *, area_power: float, opacity: str, antialiased: bool = False
) -> Gaussian:
    """Return one Gaussian with the moments of the mixture in a cell, without inflation."""
    shares = member_weights(cell, area_power=area_power)
    mean = sum(w * g.mean for w, g in zip(shares, cell, strict=True))
    matrix = np.zeros((3, 3))
    sh = np.zeros_like(cell[0].sh)
    for share, g in zip(shares, cell, strict=True):
        offset = g.mean - mean
        matrix += share * (g.covariance + np.outer(offset, offset))
        sh += share * g.sh
    limit = -math.log(OPACITY_MARGIN)
    if opacity == "union":
        through = math.prod(1.0 - g.opacity for g in cell)
        depth = -math.log(max(through, 1e-300))
    else:
        merged_area = thomsen_area(np.sqrt(np.maximum(np.linalg.eigvalsh(matrix), 0.0)))
        total = math.fsum(spence(math.exp(-g.depth)) * g.area for g in cell) / merged_area
        limit = -math.log(0.01)
        is_opaque = total >= spence(math.exp(-limit))
        depth = limit if is_opaque else brentq(lambda x: spence(math.exp(-x)) - total, 0, limit)
        if antialiased:
            center = math.fsum(min(g.depth, limit) * g.area for g in cell) / merged_area
            depth = math.sqrt(depth * min(center, limit))
    return Gaussian(mean=np.asarray(mean), covariance=matrix, depth=min(depth, limit), sh=sh)


def side_cover(
    means: Array, quats: Array, scales: Array, opacities: Array, row: int, others: Sequence[int]
) -> list[list[float]]:
    """Opacity of the others at both ends of each axis of a Gaussian, three sigmas out."""
    axes = rotation(quats[row])
    cover = []
    for axis in range(3):
        sides = []
        for sign in (1.0, -1.0):
            end = means[row] + sign * 3.0 * scales[row][axis] * axes[:, axis]
            through = 1.0
            for other in others:
                local = rotation(quats[other]).T @ (end - means[other]) / scales[other]
                through *= 1.0 - opacities[other] * math.exp(-0.5 * float(local @ local))
            sides.append(1.0 - through)
        cover.append(sides)
    return cover


def inflation(
    opacity: float, members: int, cover: float, *, everywhere: float, covered: float
) -> float:
    """Factor on one scale of a merged Gaussian; ``cover`` is that of its less covered side."""
    crowding = min(math.log10(members) / 2.0, 1.0)
    return 1.0 + opacity**2 * crowding * (everywhere + covered * min(cover / 0.1, 1.0))


def nearest(points: Array, sites: Array) -> tuple[list[int], list[float]]:
    """First nearest site of every point and its squared distance, found one by one."""
    labels, squared = [], []
    for point in points.tolist():
        best, name = math.inf, -1
        for number, site in enumerate(sites.tolist()):
            distance = sum((p - s) ** 2 for p, s in zip(point, site, strict=True))
            if distance < best:
                best, name = distance, number
        labels.append(name)
        squared.append(best)
    return labels, squared


def morton_code(steps: Sequence[int], bits: int) -> int:
    """Interleave the bits of x, y, z; bit 0 of x is the lowest bit."""
    code = 0
    for bit in range(bits):
        for axis, value in enumerate(steps):
            code |= ((int(value) >> bit) & 1) << (3 * bit + axis)
    return code


def sh_basis(directions: Array, degree: int) -> Array:
    """Basis of 3DGS files at unit directions: ``(n, (degree + 1)^2)``, with INRIA's signs."""
    columns = []
    for x, y, z in directions:
        row = [0.28209479177387814]
        if degree > 0:
            c1 = 0.4886025119029199
            row += [-c1 * y, c1 * z, -c1 * x]
        if degree > 1:
            row += [
                1.0925484305920792 * x * y,
                -1.0925484305920792 * y * z,
                0.31539156525252005 * (2 * z * z - x * x - y * y),
                -1.0925484305920792 * x * z,
                0.5462742152960396 * (x * x - y * y),
            ]
        if degree > 2:
            row += [
                -0.5900435899266435 * y * (3 * x * x - y * y),
                2.890611442640554 * x * y * z,
                -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
                0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
                -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
                1.445305721320277 * z * (x * x - y * y),
                -0.5900435899266435 * x * (x * x - 3 * y * y),
            ]
        columns.append(row)
    return np.array(columns)


def rotated_sh(coefficients: Array, matrix: Array) -> Array:
    """Coefficients ``(n, (degree + 1)^2, 3)`` of colours that turned with the scene.

    The turned colour seen along d is the old colour along ``R^T d``; it is sampled in many
    directions and fitted with the same basis, which is exact because every band is closed
    under rotation.
    """
    degree = math.isqrt(coefficients.shape[1]) - 1
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    new, old = sh_basis(directions, degree), sh_basis(directions @ matrix, degree)
    turn, *_ = np.linalg.lstsq(new, old, rcond=None)
    return np.einsum("ij,njc->nic", turn, coefficients)
