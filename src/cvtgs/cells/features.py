"""Features: numbers that describe members, neighbours and cells, before they meet a network."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cells.moments import Members
from cvtgs.math import activations, covariances, quaternions
from cvtgs.math.segments import segment_ids, segment_sum
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import GaussianScene

FARTHEST = 50.0
"""All that is farther than this, in standard deviations, looks the same."""


class Kernels(NamedTuple):
    """Some merged Gaussians in float64."""

    means: Tensor
    rotations: Tensor
    scales: Tensor
    areas: Tensor
    opacities: Tensor
    colors: Tensor


class SeenMembers(NamedTuple):
    """Members as their cell sees them."""

    ids: Tensor
    counts: Tensor
    places: Tensor
    extents: Tensor
    areas: Tensor
    contrasts: Tensor
    contrast: Tensor
    lights: Tensor
    light: Tensor


def kernels_of(merged: GaussianScene, rows: Tensor) -> Kernels:
    scales = torch.exp(merged.log_scales[rows].double())
    return Kernels(
        means=merged.means[rows].double(),
        rotations=quaternions.to_matrices(quaternions.normalize(merged.quats[rows].double())),
        scales=scales,
        areas=covariances.mean_projected_area(scales),
        opacities=activations.opacity_from_logit(merged.logit_opacities[rows].double()),
        colors=colors_of(merged, rows),
    )


def colors_of(scene: GaussianScene, rows: Tensor) -> Float[Tensor, "n 3"]:
    return scene.sh0[rows, 0].double() * SH_C0


def see_members(
    members: Members, weights: Tensor, own: Kernels, colors: Tensor, lights: Tensor
) -> SeenMembers:
    ids = segment_ids(members.offsets)
    rotations, scales = own.rotations[ids], own.scales[ids]
    contrasts = (colors - own.colors[ids]).square().mean(dim=1).sqrt()
    return SeenMembers(
        ids=ids,
        counts=members.offsets.diff().double(),
        places=_inside(rotations, members.means - own.means[ids]) / scales,
        extents=_extents(rotations, quaternions.to_matrices(members.quats), members.scales, scales),
        areas=_log_ratio(members.areas, own.areas[ids]),
        contrasts=contrasts,
        contrast=segment_sum(weights * contrasts.square(), members.offsets).sqrt(),
        lights=lights,
        light=segment_sum(weights * lights, members.offsets),
    )


def member_features(
    members: Members, weights: Tensor, seen: SeenMembers, bare: Tensor
) -> Float[Tensor, "n d"]:
    ids, places = seen.ids, seen.places
    lights = seen.lights - seen.light[ids]
    slope = segment_sum((weights * lights)[:, None] * places, members.offsets)
    towards_light = (slope[ids] * places).sum(dim=1)
    return torch.cat(
        [
            *_distances(places),
            0.3 * seen.extents,
            *_facing(places.clamp(-4, 4), bare[ids]),
            torch.stack(
                [
                    0.3 * _log_ratio(weights * seen.counts[ids]),
                    members.opacities,
                    0.2 * seen.areas,
                    3 * seen.contrasts.clamp_max(2.0),
                    0.5 * seen.contrasts / (seen.contrast[ids] + 0.02),
                    seen.lights,
                    3 * lights,
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
    count = neighbors.shape[1]
    other = kernels_of(merged, neighbors.flatten())
    own = Kernels(*(values.repeat_interleave(count, dim=0) for values in own))
    shifts = other.means - own.means
    places = _inside(own.rotations, shifts) / own.scales
    back = _inside(other.rotations, shifts) / other.scales
    crowd = sizes[neighbors.flatten()].double() / sizes[cells].repeat_interleave(count).double()
    described = torch.cat(
        [
            *_distances(places),
            0.3 * _extents(own.rotations, other.rotations, other.scales, own.scales),
            *_facing(places / (1 + places.abs()), bare.repeat_interleave(count, dim=0)),
            torch.stack(
                [
                    _length(back),
                    other.opacities,
                    0.2 * _log_ratio(other.areas, own.areas),
                    0.2 * torch.log(crowd),
                    3 * (other.colors - own.colors).square().mean(dim=1).sqrt().clamp_max(2.0),
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
    members: Members,
    weights: Tensor,
    own: Kernels,
    seen: SeenMembers,
    sides: Tensor,
    pair_places: Tensor,
) -> Float[Tensor, "m c"]:
    offsets = members.offsets
    lights = seen.lights - seen.light[seen.ids]
    slope = segment_sum((weights * lights)[:, None] * seen.places, offsets)
    inner = segment_sum(weights[:, None] * torch.exp(2 * seen.extents).clamp_max(4.0), offsets)
    painted = segment_sum(members.depths * members.areas, offsets)
    shape = activations.positive_log(own.scales)
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
                    0.2 * activations.logit_from_opacity(own.opacities),
                    0.3 * _log_ratio(painted, own.areas),
                    0.5 * (shape[:, 0] - shape[:, 1]).clamp(-8, 8),
                    0.3 * (shape[:, 1] - shape[:, 2]).clamp(-8, 8),
                    5 * seen.contrast.clamp_max(2.0),
                    seen.light,
                    torch.linalg.vector_norm(slope, dim=1).clamp_max(3.0),
                    torch.log1p(nearest),
                ],
                dim=1,
            ),
        ],
        dim=1,
    )


def _inside(rotations: Tensor, vectors: Tensor) -> Tensor:
    """Express vectors in frames given by the axes as columns."""
    return torch.einsum("nij,ni->nj", rotations, vectors)


def _extents(frames: Tensor, rotations: Tensor, scales: Tensor, units: Tensor) -> Tensor:
    """Give the log of standard deviations along the axes of frames, in units of each axis."""
    turned = torch.einsum("nij,nik->njk", frames, rotations) * scales[:, None, :]
    lengths = torch.linalg.vector_norm(turned / units[:, :, None], dim=2)
    return activations.positive_log(lengths).clamp(-9, 9)


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


def _log_ratio(values: Tensor, units: Tensor | float = 1.0) -> Tensor:
    return (activations.positive_log(values / units)).clamp(-14, 14)
