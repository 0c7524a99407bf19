"""Frames: neighbours decide about axes that the moments of a cell leave open."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.partition import Partition
from cvtgs.math import parameters
from cvtgs.scene import GaussianScene

OPEN = 1e-2
"""Two eigenvalues that differ by less than this share leave their axes open."""

PULL = 1e-4
"""Neighbours pull at open axes as if eigenvalues differed by this share."""


def align_axes(
    merged: GaussianScene, partition: Partition, neighbors: Int[Tensor, "m k"]
) -> GaussianScene:
    """Turn axes of equal length to where the neighbours are.

    Where two eigenvalues are equal, any axes in their plane are right, and rounding decides.
    Inflation and the network grow Gaussians axis by axis, so what they add would depend on how the
    scene lies. Axes of about equal length turn to the directions in which the neighbours lie most
    and least; they keep their length to 1e-4, and all others their bits. Cells that neighbours
    surround with the symmetry of a cube stay open. This is our own rule, not part of CVT-GS.

    Args:
        merged: One Gaussian per cell, as its moments give it: scales descend; those of the
            partition first, others that follow are there as neighbours.
        partition: Members of the cells; cells of one member keep their axes.
        neighbors: The nearest other cells of every cell of the partition.

    Returns:
        The scene; itself if there is nothing to turn.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 2, sh_degree=0, seed=0)
        >>> cells = Partition.from_labels(torch.tensor([0, 1]), 2)
        >>> align_axes(scene, cells, torch.tensor([[1], [0]])) is scene
        True
    """
    differences = merged.log_scales[: len(partition)].diff(dim=1).abs()
    is_open = (2 * differences < OPEN).any(dim=1) & (partition.counts > 1)
    rows = is_open.nonzero()[:, 0]
    if len(rows) == 0 or neighbors.shape[1] == 0:
        return merged
    logs = merged.log_scales[rows].double()
    axes = parameters.quats_to_matrices(parameters.normalize_quats(merged.quats[rows].double()))
    pulls = axes.mT @ _pulls(merged.means, rows, neighbors[rows]) @ axes
    # Logarithms, since axes of a needle are lost beside its length.
    pulled = torch.diag_embed(2 * (logs - logs[:, :1])) + PULL * pulls * _open_pairs(logs)
    turns = torch.linalg.eigh(pulled).eigenvectors.flip(-1)
    tensors = merged.tensors()
    tensors["log_scales"] = tensors["log_scales"].clone()
    tensors["quats"] = tensors["quats"].clone()
    turned = (turns.square() * logs[:, :, None]).sum(dim=1)
    tensors["log_scales"][rows] = turned.to(merged.dtype)
    quats = parameters.matrices_to_quats(parameters.canonical_axes(axes @ turns))
    tensors["quats"][rows] = quats.to(merged.dtype)
    return merged.with_tensors(tensors, merged.extras)


def _pulls(
    means: Float[Tensor, "m 3"], rows: Int[Tensor, "r"], neighbors: Int[Tensor, "r k"]
) -> Float[Tensor, "r 3 3"]:
    """Return in which directions neighbours lie, near ones above all, in numbers up to 1."""
    shifts = means[neighbors].double() - means[rows, None].double()
    lengths = torch.linalg.vector_norm(shifts, dim=2, keepdim=True)
    apart = lengths > 0
    nearest = torch.where(apart, lengths, torch.inf).amin(dim=1, keepdim=True)
    ways = torch.where(apart, shifts * (nearest / lengths) / lengths, 0.0)
    sums: Tensor = ways.mT @ ways
    traces = sums.diagonal(dim1=1, dim2=2).sum(dim=1)
    return parameters.divide(sums, traces[:, None, None])


def _open_pairs(logs: Float[Tensor, "r 3"]) -> Float[Tensor, "r 3 3"]:
    """Give 1 where two axes are of about equal length, directly or by way of the third, else 0."""
    near = 2 * logs.diff(dim=1).abs() < OPEN
    first, second = near.double().unbind(1)
    one = torch.ones_like(first)
    rows = [one, first, first * second, first, one, second, first * second, second, one]
    return torch.stack(rows, dim=1).reshape(-1, 3, 3)
