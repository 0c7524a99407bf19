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
    """Merge every cell, settle its axes, and widen what must cover its cell."""
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
    """Merge every cell, as far as it takes nothing but its members."""
    merged = cells.merge_cells(valid, partition, config=config, on_cells=on_cells)
    if not config.representatives:
        return merged, partition
    return cells.keep_representatives(valid, merged, partition, areas=areas)


def neighbors_asked(config: MergeConfig, *, with_network: bool) -> int:
    """Return the number of neighbours that are asked for."""
    widens = config.inflation > 0.0 or config.covered_inflation > 0.0
    return NEIGHBORS if widens or with_network else 0


def shape_cells(
    merged: GaussianScene,
    shown: cells.Partition,
    neighbors: Int[Tensor, "m k"],
    config: MergeConfig,
) -> GaussianScene:
    """Settle the axes of merged Gaussians, and widen what must cover its cell."""
    merged = cells.align_axes(merged, shown, neighbors)
    if config.inflation > 0.0 or config.covered_inflation > 0.0:
        merged = cells.inflate_cells(
            merged,
            shown,
            neighbors,
            everywhere=config.inflation,
            covered=config.covered_inflation,
        )
    return merged
