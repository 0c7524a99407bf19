"""Real spherical harmonics in the order, scale and signs that 3DGS files use."""

import math
from functools import cache
from itertools import pairwise, product

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.devices import move_together, row_chunks
from cvtgs.errors import InvalidArgumentError

SH_C0 = 0.5 / math.sqrt(math.pi)
"""The constant band: the colour of degree 0 is ``0.5 + SH_C0 * sh0``."""

LARGEST_COLOR = 1.5
"""Limit of a colour, and of the norm of coefficients, where distances between colours decide."""

SH_C1 = math.sqrt(3 / (4 * math.pi))  # the factor of the three linear functions
SH_C2 = (math.sqrt(15 / (4 * math.pi)), math.sqrt(5 / (16 * math.pi)))
"""The factors of the quadratic functions: of ``xy``, ``yz``, ``xz`` (half of it of
``xx - yy``), and of ``2zz - xx - yy``."""

SH_C3 = (
    math.sqrt(35 / (32 * math.pi)),
    math.sqrt(105 / (4 * math.pi)),
    math.sqrt(21 / (32 * math.pi)),
    math.sqrt(7 / (16 * math.pi)),
)
"""The factors of the cubic functions, by rising rotational symmetry: of ``y (3xx - yy)``, ``xyz``
(half of it of ``z (xx - yy)``), ``y (4zz - xx - yy)`` and ``z (2zz - 3xx - 3yy)``."""

CHUNK = 1 << 13  # colours at a time, whose values in all directions fit into a cache
REST_COUNTS = (0, 3, 8, 15)  # coefficients per colour channel above the constant band, by degree
_ROUNDING = 1e-12  # entries of a rotation of SH bands below this are set to zero


def degree_of(rest_count: int) -> int:
    """Return the SH degree of 0, 3, 8 or 15 view-dependent coefficients per channel.

    Example:
        >>> degree_of(15)
        3
    """
    if rest_count not in REST_COUNTS:
        raise InvalidArgumentError(
            f"a scene has 0, 3, 8 or 15 view-dependent SH coefficients per channel "
            f"(degree 0 to 3), found {rest_count}."
        )
    return REST_COUNTS.index(rest_count)


def rest_basis(directions: Float[Tensor, "n 3"], degree: int) -> Float[Tensor, "n k"]:
    """Evaluate the basis functions above the constant one in unit vectors from the camera.

    They are the real spherical harmonics with the Condon-Shortley phase, sorted within a degree, 0
    to 3, by order ``m`` from ``-l`` to ``l``, as in 3DGS (Kerbl et al. 2023) and PlenOctrees (Yu et
    al. 2021).

    Example:
        >>> rest_basis(torch.tensor([[0.0, 0.0, 1.0]]), 1)
        tensor([[-0.0000, 0.4886, -0.0000]])
    """
    if degree not in range(len(REST_COUNTS)):
        raise InvalidArgumentError(f"the SH degree must be from 0 to 3, found {degree!r}.")
    x, y, z = directions.unbind(1)
    columns: list[Tensor] = []
    if degree > 0:
        columns += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree > 1:
        wide, round_ = SH_C2
        columns += [
            wide * x * y,
            -wide * y * z,
            round_ * (2 * z * z - x * x - y * y),
            -wide * x * z,
            0.5 * wide * (x * x - y * y),
        ]
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        three, two, one, zero = SH_C3
        columns += [
            -three * y * (3 * xx - yy),
            two * x * y * z,
            -one * y * (4 * zz - xx - yy),
            zero * z * (2 * zz - 3 * xx - 3 * yy),
            -one * x * (4 * zz - xx - yy),
            0.5 * two * z * (xx - yy),
            -three * x * (xx - 3 * yy),
        ]
    return torch.stack(columns, dim=1) if columns else directions[:, :0]


