"""Descriptors: what MergeNet sees of a cell; nothing that tells where, how large or what colour."""

from dataclasses import dataclass, fields
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.activated import activate_rows
from cvtgs.cells.context import NeighborContext, neighbor_context
from cvtgs.cells.features import FARTHEST, cell_features, member_features, see_members
from cvtgs.cells.partition import Partition
from cvtgs.scene import GaussianScene

MEMBER_FEATURES = 19
"""Numbers that describe a member to its cell."""

PAIR_FEATURES = 18
"""Numbers that describe a neighbour to a cell."""

CELL_FEATURES = 19
"""Numbers that describe a cell by itself."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Descriptors:
    """Some cells as a network sees them, in the dtype of the scene.

    Every feature is relative to the merged Gaussian of the cell: in its frame, in its standard
    deviations, and the same whichever way an axis points.

    Attributes:
        members: ``(n, 19)`` features of the members, those of one cell next to one another.
        pairs: ``(m, k, 18)`` features of the neighbours of every cell.
        cells: ``(m, 19)`` features of the cells.
        weights: ``(n,)`` shares of the mass of the cell; those of one cell sum to 1.
        offsets: ``(m + 1,)`` where each cell starts, and the end of the last one.
        positions: ``(n, 3)`` where members are, from the centre of the cell, in its frame and in
            its standard deviations.
        pair_positions: ``(m, k, 3)`` the same of the neighbours.
    """

    members: Float[Tensor, "n d"]
    pairs: Float[Tensor, "m k e"]
    cells: Float[Tensor, "m c"]
    weights: Float[Tensor, "n"]
    offsets: Int[Tensor, "m_plus_1"]
    positions: Float[Tensor, "n 3"]
    pair_positions: Float[Tensor, "m k 3"]

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.cells)

    def to(self, target: torch.device | torch.dtype) -> Self:
        """Move the descriptors to a device, or give them another precision.

        Args:
            target: A device, or a dtype for all but ``offsets``.

        Returns:
            The descriptors there.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        moves = {
            name: value.to(target)
            for name, value in values.items()
            if isinstance(target, torch.device) or value.is_floating_point()
        }
        return type(self)(**(values | moves))


def describe_cells(
    scene: GaussianScene,
    merged: GaussianScene,
    part: Partition,
    *,
    cells: Int[Tensor, "m"],
    neighbors: Int[Tensor, "m k"],
    sizes: Int[Tensor, "m_all"],
    visibility: Float[Tensor, "n_all"],
) -> Descriptors:
    """Describe some cells to their network.

    After CVT-GS: place, size and direction of a member relative to its cell, its opacity, its
    share of the mass, and how far its colour is from that of the cell. Ours differ: directions
    are given by the extents along the axes of the cell (several quaternions say the same),
    colours by their distance only; a cell knows its neighbours and which of its sides they
    cover, and a member how freely it can be seen.

    Memory: about ``1.5 kB`` per member and per pair of neighbours.

    Args:
        scene: The Gaussians.
        merged: One Gaussian per cell, of all cells.
        part: Members of the cells to describe.
        cells: Which cells those are.
        neighbors: The nearest other cells of each of them.
        sizes: Number of members of every cell, of all cells.
        visibility: Ambient visibility of every Gaussian of the scene, 0 to 1
            (:func:`cvtgs.analysis.ambient_visibility`).

    Returns:
        The descriptors, in the dtype of the scene.

    Example:
        >>> from cvtgs.cells import merge_cells
        >>> from cvtgs.config import MergeConfig
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 5, sh_degree=0, seed=0)
        >>> part = Partition.from_labels(torch.tensor([0, 0, 0, 1, 1]), 2)
        >>> seen = describe_cells(
        ...     scene, merge_cells(scene, part, config=MergeConfig()), part,
        ...     cells=torch.arange(2), neighbors=torch.tensor([[1], [0]]), sizes=part.counts,
        ...     visibility=torch.ones(5),
        ... )
        >>> tuple(seen.members.shape), tuple(seen.pairs.shape), tuple(seen.cells.shape)
        ((5, 19), (2, 1, 18), (2, 19))
    """
    around = neighbor_context(merged, cells=cells, neighbors=neighbors, sizes=sizes)
    return describe_members(scene, part, around=around, visibility=visibility)


def describe_members(
    scene: GaussianScene,
    part: Partition,
    *,
    around: NeighborContext,
    visibility: Float[Tensor, "n_all"],
) -> Descriptors:
    """Describe some cells whose surroundings are known, as :func:`describe_cells` does."""
    members = activate_rows(scene, part.order)
    lights = visibility.index_select(0, part.order).to(scene.dtype)
    seen = see_members(members, around.own, part.offsets, lights)
    return Descriptors(
        members=member_features(seen, around.bare),
        pairs=around.pairs,
        cells=cell_features(around.own, seen, around.sides, around.places),
        weights=seen.weights,
        offsets=part.offsets,
        positions=seen.places.clamp(-FARTHEST, FARTHEST),
        pair_positions=around.places.clamp(-FARTHEST, FARTHEST),
    )
