"""Merge the members of every cell into one Gaussian, by moments or by a representative."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.partition import Partition
from cvtgs.checks import checked
from cvtgs.config import MergeConfig
from cvtgs.devices import chunk_length, in_threads
from cvtgs.math import parameters
from cvtgs.math.segments import (
    gather_columns,
    segment_argmax,
    segment_ids,
    segment_max,
    segment_sum,
    take_columns,
    true_rows,
)
from cvtgs.math.spherical_harmonics import clamped_parts
from cvtgs.scene import GaussianScene

CHUNK_MEMBERS = 1 << 15  # of about ``(60 + 6 k) * 8`` bytes each, with k coefficients in ``shN``
OPAQUE = -math.log(0.01)  # optical depth of an opacity of 0.99, the largest that 3DGS paints
DOMINANT = 0.99  # a member with more than this share of the mass of its cell represents it
FULL_DEPTH = math.pi**2 / 6  # of an opaque Gaussian summed over an image, in units of its area


@torch.no_grad()
@checked
def merge_cells(
    scene: GaussianScene,
    partition: Partition,
    *,
    config: MergeConfig,
    clamping: bool = False,
    on_cells: Callable[[int], None] = lambda done: None,
) -> GaussianScene:
    """Merge every cell into one Gaussian.

    A cell of one member returns that member bit for bit. Other cells get the weighted mean and
    covariance of their members (both terms: spread of the means and mean of the covariances),
    the weighted mean of their SH coefficients, and an opacity. Extra float columns are averaged
    by weight; extra integer columns are taken from the heaviest member.

    Args:
        scene: The Gaussians, with valid rows.
        partition: Row numbers of every cell.
        config: Weights and opacity rule.
        clamping: Whether mean colours are raised where members have colours below zero, which
            images show as zero.
        on_cells: Called with the number of finished cells.

    Returns:
        A scene with one Gaussian per cell, in the order of the cells.

    Raises:
        InvalidArgumentError: The partition is not one of rows of this scene.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 4, sh_degree=0, seed=0)
        >>> cells = Partition.from_labels(torch.tensor([0, 0, 1, 1]), 2)
        >>> len(merge_cells(scene, cells, config=MergeConfig()))
        2
    """
    partition.check(len(scene))
    merged = scene.select(partition.order[partition.offsets[:-1]])
    cells, several = partition.select_several()
    done = len(partition) - len(cells)
    tensors, extras = merged.tensors(), dict(merged.extras)
    chunk = chunk_length(CHUNK_MEMBERS, scene.means.device)

    def merge_chunk(item: tuple[slice, Partition]) -> int:
        run, part = item
        rows, offsets, of_cells = part.order, part.offsets, cells[run]
        members = gather_members(scene, part)
        weights = members.weights(config.area_power)
        means, matrices = mean_and_covariance(members, weights)
        scales, quats = parameters.decompose_covariances(matrices)
        areas = parameters.mean_projected_area(scales)
        new = {
            "means": means,
            "quats": quats,
            "log_scales": parameters.positive_log(scales),
            "logit_opacities": parameters.logit_from_optical_depth(
                merged_depth(members, areas, rule=config.opacity, antialiased=scene.antialiased)
            ),
        }
        colors = [tensor.index_select(0, rows).double() for tensor in (scene.sh0, scene.shN)]
        new["sh0"], new["shN"] = (segment_sum(values, offsets, weights) for values in colors)
        if clamping:
            raised = segment_sum(clamped_parts(*colors), offsets, weights)
            raised = raised - clamped_parts(new["sh0"], new["shN"])
            new["sh0"], new["shN"] = new["sh0"] + raised[:, :1], new["shN"] + raised[:, 1:]
        for name, values in new.items():
            tensors[name][of_cells] = values.to(tensors[name].dtype)
        if extras:
            heaviest = rows[segment_argmax(members.opacities * members.areas, offsets)]
        for name, column in scene.extras.items():
            if column.is_floating_point():
                values = segment_sum(column[rows].double(), offsets, weights)
                extras[name][of_cells] = values.to(column.dtype)
            else:
                extras[name][of_cells] = column[heaviest]
        return len(part)

    for count in in_threads(merge_chunk, several.chunks(chunk), scene.means.device):
        done += count
        on_cells(done)
    return merged.with_tensors(tensors, extras)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Members:
    """The members of some cells, those of one cell contiguous, in float64."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]  # of unit length
    scales: Float[Tensor, "n 3"]  # standard deviations
    opacities: Float[Tensor, "n"]
    depths: Float[Tensor, "n"]  # optical depths, -log(1 - a)
    areas: Float[Tensor, "n"]  # mean projected areas
    offsets: Int[Tensor, "m_plus_1"]  # start of each cell, and the end of the last one
    cells: Int[Tensor, "n"]  # cell of every member

    def weights(self, area_power: float) -> Float[Tensor, "n"]:
        """Return opacities times areas to a power, scaled to a sum of 1 in each cell."""
        weights = self.opacities
        if area_power != 0.0:
            largest = segment_max(self.areas, self.offsets).index_select(0, self.cells)
            weights = weights * parameters.divide(self.areas, largest) ** area_power
        return normalized_weights(weights, self.offsets, self.cells)


