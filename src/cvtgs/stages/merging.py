"""Cells become Gaussians: moments or a member, neighbours, axes, width."""

from collections.abc import Callable

from torch import Tensor

from cvtgs import cells, cvt
from cvtgs.config import MergeConfig
from cvtgs.scene import GaussianScene

NEIGHBORS = 8
"""Cells around a cell that may cover its ends, and that its network sees."""


def merge_groups(
    valid: GaussianScene,
    partition: cells.Partition,
    config: MergeConfig,
    *,
    areas: Tensor,
    with_neighbors: bool,
    backend: str,
    on_cells: Callable[[int], None],
) -> tuple[GaussianScene, cells.Partition, Tensor]:
    """Merge every cell, settle its axes, and widen what must cover its cell.

    Args:
        valid: The Gaussians, with valid rows.
        partition: Row numbers of every cell.
        config: How a cell becomes one Gaussian.
        areas: Mean projected areas of the Gaussians.
        with_neighbors: Whether a network will ask for the neighbours.
        backend: What searches them.
        on_cells: Told how many cells are done.

    Returns:
        One Gaussian per cell, the members that each stands for, and the ``(m, k)`` nearest other
        cells of each; k is 0 if nobody asks.
    """
    merged = cells.merge_cells(valid, partition, config=config, on_cells=on_cells)
    if config.lone_members:
        merged, partition = cells.keep_lone_members(valid, merged, partition, areas=areas)
    widens = config.widening > 0.0 or config.covered_widening > 0.0
    near = NEIGHBORS if widens or with_neighbors else 0
    neighbors = cvt.nearest_neighbors(merged.means, near, backend=backend)
    merged = cells.settle_frames(merged, partition, neighbors)
    if widens:
        merged = cells.widen_cells(
            merged,
            partition,
            neighbors,
            everywhere=config.widening,
            covered=config.covered_widening,
        )
    return merged, partition, neighbors
