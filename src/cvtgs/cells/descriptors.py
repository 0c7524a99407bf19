"""Descriptors: the input of MergeNet."""

import math
from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.partition import Partition
from cvtgs.text import short_repr

MEMBER_FEATURES = 19  # number of features of a member relative to its cell
PAIR_FEATURES = 18  # number of features of a neighbour relative to a cell
CELL_FEATURES = 21  # number of features of a cell itself

DISTANCE, DISTANCE_BACK = 3, 11
"""Indices of the features of a neighbour that are ``log(1 + d)`` of its distance in standard
deviations of the cell, and in its own."""

AREA, AREA_SCALE = 13, 0.2
"""Index of the feature of a neighbour that is the logarithm of its mean projected area relative to
that of the cell, and its factor."""

PIXEL_SCALE = 0.3  # factor of the logarithm of a size in pixels, the last feature of a cell
LEAST_PIXELS = -6.0  # logarithm of the size in pixels of the smallest cells of training scenes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Descriptors:
    """The input of a network for some cells, in the dtype of the scene.

    Every feature is relative to the merged Gaussian of the cell: in its frame, in units of its
    standard deviations, and independent of the sign of each axis.

    Attributes:
        members: ``(n, 19)`` features of the described members; those of one cell are contiguous.
        pairs: ``(m, k, 18)`` features of the neighbours of every cell.
        cells: ``(m, 21)`` features of the cells; the last one is 0.3 times the logarithm of their
            size in pixels, within limits.
        weights: ``(n,)`` share of the mass of the cell that each stands for; those of one cell sum
            to 1.
        shares: ``(n,)`` the same for the number of members.
        rows: ``(n,)`` row numbers of the members in the scene.
        offsets: ``(m + 1,)`` start of each cell, and the end of the last one.
        positions: ``(n, 3)`` positions of the members relative to the centre of the cell, in its
            frame and its standard deviations.
        pair_positions: ``(m, k, 3)`` the same for the neighbours.
    """

    members: Float[Tensor, "n d"]
    pairs: Float[Tensor, "m k e"]
    cells: Float[Tensor, "m c"]
    weights: Float[Tensor, "n"]
    shares: Float[Tensor, "n"]
    rows: Int[Tensor, "n"]
    offsets: Int[Tensor, "m_plus_1"]
    positions: Float[Tensor, "n 3"]
    pair_positions: Float[Tensor, "m k 3"]

    __repr__ = short_repr

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.cells)

    @property
    def part(self) -> Partition:
        """The described members of every cell."""
        return Partition(order=self.rows, offsets=self.offsets)

    def select(self, cells: Int[Tensor, "s"]) -> Self:
        """Return the descriptors of some cells, which ascend."""
        numbers = torch.arange(len(self.members), device=self.offsets.device)
        part = Partition(order=numbers, offsets=self.offsets).select(cells)
        of_members = ("members", "weights", "shares", "rows", "positions")
        kept = dict.fromkeys(of_members, part.order)
        kept |= dict.fromkeys(("pairs", "cells", "pair_positions"), cells)
        taken = {name: getattr(self, name).index_select(0, rows) for name, rows in kept.items()}
        return replace(self, offsets=part.offsets, **taken)

    def in_images(self, factor: float) -> Self:
        """Return the descriptors of the same cells in images that are larger by a factor."""
        cells = self.cells.clone()
        cells[:, -1] += PIXEL_SCALE * math.log(factor)
        return replace(self, cells=cells)

    def to(self, target: torch.device | torch.dtype) -> Self:
        """Return the descriptors on a device, or in a dtype but for ``rows`` and ``offsets``."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        moved = {
            name: value.to(target)
            for name, value in values.items()
            if isinstance(target, torch.device) or value.is_floating_point()
        }
        return replace(self, **moved)
