"""A slow rasterizer in plain float64 arithmetic, pixel by pixel; imports nothing of the library."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

try:
    from scipy.special import sph_harm_y
except ImportError:  # before scipy 1.15
    from scipy.special import sph_harm

    def sph_harm_y(n, m, theta, phi):
        return sph_harm(m, n, phi, theta)


@dataclass(frozen=True, slots=True, kw_only=True)
class Gaussian:
    mean: Sequence[float]
    quat: Sequence[float]
    log_scales: Sequence[float]
    logit: float
    sh: np.ndarray  # (k, 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Splat:
    center: tuple[float, float]
    conic: np.ndarray
    opacity: float
    color: np.ndarray
    depth: float


def sh_basis(direction: Sequence[float], degree: int) -> list[float]:
    """Real harmonics made of scipy's complex ones, which carry the Condon-Shortley phase."""
    x, y, z = direction
    theta, phi = math.acos(max(-1.0, min(1.0, z))), math.atan2(y, x)
    values = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            value = complex(sph_harm_y(n, abs(m), theta, phi))
            if m < 0:
                values.append(math.sqrt(2) * value.imag)
            elif m > 0:
                values.append(math.sqrt(2) * value.real)
            else:
                values.append(value.real)
    return values


def rotation(quat: Sequence[float]) -> np.ndarray:
    w, x, y, z = np.asarray(quat, dtype=float) / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def project(g: Gaussian, camera: Camera, *, antialiased: bool) -> Splat | None:
    w, p = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    x, y, z = w @ np.asarray(g.mean, dtype=float) + p
    if z < 0.01:
        return None
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    u = min(max(x / z, -cx / fx - 0.15 * camera.width / fx), (1.15 * camera.width - cx) / fx)
    v = min(max(y / z, -cy / fy - 0.15 * camera.height / fy), (1.15 * camera.height - cy) / fy)
    jacobian = np.array([[fx / z, 0, -fx * u / z], [0, fy / z, -fy * v / z]])
    spread = jacobian @ w @ rotation(g.quat) @ np.diag(np.exp(g.log_scales))
    bare = spread @ spread.T
    dilated = bare + 0.3 * np.eye(2)
    opacity = 0.0 if g.logit == -math.inf else 1 / (1 + math.exp(-g.logit))
    if antialiased:
        opacity *= math.sqrt(max(0.0, np.linalg.det(bare) / np.linalg.det(dilated)))
    away = np.asarray(g.mean, dtype=float) + np.linalg.inv(w) @ p
    degree = math.isqrt(len(g.sh)) - 1
    basis = sh_basis(away / np.linalg.norm(away), degree)
    return Splat(
        center=(fx * x / z + cx, fy * y / z + cy),
        conic=np.linalg.inv(dilated),
        opacity=opacity,
        color=np.maximum(0.0, 0.5 + np.asarray(basis) @ g.sh),
        depth=float(z),
    )


def render(
    gaussians: Sequence[Gaussian],
    camera: Camera,
    *,
    antialiased: bool = False,
    max_alpha: float = 0.99,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colours on black, alpha, and mean depth (0 where nothing is)."""
    splats = [project(g, camera, antialiased=antialiased) for g in gaussians]
    seen = sorted((s for s in splats if s is not None), key=lambda s: s.depth)
    rgb = np.zeros((camera.height, camera.width, 3))
    alpha, depth = np.zeros(rgb.shape[:2]), np.zeros(rgb.shape[:2])
    for row in range(camera.height):
        for column in range(camera.width):
            light = 1.0
            for s in seen:
                way = np.array([column + 0.5 - s.center[0], row + 0.5 - s.center[1]])
                hidden = min(max_alpha, s.opacity * math.exp(-0.5 * way @ s.conic @ way))
                if hidden < 1 / 255:
                    continue
                if light * (1 - hidden) < 1e-4:
                    break
                rgb[row, column] += light * hidden * s.color
                depth[row, column] += light * hidden * s.depth
                light *= 1 - hidden
            alpha[row, column] = 1 - light
            if light < 1:
                depth[row, column] /= 1 - light
    return rgb, alpha, depth
