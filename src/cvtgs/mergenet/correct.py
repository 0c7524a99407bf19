"""Correct: let MergeNet see every cell of a scene, a chunk at a time."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells import Partition
from cvtgs.cells.context import neighbor_context
from cvtgs.cells.descriptors import describe_members
from cvtgs.mergenet.compose import compose
from cvtgs.mergenet.model import MergeNet
from cvtgs.scene import GaussianScene

CHUNK_MEMBERS = 1 << 15
"""Members and neighbours that are described together; each takes about ``2 kB``."""


def correct_cells(
    net: MergeNet,
    scene: GaussianScene,
    merged: GaussianScene,
    partition: Partition,
    *,
    neighbors: Int[Tensor, "m k"],
    visibility: Float[Tensor, "n"],
    sizes: Int[Tensor, "m_all"] | None = None,
    on_cells: Callable[[int], None] = lambda done: None,
) -> GaussianScene:
    """Correct every merged Gaussian that stands for several.

    Args:
        net: The network, on the device of the scene.
        scene: The Gaussians, with valid rows.
        merged: One Gaussian per cell, those of the partition first; others that follow are only
            seen by their neighbours.
        partition: Members of the cells; cells of one member are not looked at.
        neighbors: The nearest other cells of every cell of the partition.
        visibility: Ambient visibility of every Gaussian of the scene, 0 to 1.
        sizes: Number of members of every cell in ``merged``; None if all are in the partition.
        on_cells: Told how many cells are done.

    Returns:
        The scene with corrected Gaussians.

    Example:
        >>> from cvtgs.cells import merge_cells
        >>> from cvtgs.config import MergeConfig
        >>> from cvtgs.mergenet import Architecture
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 5, sh_degree=0, seed=0)
        >>> cells = Partition.from_labels(torch.tensor([0, 0, 0, 1, 1]), 2)
        >>> merged = merge_cells(scene, cells, config=MergeConfig())
        >>> untrained = MergeNet(Architecture())
        >>> corrected = correct_cells(
        ...     untrained, scene, merged, cells,
        ...     neighbors=torch.tensor([[1], [0]]), visibility=torch.ones(5),
        ... )
        >>> bool((corrected.means == merged.means).all())
        True
    """
    counts, near = partition.counts, neighbors.shape[1]
    sizes = counts if sizes is None else sizes
    cells = (counts > 1).nonzero()[:, 0]
    several = partition.select(counts > 1)
    done = len(partition) - len(cells)
    tensors = {name: values.clone() for name, values in merged.tensors().items()}
    filled = [name for name, values in tensors.items() if values.numel()]  # not SH of degree 0
    with torch.no_grad():
        step = max(1, CHUNK_MEMBERS // max(1, near))
        for block in (slice(start, start + step) for start in range(0, len(cells), step)):
            around = neighbor_context(
                merged, cells=cells[block], neighbors=neighbors[cells[block]], sizes=sizes
            )
            for run, part in several.cut(block).chunks(CHUNK_MEMBERS, cell_cost=near):
                rows = cells[block][run]
                seen = describe_members(scene, part, around=around.cut(run), visibility=visibility)
                changed = compose(
                    scene, merged, part, cells=rows, neighbors=neighbors[rows], residuals=net(seen)
                )
                for name in filled:
                    tensors[name][rows] = changed[name]
                done += len(part)
                on_cells(done)
    for name in filled:
        # Near the limits of the dtype (a flyaway at 3e38) a change may overflow.
        kept = getattr(merged, name)
        tensors[name] = torch.where(tensors[name].isfinite(), tensors[name], kept)
    return merged.with_tensors(tensors, merged.extras)
