"""Eigenvalues and eigenvectors of many small symmetric matrices."""

import torch
from jaxtyping import Float
from torch import Tensor

Pair = tuple[Tensor, Tensor]
Three = tuple[Tensor, Tensor, Tensor]

SWEEPS = 5
"""Rotations of all three planes. In float64, four leave only rounding errors; one is spare."""


def symmetric_eigen(
    matrices: Float[Tensor, "n 3 3"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return eigenvalues and eigenvectors of symmetric matrices, as ``torch.linalg.eigh`` does.

    That function fails on CUDA with some ten thousand matrices (torch 2.11 with cuSOLVER 12 asks
    for half a megabyte for each). There, Jacobi rotations (1846) diagonalise all matrices at once.
    """
    if matrices.device.type != "cuda":
        values, axes = torch.linalg.eigh(matrices)
        return values, axes
    return jacobi_eigen(matrices)


def jacobi_eigen(
    matrices: Float[Tensor, "n 3 3"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return what :func:`symmetric_eigen` does, by Jacobi rotations on any device."""
    a, b, c = (matrices[:, k, k] for k in range(3))
    ab, ac, bc = matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1]
    x, y, z = torch.eye(3, dtype=a.dtype, device=a.device).expand(len(a), 3, 3).unbind(2)
    for _ in range(SWEEPS):
        (a, b), (ab, ac, bc), (x, y) = _rotated((a, b), (ab, ac, bc), (x, y))
        (a, c), (ac, ab, bc), (x, z) = _rotated((a, c), (ac, ab, bc), (x, z))
        (b, c), (bc, ab, ac), (y, z) = _rotated((b, c), (bc, ab, ac), (y, z))
    values, order = torch.sort(torch.stack([a, b, c], dim=1), dim=1, stable=True)
    axes = torch.stack([x, y, z], dim=2)
    return values, axes.gather(2, order[:, None].expand(-1, 3, -1))


def _rotated(diagonal: Pair, others: Three, axes: Pair) -> tuple[Pair, Three, Pair]:
    """Rotate two axes so that their common entry becomes 0 (Golub and Van Loan 2013, 8.5.2).

    ``others`` are the common entry and those that the axes have in common with the third one.
    """
    (p, q), (pq, pr, qr), (x, y) = diagonal, others, axes
    ratio = (q - p) / (2 * pq)
    tangent = torch.copysign(1 / (ratio.abs() + torch.sqrt(ratio.square() + 1)), ratio)
    tangent = torch.where(pq == 0, 0.0, tangent)
    cosine = torch.rsqrt(tangent.square() + 1)
    sine = tangent * cosine
    shift = tangent * pq
    pr, qr = cosine * pr - sine * qr, sine * pr + cosine * qr
    cosine, sine = cosine[:, None], sine[:, None]
    x, y = cosine * x - sine * y, sine * x + cosine * y
    return (p - shift, q + shift), (torch.zeros_like(pq), pr, qr), (x, y)
