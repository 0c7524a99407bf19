"""Highlights: colour that depends on the direction from which it is seen, as SH coefficients."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

_BANDS = (1.0, 0.9, 0.72, 0.5)
"""How much of each band a highlight keeps: falling, so that it does not ring."""


def highlights(
    directions: Float[Tensor, "n 3"], peaks: Float[Tensor, "n 3"], rest_count: int
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n k 3"]]:
    """Project round highlights on spherical harmonics.

    A lobe around direction ``d`` has coefficients ``w_l Y_lm(d)`` (Funk-Hecke theorem); the
    weights ``w_l`` are scaled so that the highlight has the wanted colour at its peak.

    Args:
        directions: Unit vectors from the camera to the Gaussian where the highlight peaks.
        peaks: Colours that are added there.
        rest_count: Coefficients per channel above the constant one: 0, 3, 8 or 15.

    Returns:
        What is added to the colour on average, and the view-dependent coefficients.
    """
    degree = math.isqrt(rest_count + 1) - 1
    weights = [_BANDS[band] for band in range(degree + 1) for _ in range(2 * band + 1)]
    peak = sum(weights) / (4 * math.pi)
    basis = _basis(directions)[:, : rest_count + 1] * (torch.tensor(weights) / peak)
    if degree == 0:
        return 0.15 * peaks, torch.zeros(len(directions), 0, 3)
    return peaks / (4 * math.pi * peak), basis[:, 1:, None] * peaks[:, None, :]


def mirrored(
    toward_light: Float[Tensor, "3"], normals: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Give the viewing directions that see a light mirrored in a surface.

    Args:
        toward_light: Unit vector.
        normals: Unit normals.

    Returns:
        Unit vectors from the camera to the surface.
    """
    return toward_light - 2 * (normals @ toward_light)[:, None] * normals


def _basis(directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 16"]:
    """Evaluate the real spherical harmonics of degree 0 to 3 with the signs of 3DGS files."""
    x, y, z = directions.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    values = [
        torch.full_like(x, 0.28209479177387814),
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy), -0.5900435899266435 * x * (xx - 3 * yy),
    ]  # fmt: skip
    return torch.stack(values, dim=1)
