"""Eigenvalues and eigenvectors of many small symmetric matrices."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.errors import InvalidArgumentError

SWEEPS = 5  # rotations of all three planes; in float64, four leave only rounding errors


def symmetric_eigen(
    matrices: Float[Tensor, "n 3 3"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return eigenvalues and eigenvectors of symmetric matrices, as ``torch.linalg.eigh`` does."""
    # On CUDA, that fails with some ten thousand matrices: cuSOLVER 12 asks for half a MB for each.
    if matrices.device.type == "cuda":
        return jacobi_eigen(matrices)
    try:
        values, axes = torch.linalg.eigh(matrices)
    except torch.linalg.LinAlgError:  # type: ignore[attr-defined]  # for NaN
        raise InvalidArgumentError(
            "covariances must be finite, found NaN or infinity; cvtgs.validity.check_rows "
            "removes Gaussians with such values."
        ) from None
    return values, axes


def jacobi_eigen(
    matrices: Float[Tensor, "n 3 3"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return what :func:`symmetric_eigen` does, by rotations (Jacobi 1846) of all matrices."""
    diagonal = matrices.diagonal(dim1=1, dim2=2).T.clone(memory_format=torch.contiguous_format)
    # Of each axis, twice the entry that the other two have in common, and its components.
    others = torch.stack([matrices[:, 2, 1], matrices[:, 2, 0], matrices[:, 1, 0]])
    unit = torch.eye(3, dtype=others.dtype, device=others.device)[:, :, None]
    axes = torch.cat([2 * others[:, None], unit.expand(3, 3, len(matrices))], dim=1)
    one, signs = others.new_ones(()), others.new_ones(2, 4, 1)
    signs[0, 1:], signs[1, 0] = -1.0, -1.0
    for _ in range(SWEEPS):
        for planes, third in ((slice(0, 2), 2), (slice(0, 3, 2), 1), (slice(1, 3), 0)):
            _rotate(diagonal[planes], axes[planes], axes[third, 0], one, signs)
    values, order = torch.sort(diagonal.T, dim=1, stable=True)
    return values, axes[:, 1:].permute(2, 1, 0).gather(2, order[:, None].expand(-1, 3, -1))


def _rotate(diagonal: Tensor, axes: Tensor, twice: Tensor, one: Tensor, signs: Tensor) -> None:
    """Rotate two axes, in place, so that ``twice`` their common entry is 0 (Golub 2013, 8.5.2).

    Before each axis stands twice the entry of the other and the third, which turns by ``signs``.
    """
    step = diagonal[1] - diagonal[0]
    length = torch.hypot(step, twice).clamp_min_(torch.finfo(step.dtype).tiny)
    tangent = twice / length.copysign_(step).add_(step)
    cosine = torch.addcmul(one, tangent, tangent).rsqrt_()
    tangents = signs * tangent
    diagonal.addcmul_(tangents[:, 1], twice, value=0.5)
    twice.zero_()
    axes.addcmul_(tangents, axes.flip(0)).mul_(cosine)