def gather_members(scene: GaussianScene, part: Partition) -> Members:
    """Gather the members of some cells, as needed for their moments."""
    rows = part.order
    means, quats, log_scales = gather_columns(rows, scene.means, scene.quats, scene.log_scales)
    log_scales = log_scales.double()
    logits = scene.logit_opacities.index_select(0, rows).double()
    return Members(
        means=means.double(),
        quats=parameters.normalize_quats(quats.double()),
        scales=torch.exp(log_scales),
        opacities=parameters.opacity_from_logit(logits),
        depths=parameters.optical_depth_from_logit(logits),
        areas=torch.exp(parameters.log_mean_projected_area(log_scales)),
        offsets=part.offsets,
        cells=segment_ids(part.offsets, len(rows)),
    )


def normalized_weights(
    weights: Float[Tensor, "n"], offsets: Int[Tensor, "m_plus_1"], cells: Int[Tensor, "n"]
) -> Float[Tensor, "n"]:
    """Scale weights so that those of each cell sum to 1."""
    weights = weights.double()
    totals = segment_sum(weights, offsets).index_select(0, cells)
    equal = offsets.diff().double().reciprocal().index_select(0, cells)
    is_tiny = totals < torch.finfo(weights.dtype).tiny
    return torch.where(is_tiny, equal, parameters.divide(weights, totals))


def mean_and_covariance(
    members: Members, weights: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3 3"]]:
    """Compute mean and covariance of each cell as a mixture, in two passes to lose no digits."""
    offsets, cells = members.offsets, members.cells
    first = members.means.index_select(0, offsets[:-1]).T.contiguous()
    local = members.means.T - take_columns(cells, first)
    shift = segment_sum(local.T, offsets, weights).T.contiguous()
    axes = parameters.quats_to_matrices(members.quats) * members.scales[:, None, :]
    local = local - take_columns(cells, shift)
    x, y, z = local
    # Sums of products of columns; batched products of small matrices take ten times as long.
    products = torch.cat([x * local, y * local[1:], z * local[2:]])
    for axis in axes.permute(2, 1, 0):
        for row, part in enumerate(products.split([3, 2, 1])):
            part.addcmul_(axis[row], axis[row:])
    xx, xy, xz, yy, yz, zz = segment_sum(products.T, offsets, weights).unbind(1)
    matrices = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=1)
    return (first + shift).T, matrices.unflatten(1, (3, 3))


def merged_depth(
    members: Members,
    areas: Float[Tensor, "m"],
    *,
    rule: Literal["saturating", "union"],
    antialiased: bool = False,
) -> Float[Tensor, "m"]:
    """Return the optical depth of the Gaussian that stands for a cell."""
    if rule == "union":  # all members lie behind one another
        return segment_sum(members.depths, members.offsets)
    images = integrated_depth(members.depths) * members.areas
    totals = segment_sum(images, members.offsets)
    found = depth_from_integrated(parameters.divide(totals, areas)).clamp_max(OPAQUE)
    if not antialiased:
        return found
    # Under Mip-Splatting, no dilation closes gaps: the geometric mean with the depth that conserves
    # central depth times area, which is deeper where opaque members lie side by side.
    centers = segment_sum(members.depths.clamp_max(OPAQUE) * members.areas, members.offsets)
    return torch.sqrt(found * parameters.divide(centers, areas).clamp_max(OPAQUE))


