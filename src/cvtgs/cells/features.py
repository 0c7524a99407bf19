"""Features: numbers that describe members, neighbours and cells, before they meet a network."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.activated import ActivatedGaussians, contrasts_of, extents_in, places_in, take
from cvtgs.math import parameters
from cvtgs.math.segments import segment_ids, segment_max, segment_sum

FARTHEST = 50.0
"""All that is farther than this, in standard deviations, looks the same."""


class SeenMembers(NamedTuple):
    """Members as their cell sees them; the cells in those from ``counts``."""

    ids: Tensor
    weights: Tensor
    opacities: Tensor
    places: Tensor
    extents: Tensor
    areas: Tensor
    contrasts: Tensor
    lights: Tensor
    counts: Tensor
    contrast: Tensor
    light: Tensor
    slope: Tensor
    painted: Tensor
    inner: Tensor


def see_members(
    members: ActivatedGaussians,
    own: ActivatedGaussians,
    offsets: Int[Tensor, "m_plus_1"],
    lights: Float[Tensor, "n"],
) -> SeenMembers:
    """Express members by what their cell became."""
    ids = segment_ids(offsets)
    cell = own.take(ids)
    opacities = members.opacities
    weights = _shares(members.log_areas + parameters.positive_log(opacities), offsets, ids)
    contrasts = contrasts_of(members, cell)
    places, extents = places_in(cell, members.means - cell.means), extents_in(cell, members)
    areas = (members.log_areas - cell.log_areas).clamp(-14, 14)
    totals = _total(
        side_by_side(
            weights * contrasts.square(),
            weights * lights,
            parameters.optical_depth_from_logit(members.logits) * torch.exp(areas),
            weights[:, None] * torch.exp(2 * extents).clamp_max(4.0),
        ),
        offsets,
    )
    squares, light, painted = totals[:, :3].unbind(1)
    lean = weights * (lights - light.index_select(0, ids))
    return SeenMembers(
        ids=ids,
        weights=weights,
        opacities=opacities,
        places=places,
        extents=extents,
        areas=areas,
        contrasts=contrasts,
        lights=lights,
        counts=offsets.diff().to(weights.dtype),
        contrast=squares.sqrt(),
        light=light,
        slope=_total(lean[:, None] * places, offsets),
        painted=painted,
        inner=totals[:, 3:],
    )


def member_features(seen: SeenMembers, bare: Float[Tensor, "m 3"]) -> Float[Tensor, "n d"]:
    """Describe members: place, extent, side, share, opacity, area, contrast and light."""
    ids, places = seen.ids, seen.places
    share = parameters.positive_log(seen.weights * seen.counts.index_select(0, ids)).clamp(-14, 14)
    towards_light = (take(seen.slope, ids) * places).sum(dim=1)
    return side_by_side(
        *distances(places),
        0.3 * seen.extents,
        *facing(places.clamp(-4, 4), take(bare, ids)),
        0.3 * share,
        seen.opacities,
        0.2 * seen.areas,
        3 * seen.contrasts,
        0.5 * seen.contrasts / (seen.contrast.index_select(0, ids) + 0.02),
        seen.lights,
        3 * (seen.lights - seen.light.index_select(0, ids)),
        towards_light.clamp(-3, 3),
    )


def cell_features(
    own: ActivatedGaussians,
    seen: SeenMembers,
    sides: Float[Tensor, "m 3 2"],
    pair_places: Float[Tensor, "m k 3"],
) -> Float[Tensor, "m c"]:
    """Describe cells: cover of the sides, share of inner extent, size, opacity, shape and light."""
    painted = parameters.positive_log(seen.painted)
    shape = own.log_scales
    distances = pair_places.square().sum(dim=2).sqrt()
    nearest = torch.nn.functional.pad(distances, (0, 1), value=FARTHEST).amin(dim=1)
    return side_by_side(
        sides.amin(dim=2),
        sides.amax(dim=2),
        seen.inner,
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
    )


def _shares(logs: Tensor, offsets: Tensor, ids: Tensor) -> Tensor:
    """Turn logarithms of masses into shares of the mass of the cell."""
    masses = torch.exp(logs - segment_max(logs, offsets).index_select(0, ids))
    return masses / _total(masses, offsets).index_select(0, ids)


def _total(values: Tensor, offsets: Tensor) -> Tensor:
    """Sum over the members of every cell, in float64."""
    return segment_sum(values.double(), offsets).to(values.dtype)


def side_by_side(*features: Tensor) -> Tensor:
    """Make one column of each number, in memory column by column."""
    return torch.cat([part.T if part.ndim == 2 else part[None] for part in features]).T


def distances(places: Tensor) -> tuple[Tensor, Tensor]:
    """Return distances along every axis and as a whole, compressed."""
    return torch.log1p(places.abs().clamp_max(FARTHEST)), length(places)


def length(places: Tensor) -> Tensor:
    """Return distances, compressed."""
    lengths = places.square().sum(dim=1).sqrt()
    return torch.log1p(lengths.clamp_max(FARTHEST))


def facing(places: Tensor, bare: Tensor) -> tuple[Tensor, Tensor]:
    """Return whether places lie on the bare or on the covered side, by axis and as a whole."""
    by_axis = 0.5 * bare * places
    return by_axis, by_axis.sum(dim=1)
