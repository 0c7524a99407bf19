"""Surroundings: what cells became, and what is around each of them."""

from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.features import distances, facing, length, side_by_side
from cvtgs.cells.kernels import Kernels, contrasts_of, extents_in, kernels_of, places_in, take
from cvtgs.cells.widening import side_cover
from cvtgs.scene import GaussianScene


class Surroundings(NamedTuple):
    """Some merged Gaussians and their neighbours.

    ``sides`` are the covers of both ends of every axis, ``bare`` says how much barer the positive
    end is, ``pairs`` and ``places`` describe the neighbours and where they are.
    """

    own: Kernels
    sides: Tensor
    bare: Tensor
    pairs: Tensor
    places: Tensor

    def cut(self, run: slice) -> Self:
        """Keep some consecutive cells.

        Args:
            run: Which of these cells.

        Returns:
            Their surroundings.
        """
        own = Kernels(*(values[run] for values in self.own))
        return type(self)(own, *(values[run] for values in self[1:]))


def look_around(
    merged: GaussianScene,
    *,
    cells: Int[Tensor, "m"],
    neighbors: Int[Tensor, "m k"],
    sizes: Int[Tensor, "m_all"],
) -> Surroundings:
    """Describe the neighbours of some cells, the same way as members.

    Memory: about ``1 kB`` per neighbour.

    Args:
        merged: One Gaussian per cell, of all cells.
        cells: Which cells.
        neighbors: The nearest other cells of each of them.
        sizes: Number of members of every cell, of all cells.

    Returns:
        Their surroundings, in the dtype of the scene.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> around = look_around(
        ...     make("object", 2, sh_degree=0, seed=0), cells=torch.tensor([1]),
        ...     neighbors=torch.tensor([[0]]), sizes=torch.tensor([5, 6]),
        ... )
        >>> tuple(around.pairs.shape), tuple(around.sides.shape)
        ((1, 1, 18), (1, 3, 2))
    """
    own = kernels_of(merged, cells)
    sides = side_cover(merged, cells, neighbors).to(merged.dtype)
    bare = sides[:, :, 1] - sides[:, :, 0]
    pairs, places = _describe_pairs(merged, own, cells, neighbors, bare, sizes)
    return Surroundings(own=own, sides=sides, bare=bare, pairs=pairs, places=places)


def _describe_pairs(
    merged: GaussianScene,
    own: Kernels,
    cells: Tensor,
    neighbors: Tensor,
    bare: Tensor,
    sizes: Tensor,
) -> tuple[Float[Tensor, "m k e"], Float[Tensor, "m k 3"]]:
    """Give features of neighbours, and their places from the cell in its frame."""
    count, others = neighbors.shape[1], neighbors.flatten()
    other = kernels_of(merged, others)
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
