"""Axes and inflation of merged Gaussians, which depend on their neighbours."""

from functools import reduce

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.partition import Partition
from cvtgs.checks import checked
from cvtgs.devices import chunk_length, in_threads
from cvtgs.math import parameters
from cvtgs.math.eigen import symmetric_eigen
from cvtgs.math.segments import gather_columns, take_columns
from cvtgs.scene import GaussianScene

EQUAL_SHARE = 1e-2  # axes of two eigenvalues that differ by less than this share are undetermined
NEIGHBOR_PULL = 1e-4  # neighbours pull at these as if eigenvalues differed by this share
PROBE_SIGMAS = 3.0  # both ends of an axis are probed this many standard deviations from the centre
FULL_COVER = 0.1  # least opacity of neighbours that fully cover an end of an axis
CHUNK = 1 << 11  # cells per chunk of probing; each takes about ``1 kB`` per neighbour


@checked
def align_axes(
    merged: GaussianScene, partition: Partition, neighbors: Int[Tensor, "m k"]
) -> GaussianScene:
    """Turn axes of equal length towards the neighbours.

    Where two eigenvalues are equal, any axes in their plane are valid, and rounding picks some.
    Inflation and the network act per axis, so their result would depend on how the scene is
    rotated. Axes of about equal length turn to the directions in which neighbours lie most and
    least; they keep their length to 1e-4. All other axes stay bit for bit. Where neighbours have
    the symmetry of a cube, axes stay undetermined. Our own rule, not part of CVT-GS.

    Args:
        merged: One Gaussian per cell, from its moments, with descending scales: first those of
            the partition, then others that serve only as neighbours.
        partition: Members of the cells; cells of one member keep their axes.
        neighbors: The nearest other cells of every cell of the partition.

    Returns:
        The scene; the same object if there is nothing to turn.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 2, sh_degree=0, seed=0)
        >>> cells = Partition.from_labels(torch.tensor([0, 1]), 2)
        >>> align_axes(scene, cells, torch.tensor([[1], [0]])) is scene
        True
    """
    counts = partition.counts
    log_scales = merged.log_scales[: len(counts)]
    is_open = (2 * log_scales.diff(dim=1).abs() < EQUAL_SHARE).any(dim=1)
    rows = (is_open & (counts > 1)).nonzero()[:, 0]
    if len(rows) == 0 or neighbors.shape[1] == 0:
        return merged
    logs = log_scales[rows].double()
    axes = parameters.rotation_matrices(merged.quats[rows].double())
    pulls = axes.mT @ _pulls(merged.means, rows, neighbors[rows]) @ axes
    # Logarithms, because the thin axes of a needle would vanish next to its length.
    pulled = torch.diag_embed(2 * (logs - logs[:, :1])) + NEIGHBOR_PULL * pulls * _open_pairs(logs)
    rotations = symmetric_eigen(pulled)[1].flip(-1)
    quats = parameters.matrices_to_quats(parameters.canonical_axes(axes @ rotations))
    turned = (rotations.square() * logs[:, :, None]).sum(dim=1)
    return merged.with_tensors(
        log_scales=merged.log_scales.index_copy(0, rows, turned.to(merged.dtype)),
        quats=merged.quats.index_copy(0, rows, quats.to(merged.dtype)),
    )


def _pulls(
    means: Float[Tensor, "m 3"], rows: Int[Tensor, "r"], neighbors: Int[Tensor, "r k"]
) -> Float[Tensor, "r 3 3"]:
    """Return the mean outer product of the directions to neighbours; near ones weigh most."""
    shifts = means[neighbors].double() - means[rows, None].double()
    lengths = torch.linalg.vector_norm(shifts, dim=2, keepdim=True)
    apart = lengths > 0
    nearest = torch.where(apart, lengths, torch.inf).amin(dim=1, keepdim=True)
    directions = torch.where(apart, shifts * (nearest / lengths) / lengths, 0.0)
    sums: Tensor = directions.mT @ directions
    traces = sums.diagonal(dim1=1, dim2=2).sum(dim=1)
    return parameters.divide(sums, traces[:, None, None])


def _open_pairs(logs: Float[Tensor, "r 3"]) -> Float[Tensor, "r 3 3"]:
    """Return 1 where two axes have about equal length, directly or via the third one, else 0."""
    steps = 2 * logs.diff(dim=1).abs() >= EQUAL_SHARE
    groups = torch.nn.functional.pad(steps.cumsum(1), (1, 0))
    return (groups[:, :, None] == groups[:, None]).double()


