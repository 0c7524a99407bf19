"""NeighborContext: what cells became, and what is around each of them."""

from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.activated import (
    ActivatedGaussians,
    activate_rows,
    contrasts_of,
    extents_in,
    places_in,
    take,
)
from cvtgs.cells.features import distances, facing, length, side_by_side
from cvtgs.cells.inflation import side_cover
from cvtgs.scene import GaussianScene


class NeighborContext(NamedTuple):
    """Some merged Gaussians and their neighbours.

    ``sides`` are the covers of both ends of every axis, ``bare`` says how much barer the positive
    end is, ``pairs`` and ``places`` describe the neighbours and where they are.
    """

    own: ActivatedGaussians
    sides: Tensor
    bare: Tensor
    pairs: Tensor
    places: Tensor

    def cut(self, run: slice) -> Self:
        """Keep some consecutive cells."""
        own = ActivatedGaussians(*(values[run] for values in self.own))
        return type(self)(own, *(values[run] for values in self[1:]))


def neighbor_context(
    merged: GaussianScene,
    *,
    cells: Int[Tensor, "m"],
    neighbors: Int[Tensor, "m k"],
    sizes: Int[Tensor, "m_all"],
) -> NeighborContext:
    """Describe the neighbours of some cells, the same way as members.

    Memory: about ``1 kB`` per neighbour.
    """
    own = activate_rows(merged, cells)
    sides = side_cover(merged, cells, neighbors).to(merged.dtype)
    bare = sides[:, :, 1] - sides[:, :, 0]
    pairs, places = _describe_pairs(merged, own, cells, neighbors, bare, sizes)
    return NeighborContext(own=own, sides=sides, bare=bare, pairs=pairs, places=places)


def _describe_pairs(
    merged: GaussianScene,
    own: ActivatedGaussians,
    cells: Tensor,
    neighbors: Tensor,
    bare: Tensor,
    sizes: Tensor,
) -> tuple[Float[Tensor, "m k e"], Float[Tensor, "m k 3"]]:
    """Return features of neighbours, and their places from the cell in its frame."""
    count, others = neighbors.shape[1], neighbors.flatten()
    other = activate_rows(merged, others)
    opacities = other.opacities
    ids = torch.arange(len(cells), device=cells.device).repeat_interleave(count)
    cell = own.take(ids)
    shifts = other.means - cell.means
    places, back = places_in(cell, shifts), places_in(other, shifts)
    crowd = sizes[others].to(places.dtype) / sizes[cells][ids].to(places.dtype)
    described = side_by_side(
        *distances(places),
        0.3 * extents_in(cell, other),
        *facing(places / (1 + places.abs()), take(bare, ids)),
        length(back),
        opacities,
        0.2 * (other.log_areas - cell.log_areas).clamp(-14, 14),
        0.2 * torch.log(crowd),
        3 * contrasts_of(other, cell),
        opacities * _bell(back),
        _bell(places),
    )
    shape = (len(cells), count)
    return described.unflatten(0, shape), places.unflatten(0, shape)


def _bell(places: Tensor) -> Tensor:
    return torch.exp(-0.5 * places.square().sum(dim=1).clamp_max(60.0))