def evaluate(
    sh0: Float[Tensor, "n 1 3"],
    shN: Float[Tensor, "n k 3"],  # noqa: N803 (the name that gsplat gives it)
    directions: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 3"]:
    """Evaluate colours: ``0.5`` plus the spherical harmonics in the directions, at least 0.

    Directions are unit vectors from the camera; without view-dependent bands, they are ignored.

    Example:
        >>> evaluate(torch.zeros(1, 1, 3), torch.zeros(1, 0, 3), torch.zeros(1, 3)).tolist()
        [[0.5, 0.5, 0.5]]
    """
    colors = 0.5 + SH_C0 * sh0[:, 0]
    degree = degree_of(shN.shape[1])
    if degree > 0:
        colors = colors + (rest_basis(directions, degree)[:, :, None] * shN).sum(dim=1)
    return colors.clamp_min(0)


def clamped_parts(
    sh0: Float[Tensor, "n 1 3"],
    shN: Float[Tensor, "n k 3"],  # noqa: N803 (the name that gsplat gives it)
) -> Float[Tensor, "n k_plus_1 3"]:
    """Return coefficients of the parts of colours below zero, which images show as zero.

    They are float64, the constant band first: the best fit, by least squares, in 26 directions, a
    cubature that is exact for the products of the basis functions (Lebedev 1976), and that no turn
    between axes changes.

    Example:
        >>> dark = torch.full((1, 1, 3), -0.75 / SH_C0)
        >>> round(SH_C0 * clamped_parts(dark, torch.zeros(1, 0, 3)).mean().item(), 6)
        0.25
    """
    basis, fit = _fit(degree_of(shN.shape[1]), sh0.device)
    offset, parts = basis.new_full((), -0.5), [basis.new_zeros(len(fit), 0, 3)]
    for rows in row_chunks(len(sh0), CHUNK, sh0.device):
        columns = torch.cat([sh0[rows], shN[rows]], dim=1).double().permute(1, 0, 2).flatten(1)
        below = torch.addmm(offset, -basis, columns).clamp_min_(0)
        parts.append((fit @ below).view(len(fit), -1, 3))
    return torch.cat(parts, dim=1).transpose(0, 1)


@cache
@torch.inference_mode(mode=False)
def _fit(
    degree: int, device: torch.device
) -> tuple[Float[Tensor, "d k_plus_1"], Float[Tensor, "k_plus_1 d"]]:
    """Return the basis functions in directions to the neighbours in a lattice, and the fit."""
    places = [place for place in product((0, 1, -1), repeat=3) if any(place)]
    shares = [(1 / 21, 4 / 105, 9 / 280)[sum(map(abs, place)) - 1] for place in places]
    if degree == 0:
        places, shares = places[:1], [1.0]
    points = torch.tensor(places, dtype=torch.float64, device="cpu")
    rest = rest_basis(points / torch.linalg.vector_norm(points, dim=1, keepdim=True), degree)
    basis = torch.nn.functional.pad(rest, (1, 0), value=SH_C0)
    fit = 4 * math.pi * points.new_tensor(shares) * basis.T
    basis, fit = move_together([basis, fit.contiguous()], device)
    return basis, fit


def rotated_rest(
    shN: Float[Tensor, "n k 3"],  # noqa: N803 (the name that gsplat gives it)
    rotation: Float[Tensor, "3 3"],
) -> Float[Tensor, "n k 3"]:
    """Return the view-dependent bands of Gaussians after a rotation.

    The new colour along ``R d`` equals the old one along ``d``. Every band is closed under
    rotation, so its matrix follows from the basis in a few directions, in float64.

    Example:
        >>> half = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
        >>> rotated_rest(torch.ones(1, 3, 1).expand(1, 3, 3), half)[0, :, 0].tolist()
        [-1.0, -1.0, 1.0]
    """
    degree = degree_of(shN.shape[1])
    if degree == 0:
        return shN
    matrix = _rest_rotation(rotation.detach().cpu().double(), degree).to(shN)
    turned = torch.empty_like(shN)
    for low, high in pairwise(REST_COUNTS[: degree + 1]):
        band = shN[:, low:high]
        turned[:, low:high] = torch.einsum("jk,nkc->njc", matrix[low:high, low:high], band)
    return turned


def _rest_rotation(rotation: Float[Tensor, "3 3"], degree: int) -> Float[Tensor, "k k"]:
    """Return the rotation matrix of the bands, with rounding errors set to zero."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(64, 3, generator=generator, dtype=torch.float64, device="cpu")
    directions /= directions.norm(dim=1, keepdim=True)
    new, old = rest_basis(directions, degree), rest_basis(directions @ rotation, degree)
    matrix: Tensor = torch.linalg.lstsq(new, old).solution
    return torch.where(matrix.abs() < _ROUNDING, 0.0, matrix)