def integrated_depth(depths: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the optical depth of Gaussians summed over an image, as a multiple of their area.

    The integral of ``-log(1 - a g(x))`` over the area ``2 pi sigma_1 sigma_2``: ``Li2(a)``.
    """
    others = -parameters.positive_log(parameters.opacity_from_optical_depth(depths))  # -log(a)
    small = torch.minimum(depths, others)
    square = small.square()
    series = 1 / 3600 - square * (1 / 211680 - square / 10886400)
    values = small - square / 4 + small * square * (1 / 36 - square * series)
    return torch.where(depths <= others, values, FULL_DEPTH - depths * others - values)


def depth_from_integrated(values: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the optical depth at the centre, the inverse of :func:`integrated_depth`."""
    tiny = torch.finfo(values.dtype).tiny
    values = values.clamp_max(FULL_DEPTH)
    depths = torch.maximum(values, -parameters.positive_log(1 - values / FULL_DEPTH)).clamp(
        tiny, parameters.LOGIT_LIMIT
    )
    for _ in range(6):  # Newton, from below
        slopes = depths / torch.expm1(depths)
        depths = depths + (values - integrated_depth(depths)) / slopes
        depths = depths.clamp(tiny, parameters.LOGIT_LIMIT)
    return depths


@checked
def keep_representatives(
    scene: GaussianScene, merged: GaussianScene, partition: Partition, *, areas: Float[Tensor, "n"]
) -> tuple[GaussianScene, Partition]:
    """Replace merged Gaussians by a member where members hardly touch, or one is nearly all.

    Members that lie apart (points, needles, thin haze) have moments far wider than the members
    together: the merged Gaussian is a faint veil that shows less in an image than any member. A
    member of opacity a and area A removes about ``a^2 A`` of the squared error of an image; a
    Gaussian that spreads the mass M of the cell over its area A removes ``M^2 / A``. So the member
    of largest ``a^2 A`` is kept, bit for bit, where that is more. It is also kept where it has more
    than ``DOMINANT`` of the mass: moments would hardly differ, but a very wide sky Gaussian that
    moves from behind a camera to before it covers its image as fog. Our own rules, not part of
    CVT-GS.

    Args:
        scene: The Gaussians.
        merged: One Gaussian per cell, from its moments.
        partition: Members of the cells.
        areas: Mean projected areas of all Gaussians of the scene.

    Returns:
        The scene with these members in place of their cells, and the members that each of its
        Gaussians represents: one member of such cells, all members of the others.

    Example:
        >>> from cvtgs.config import MergeConfig
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 2, sh_degree=0, seed=0)
        >>> points = scene.with_tensors({"log_scales": scene.log_scales - 9}, {})
        >>> cells = Partition.from_labels(torch.tensor([0, 0]), 1)
        >>> merged = merge_cells(points, cells, config=MergeConfig())
        >>> small, members = keep_representatives(points, merged, cells, areas=points.areas)
        >>> len(small), len(members.order)
        (1, 1)
    """
    order, offsets = partition.order, partition.offsets
    opacities = parameters.opacity_from_logit(scene.logit_opacities.index_select(0, order)).double()
    member_areas = areas.index_select(0, order)
    masses = opacities * member_areas
    best = segment_argmax(opacities * masses, offsets)
    cell_masses = segment_sum(masses, offsets)
    merged_areas = torch.exp(parameters.log_mean_projected_area(merged.log_scales.double()))
    best_masses, best_areas = masses.index_select(0, best), member_areas.index_select(0, best)
    is_kept = best_masses**2 * merged_areas > cell_masses**2 * best_areas
    is_kept |= best_masses > DOMINANT * cell_masses
    counts = partition.counts
    is_kept &= counts > 1
    number, members = torch.stack([is_kept.sum(), (counts * is_kept).sum()]).tolist()
    if number == 0:
        return merged, partition
    representatives, cells = order.index_select(0, best), true_rows(is_kept, number)
    kept = scene.select(representatives[cells])
    tensors = {
        name: values.index_copy(0, cells, getattr(kept, name))
        for name, values in merged.tensors().items()
    }
    extras = {
        name: values.index_copy(0, cells, kept.extras[name])
        for name, values in merged.extras.items()
    }
    kept_rows = torch.where(is_kept, representatives, -1)
    represented = partition.keep_only(kept_rows, len(order) - members + number)
    if partition.singles is not None:
        represented = replace(represented, singles=partition.singles + number)
    return merged.with_tensors(tensors, extras), represented
