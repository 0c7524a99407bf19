"""Inflation: an opaque cell of many members must cover its cell, not only match its moments."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.activated import coordinates, gather, squared_lengths, take
from cvtgs.cells.partition import Partition
from cvtgs.math import parameters
from cvtgs.scene import GaussianScene

PROBE_SIGMAS = 3.0
"""An axis is probed this many standard deviations from the centre, at both ends."""

FULL_COVER = 0.1
"""Where neighbours paint at least this opaquely, an axis counts as covered."""

CHUNK = 1 << 11
"""Cells that are looked at together; each takes about ``1 kB`` for every neighbour."""


def inflate_cells(
    merged: GaussianScene,
    partition: Partition,
    neighbors: Int[Tensor, "m k"],
    *,
    everywhere: float,
    covered: float,
) -> GaussianScene:
    """Make the Gaussians of opaque, crowded cells wider than their moments.

    The mass of an opaque cell saturates: members hide one another, so a Gaussian with the
    moments of the cell paints less than they did, and leaves gaps between cells. The mass that
    does not fit should spill into area, but not over a silhouette. So an axis grows by the factor

    ``1 + a^2 min(log10(n) / 2, 1) (everywhere + covered * min(c / 0.1, 1))``

    with opacity a, n members, and c the smaller of the opacities that neighbours paint at three
    standard deviations on either side. This is our own rule, not part of CVT-GS.

    Args:
        merged: One Gaussian per cell, those of the partition first; others that follow only cover.
        partition: Members of the cells; cells of one member are not widened.
        neighbors: The nearest other cells of every cell of the partition.
        everywhere: Growth of an opaque cell of 100 members along every axis.
        covered: Growth beyond that along an axis that is covered at both ends.

    Returns:
        The scene with larger scales.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 2, sh_degree=0, seed=0)
        >>> cells = Partition.from_labels(torch.tensor([0, 1]), 2)
        >>> wide = inflate_cells(
        ...     scene, cells, torch.tensor([[1], [0]]), everywhere=0.1, covered=0.4
        ... )
        >>> bool((wide.log_scales == scene.log_scales).all())
        True
    """
    rows = (partition.counts > 1).nonzero()[:, 0]
    log_scales = merged.log_scales.clone()
    crowding = (partition.counts.double().log10() / 2).clamp_max(1.0)
    strength = merged.opacities[: len(partition)].double().square() * crowding
    for part in rows.split(CHUNK):
        cover = side_cover(merged, part, neighbors[part]).amin(dim=2)
        growth = everywhere + covered * (cover / FULL_COVER).clamp_max(1.0)
        factors = 1 + strength[part, None] * growth
        log_scales[part] += parameters.positive_log(factors).to(merged.dtype)
    return merged.with_tensors({"log_scales": log_scales}, merged.extras)


def side_cover(
    scene: GaussianScene, rows: Int[Tensor, "r"], neighbors: Int[Tensor, "r k"]
) -> Float[Tensor, "r 3 2"]:
    """Return how opaquely neighbours paint at both ends of every axis.

    Args:
        scene: All Gaussians.
        rows: The Gaussians whose ends are probed.
        neighbors: Row numbers of the neighbours of each.

    Returns:
        Opacities in [0, 1) at three standard deviations along each axis, on either side, in
        float64; neighbours are composited as if seen at their densest.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 2, sh_degree=0, seed=0)
        >>> side_cover(scene, torch.tensor([0]), torch.tensor([[1]])).shape
        torch.Size([1, 3, 2])
    """
    count, others = neighbors.shape[1], neighbors.flatten()
    means, rotations, scales = _frames(scene, rows)
    other_means, other_rotations, other_scales = _frames(scene, others)
    ids = torch.arange(len(rows), device=rows.device).repeat_interleave(count)
    shifts = coordinates(other_rotations, (take(means, ids) - other_means)[:, :, None])
    axes = take(rotations * (PROBE_SIGMAS * scales)[:, None, :], ids)
    arms = coordinates(other_rotations, axes)
    logits = scene.logit_opacities.index_select(0, others).double()
    opacities = parameters.opacity_from_logit(logits)[:, None]
    painted = [
        opacities * _bell(parameters.divide(ends, other_scales[:, :, None]))
        for ends in (shifts + arms, shifts - arms)
    ]
    return 1 - torch.stack(
        [(1 - paint).unflatten(0, neighbors.shape).prod(dim=1) for paint in painted], dim=2
    )


def _bell(places: Float[Tensor, "n 3 k"]) -> Float[Tensor, "n k"]:
    """Return how much of its opacity a Gaussian has at places in its standard deviations."""
    return torch.exp(-0.5 * squared_lengths(places.mT))


def _frames(scene: GaussianScene, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return centres, axes (columns) and scales of some Gaussians in float64."""
    quats = parameters.normalize_quats(gather(scene.quats, rows).double())
    scales = torch.exp(gather(scene.log_scales, rows).double())
    return gather(scene.means, rows).double(), parameters.quats_to_matrices(quats), scales
