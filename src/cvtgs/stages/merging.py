"""Cells become Gaussians: moments or a member, neighbours, axes, width."""

from collections.abc import Callable

from jaxtyping import Float, Int
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
    merged, shown = merge_members(valid, partition, config, areas=areas, on_cells=on_cells)
    near = neighbors_asked(config, with_network=with_neighbors)
    neighbors = cvt.nearest_neighbors(merged.means, near, backend=backend)
    return shape_cells(merged, shown, neighbors, config), shown, neighbors


def merge_members(
    valid: GaussianScene,
    partition: cells.Partition,
    config: MergeConfig,
    *,
    areas: Float[Tensor, "n"],
    on_cells: Callable[[int], None] = lambda _: None,
) -> tuple[GaussianScene, cells.Partition]:
    """Merge every cell, as far as it takes nothing but its members.

    Args:
        valid: The Gaussians, with valid rows.
        partition: Row numbers of every cell.
        config: How a cell becomes one Gaussian.
        areas: Mean projected areas of the Gaussians.
        on_cells: Told how many cells are done.

    Returns:
        One Gaussian per cell, and the members that each stands for.
    """
    merged = cells.merge_cells(valid, partition, config=config, on_cells=on_cells)
    if not config.lone_members:
        return merged, partition
    return cells.keep_lone_members(valid, merged, partition, areas=areas)


def neighbors_asked(config: MergeConfig, *, with_network: bool) -> int:
    """Give the number of neighbours that are asked for.

    Args:
        config: How a cell becomes one Gaussian.
        with_network: Whether a network will ask for them.

    Returns:
        0 if nobody asks.
    """
    widens = config.widening > 0.0 or config.covered_widening > 0.0
    return NEIGHBORS if widens or with_network else 0


def shape_cells(
    merged: GaussianScene,
    shown: cells.Partition,
    neighbors: Int[Tensor, "m k"],
    config: MergeConfig,
) -> GaussianScene:
    """Settle the axes of merged Gaussians, and widen what must cover its cell.

    Args:
        merged: One Gaussian per cell, those of the partition first; others that follow are there
            as neighbours.
        shown: The members that each stands for; how many, not which, is asked.
        neighbors: The nearest other cells of every cell of the partition.
        config: How a cell becomes one Gaussian.

    Returns:
        The scene; Gaussians beyond the partition are as they were.
    """
    merged = cells.settle_frames(merged, shown, neighbors)
    if config.widening > 0.0 or config.covered_widening > 0.0:
        merged = cells.widen_cells(
            merged,
            shown,
            neighbors,
            everywhere=config.widening,
            covered=config.covered_widening,
        )
    return merged
