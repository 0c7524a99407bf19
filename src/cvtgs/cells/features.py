"""Features: numbers that describe members, neighbours and cells, before they meet a network."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.kernels import Kernels, contrasts_of, extents_in, kernels_of, places_in
from cvtgs.math import activations
from cvtgs.math.segments import segment_ids, segment_max, segment_sum
from cvtgs.scene import GaussianScene

FARTHEST = 50.0
"""All that is farther than this, in standard deviations, looks the same."""


class SeenMembers(NamedTuple):
    """Members as their cell sees them, and in ``counts``, ``contrast``, ``light`` the cells."""

    ids: Tensor
    weights: Tensor
    opacities: Tensor
    depths: Tensor
    counts: Tensor
    places: Tensor
    extents: Tensor
    areas: Tensor
    contrasts: Tensor
    contrast: Tensor
    lights: Tensor
    light: Tensor
    slope: Tensor


def see_members(
    members: Kernels, own: Kernels, offsets: Int[Tensor, "m_plus_1"], lights: Float[Tensor, "n"]
) -> SeenMembers:
    """Express members by what their cell became.

    Args:
        members: Members of some cells, those of one cell next to one another.
        own: What each of these cells became.
        offsets: Where each cell starts, and the end of the last one.
        lights: ``(n,)`` how freely the members can be seen, 0 to 1.

    Returns:
        What is told about members and cells.
    """
    ids = segment_ids(offsets)
    cell = own.take(ids)
    weights = _shares(members.log_areas + activations.positive_log(members.opacities), offsets)
    contrasts = contrasts_of(members, cell)
    places = places_in(cell, members.means - cell.means)
    light = _total(weights * lights, offsets)
    lean = weights * (lights - light.index_select(0, ids))
    return SeenMembers(
        ids=ids,
        weights=weights,
        opacities=members.opacities,
        depths=activations.optical_depth_from_logit(members.logits),
        counts=offsets.diff().to(weights.dtype),
        places=places,
        extents=extents_in(cell, members),
        areas=(members.log_areas - cell.log_areas).clamp(-14, 14),
        contrasts=contrasts,
        contrast=_total(weights * contrasts.square(), offsets).sqrt(),
        lights=lights,
        light=light,
        slope=_total(lean[:, None] * places, offsets),
    )


def member_features(seen: SeenMembers, bare: Float[Tensor, "m 3"]) -> Float[Tensor, "n d"]:
    """Describe members: place, extent, side, share, opacity, area, contrast and light.

    Args:
        seen: The members as their cell sees them.
        bare: How much barer the positive than the negative side of each axis is.

    Returns:
        One row per member.
    """
    ids, places = seen.ids, seen.places
    share = activations.positive_log(seen.weights * seen.counts.index_select(0, ids)).clamp(-14, 14)
    towards_light = (seen.slope.index_select(0, ids) * places).sum(dim=1)
    return torch.cat(
        [
            *_distances(places),
            0.3 * seen.extents,
            *_facing(places.clamp(-4, 4), bare.index_select(0, ids)),
            torch.stack(
                [
                    0.3 * share,
                    seen.opacities,
                    0.2 * seen.areas,
                    3 * seen.contrasts,
                    0.5 * seen.contrasts / (seen.contrast.index_select(0, ids) + 0.02),
                    seen.lights,
                    3 * (seen.lights - seen.light.index_select(0, ids)),
                    towards_light.clamp(-3, 3),
                ],
                dim=1,
            ),
        ],
        dim=1,
    )


def pair_features(
    merged: GaussianScene,
    own: Kernels,
    cells: Tensor,
    neighbors: Tensor,
    bare: Tensor,
    sizes: Tensor,
) -> tuple[Float[Tensor, "m k e"], Float[Tensor, "m k 3"]]:
    """Describe neighbours to cells, the same way as members.

    Args:
        merged: One Gaussian per cell, of all cells.
        own: Those of the cells to describe.
        cells: ``(m,)`` which cells these are.
        neighbors: ``(m, k)`` the nearest other cells of each.
        bare: ``(m, 3)`` how much barer the positive than the negative side of each axis is.
        sizes: ``(m_all,)`` number of members of every cell.

    Returns:
        Features, and places in the frame and the standard deviations of the cell.
    """
    count, others = neighbors.shape[1], neighbors.flatten()
    other = kernels_of(merged, others)
    ids = torch.arange(len(cells), device=cells.device).repeat_interleave(count)
    cell = own.take(ids)
    shifts = other.means - cell.means
    places, back = places_in(cell, shifts), places_in(other, shifts)
    crowd = sizes[others].to(places.dtype) / sizes[cells][ids].to(places.dtype)
    described = torch.cat(
        [
            *_distances(places),
            0.3 * extents_in(cell, other),
            *_facing(places / (1 + places.abs()), bare.index_select(0, ids)),
            torch.stack(
                [
                    _length(back),
                    other.opacities,
                    0.2 * (other.log_areas - cell.log_areas).clamp(-14, 14),
                    0.2 * torch.log(crowd),
                    3 * contrasts_of(other, cell),
                    other.opacities * _bell(back),
                    _bell(places),
                ],
                dim=1,
            ),
        ],
        dim=1,
    )
    shape = (len(cells), count)
    return described.unflatten(0, shape), places.unflatten(0, shape)


def cell_features(
    own: Kernels,
    seen: SeenMembers,
    offsets: Int[Tensor, "m_plus_1"],
    sides: Float[Tensor, "m 3 2"],
    pair_places: Float[Tensor, "m k 3"],
) -> Float[Tensor, "m c"]:
    """Describe cells: cover of the sides, share of inner extent, size, opacity, shape and light.

    Args:
        own: What each of the cells became.
        seen: The members as their cell sees them.
        offsets: Where each cell starts, and the end of the last one.
        sides: How opaquely neighbours paint at the ends of every axis.
        pair_places: Where neighbours are, in standard deviations.

    Returns:
        One row per cell.
    """
    inner = _total(seen.weights[:, None] * torch.exp(2 * seen.extents).clamp_max(4.0), offsets)
    painted = activations.positive_log(_total(seen.depths * torch.exp(seen.areas), offsets))
    shape = own.log_scales
    distances = torch.linalg.vector_norm(pair_places, dim=2)
    nearest = torch.nn.functional.pad(distances, (0, 1), value=FARTHEST).amin(dim=1)
    return torch.cat(
        [
            sides.amin(dim=2),
            sides.amax(dim=2),
            inner,
            torch.stack(
                [
                    0.2 * torch.log(seen.counts),
                    own.opacities,
                    0.2 * own.logits,
                    0.3 * painted.clamp(-14, 14),
                    0.5 * (shape[:, 0] - shape[:, 1]).clamp(-8, 8),
                    0.3 * (shape[:, 1] - shape[:, 2]).clamp(-8, 8),
                    5 * seen.contrast,
                    seen.light,
                    torch.linalg.vector_norm(seen.slope, dim=1).clamp_max(3.0),
                    torch.log1p(nearest),
                ],
                dim=1,
            ),
        ],
        dim=1,
    )


def _shares(logs: Tensor, offsets: Tensor) -> Tensor:
    """Turn logarithms of masses into shares of the mass of the cell."""
    ids = segment_ids(offsets)
    masses = torch.exp(logs - segment_max(logs, offsets).index_select(0, ids))
    return masses / _total(masses, offsets).index_select(0, ids)


def _total(values: Tensor, offsets: Tensor) -> Tensor:
    """Sum over the members of every cell, in float64."""
    return segment_sum(values.double(), offsets).to(values.dtype)


def _distances(places: Tensor) -> tuple[Tensor, Tensor]:
    """Give distances along every axis and as a whole, compressed."""
    return torch.log1p(places.abs().clamp_max(FARTHEST)), _length(places)[:, None]


def _length(places: Tensor) -> Tensor:
    lengths = torch.linalg.vector_norm(places, dim=1)
    return torch.log1p(lengths.clamp_max(FARTHEST))


def _facing(places: Tensor, bare: Tensor) -> tuple[Tensor, Tensor]:
    """Tell whether places lie on the bare or on the covered side, by axis and as a whole."""
    by_axis = 0.5 * bare * places
    return by_axis, by_axis.sum(dim=1, keepdim=True)


def _bell(places: Tensor) -> Tensor:
    return torch.exp(-0.5 * places.square().sum(dim=1).clamp_max(60.0))