@checked
def inflate_cells(
    merged: GaussianScene,
    partition: Partition,
    neighbors: Int[Tensor, "m k"],
    *,
    everywhere: float,
    covered: float,
) -> GaussianScene:
    """Widen the Gaussians of opaque cells of many members beyond their moments.

    The mass of an opaque cell saturates: its members hide one another, so a Gaussian with the
    moments of the cell shows less than they do and leaves gaps between cells. The excess mass
    should become area, but not beyond a silhouette. So an axis grows by the factor

    ``1 + a^2 min(log10(n) / 2, 1) (everywhere + covered * min(c / 0.1, 1))``

    with opacity a, n members, and c the smaller of the opacities of the neighbours at three
    standard deviations on either side. This is our own rule, not part of CVT-GS.

    Args:
        merged: One Gaussian per cell: first those of the partition, then others that only cover.
        partition: Members of the cells; cells of one member are not inflated.
        neighbors: The nearest other cells of every cell of the partition.
        everywhere: Growth of an opaque cell of 100 members along every axis.
        covered: Further growth along an axis that is covered at both ends.

    Returns:
        The scene with larger scales.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 2, sh_degree=0, seed=0)
        >>> cells = Partition.from_labels(torch.tensor([0, 1]), 2)
        >>> inflated = inflate_cells(
        ...     scene, cells, torch.tensor([[1], [0]]), everywhere=0.1, covered=0.4
        ... )
        >>> bool((inflated.log_scales == scene.log_scales).all())
        True
    """
    counts = partition.counts
    log_scales = merged.log_scales.clone()
    crowding = (counts.double().log10() / 2).clamp_max(1.0)
    opacities = parameters.opacity_from_logit(merged.logit_opacities)[: len(counts)]
    strength = opacities.double().square() * crowding
    chunk = chunk_length(CHUNK, counts.device)

    def inflate(part: Tensor) -> None:
        cover = side_cover(merged, part, neighbors[part]).amin(dim=2)
        growth = everywhere + covered * (cover / FULL_COVER).clamp_max(1.0)
        factors = 1 + strength[part, None] * growth
        log_scales[part] += parameters.positive_log(factors).to(log_scales.dtype)

    for _ in in_threads(inflate, partition.several().split(chunk), counts.device):
        pass
    return merged.with_tensors(log_scales=log_scales)


def side_cover(
    scene: GaussianScene, rows: Int[Tensor, "r"], neighbors: Int[Tensor, "r k"]
) -> Float[Tensor, "r 3 2"]:
    """Return the opacity of neighbours three standard deviations along each axis, either way."""
    others = neighbors.flatten()
    ids = torch.arange(len(rows), device=rows.device).repeat_interleave(neighbors.shape[1])
    means, rotations, scales = _frames(scene, rows)
    other_means, other_rotations, other_scales = _frames(scene, others)
    arms = (rotations * (PROBE_SIGMAS * scales)[:, None, :]).permute(1, 2, 0).flatten(0, 1)
    table = take_columns(ids, torch.cat([means.T, arms]))
    shifts = project_on_axes(other_rotations, (table[:3].T - other_means)[:, :, None])
    arms = project_on_axes(other_rotations, table[3:].unflatten(0, (3, 3)).permute(2, 0, 1))
    logits = scene.logit_opacities.index_select(0, others).double()
    opacities = parameters.opacity_from_logit(logits)[:, None]
    passing = []
    for ends in (shifts + arms, shifts - arms):
        x, y, z = parameters.divide(ends, other_scales[:, :, None]).unbind(1)
        alphas = opacities * torch.exp(-0.5 * x.square().addcmul_(y, y).addcmul_(z, z))
        each = (1 - alphas).unflatten(0, neighbors.shape).unbind(1)
        # Not `prod`, which CUDA compiles at its first use, for 0.8 s.
        passing.append(reduce(torch.mul, each, alphas.new_ones(len(rows), 3)))
    return 1 - torch.stack(passing, dim=2)


def project_on_axes(
    rotations: Float[Tensor, "n 3 3"], vectors: Float[Tensor, "n 3 k"]
) -> Float[Tensor, "n 3 k"]:
    """Express vectors in frames whose axes are the columns of rotations."""
    rows = zip(rotations[:, :, :, None].unbind(1), vectors[:, :, None, :].unbind(1), strict=True)
    first, second, third = rows
    return (first[0] * first[1]).addcmul_(*second).addcmul_(*third)


def _frames(scene: GaussianScene, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return centres, axes (columns) and scales of some Gaussians in float64."""
    means, quats, log_scales = gather_columns(rows, scene.means, scene.quats, scene.log_scales)
    rotations = parameters.rotation_matrices(quats.double())
    return means.double(), rotations, torch.exp(log_scales.double())
