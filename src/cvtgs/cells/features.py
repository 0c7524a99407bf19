"""Compute descriptors, relative to a cell's position, rotation, size and colour.

The values of one feature are contiguous in memory: sums of products over three components are then
limited by memory bandwidth only, and many times as fast as products of small matrices.
"""

import math
from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cells.descriptors import AREA_SCALE, LEAST_PIXELS, PIXEL_SCALE, Descriptors
from cvtgs.cells.inflate import project_on_axes, side_cover
from cvtgs.cells.partition import Partition, SampledMembers, sample_members
from cvtgs.checks import checked
from cvtgs.math import parameters
from cvtgs.math.segments import gather_columns, segment_ids, segment_max, segment_sum
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.scene import GaussianScene

LARGEST_DISTANCE = 50.0  # distances in features are clamped to this, in standard deviations
LARGEST_POSITION, LARGEST_LOG = 1e4, 80.0  # so that no product of them overflows float32
LARGEST_CONTRAST = 1.0  # of black and white: larger ones, rare in training, make cells grow


class ActivatedGaussians(NamedTuple):
    """Some Gaussians, activated, in the dtype of the scene."""

    means: Tensor
    rotations: Tensor
    log_scales: Tensor
    log_areas: Tensor
    logits: Tensor
    opacities: Tensor
    colors: Tensor


class RelativeGaussians(NamedTuple):
    """Gaussians, each in the frame and the standard deviations of a merged Gaussian."""

    shifts: Tensor
    positions: Tensor
    extents: Tensor
    log_areas: Tensor
    contrasts: Tensor


class NeighborContext(NamedTuple):
    """Some merged Gaussians, the cover of both ends of their axes, and their neighbours."""

    merged: ActivatedGaussians
    cover: Tensor
    cover_difference: Tensor  # that of the negative end minus that of the positive one
    pairs: Tensor
    positions: Tensor

    def cut(self, run: slice) -> Self:
        """Keep some consecutive cells."""
        merged = ActivatedGaussians(*(values[run] for values in self.merged))
        return type(self)(merged, *(values[run] for values in self[1:]))


class CellTotals(NamedTuple):
    """Totals over the members of every cell; means are weighted by mass."""

    counts: Tensor
    contrasts: Tensor
    visibility: Tensor
    visibility_gradients: Tensor
    depths: Tensor
    extents: Tensor


@checked
def describe_cells(
    scene: GaussianScene,
    merged: GaussianScene,
    part: Partition,
    *,
    cells: Int[Tensor, "m"],
    neighbors: Int[Tensor, "m k"],
    sizes: Int[Tensor, "m_all"],
    visibility: Float[Tensor, "n_all"],
    pixel_size: float,
) -> Descriptors:
    """Compute the descriptors of some cells.

    As in CVT-GS, a member has its position, size and orientation relative to its cell, opacity,
    share of the mass, and colour relative to the cell. Unlike there, orientation is given as
    extents along the axes of the cell (several quaternions describe the same one), colour as a
    distance only; cells also have features of their neighbours and of the sides that these cover,
    and members their ambient visibility. Large cells are described by a sample of their members.

    Memory: about ``1.5 kB`` per described member and per pair of a cell and a neighbour.

    Args:
        scene: The Gaussians.
        merged: One Gaussian per cell, for all cells.
        part: Members of the cells to describe.
        cells: Row numbers of these cells in ``merged``.
        neighbors: The nearest other cells of each of these cells.
        sizes: Number of members of every cell, for all cells.
        visibility: Ambient visibility of every Gaussian of the scene, 0 to 1
            (:func:`cvtgs.analysis.ambient_visibility`).
        pixel_size: Size of a pixel in the middle of the scene, scene units.

    Returns:
        The descriptors, in the dtype of the scene.

    Example:
        >>> from cvtgs.cells import merge_cells
        >>> from cvtgs.config import MergeConfig
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 5, sh_degree=0, seed=0)
        >>> part = Partition.from_labels(torch.tensor([0, 0, 0, 1, 1]), 2)
        >>> found = describe_cells(
        ...     scene, merge_cells(scene, part, config=MergeConfig()), part,
        ...     cells=torch.arange(2), neighbors=torch.tensor([[1], [0]]), sizes=part.counts,
        ...     visibility=torch.ones(5), pixel_size=0.01,
        ... )
        >>> tuple(found.members.shape), tuple(found.pairs.shape), tuple(found.cells.shape)
        ((5, 19), (2, 1, 18), (2, 21))
    """
    context = neighbor_context(merged, cells=cells, neighbors=neighbors, sizes=sizes)
    return describe_members(
        scene, part, context=context, visibility=visibility, pixel_size=pixel_size
    )


def neighbor_context(
    scene: GaussianScene,
    *,
    cells: Int[Tensor, "m"],
    neighbors: Int[Tensor, "m k"],
    sizes: Int[Tensor, "m_all"],
) -> NeighborContext:
    """Compute features of the neighbours of some merged Gaussians; memory: ``1 kB`` for each."""
    others, shape = neighbors.flatten(), neighbors.shape
    ids = torch.arange(len(cells), device=cells.device).repeat_interleave(shape[1])
    merged, other = _activate(scene, cells), _activate(scene, others)
    cover = side_cover(scene, cells, neighbors).to(merged.means.dtype)
    difference = cover[:, :, 1] - cover[:, :, 0]
    relative = _relate(merged, ids, other)
    positions = relative.positions
    back = _local_positions(other.rotations, other.log_scales, relative.shifts)
    crowding = sizes[others].to(positions.dtype) / sizes[cells][ids].to(positions.dtype)
    sides = difference.T.contiguous().index_select(1, ids).T
    uncovered = 0.5 * sides * (positions / (1 + positions.abs()))
    pairs = _columns(
        torch.log1p(positions.abs().clamp_max(LARGEST_DISTANCE)),
        _distance(positions),
        0.3 * relative.extents,
        uncovered,
        uncovered.sum(dim=1),
        _distance(back),
        other.opacities,
        AREA_SCALE * relative.log_areas,
        0.2 * torch.log(crowding),
        3 * relative.contrasts,
        other.opacities * _density(back),
        _density(positions),
    )
    return NeighborContext(
        merged, cover, difference, pairs.unflatten(0, shape), positions.unflatten(0, shape)
    )


def describe_members(
    scene: GaussianScene,
    part: Partition,
    *,
    context: NeighborContext,
    visibility: Float[Tensor, "n_all"],
    pixel_size: float,
) -> Descriptors:
    """Compute the descriptors of some cells like :func:`describe_cells`, from a known context."""
    sampled = sample_members(scene, part)
    offsets, rows = sampled.part.offsets, sampled.part.order
    ids = segment_ids(offsets, len(rows))
    members = _activate(scene, rows)
    relative = _relate(context.merged, ids, members)
    visible = visibility.index_select(0, rows).to(members.means.dtype)
    log_masses = members.log_areas + parameters.positive_log(members.opacities)
    log_masses = log_masses - torch.log(sampled.rates)
    masses = torch.exp(log_masses - segment_max(log_masses, offsets).index_select(0, ids))
    weights = masses / _sum(masses, offsets).index_select(0, ids)
    if len(rows) < len(part.order):
        # Estimates that agree with known totals are calibrated (Deville and Sarndal 1992): the mean
        # of a sample becomes that of all members, the centre of the cell. Otherwise the choice of
        # the sample would move, turn and recolour the cell.
        means = _sum(weights[:, None] * relative.positions, offsets)
        means = torch.where((sampled.counts > offsets.diff())[:, None], means, 0.0)
        positions = relative.positions - means.index_select(0, ids)
        relative = relative._replace(positions=positions)
    totals = _total(members, relative, weights, visible, sampled=sampled, ids=ids)
    sides = torch.cat([context.cover_difference.T, totals.visibility_gradients.T])
    sides = sides.index_select(1, ids)
    counts, contrasts, mean_visible = torch.stack(totals[:3]).index_select(1, ids)
    positions = relative.positions
    uncovered = 0.5 * sides[:3].T * positions.clamp(-4, 4)
    inverse = sampled.rates.reciprocal()
    shares = inverse / _sum(inverse, offsets).index_select(0, ids)
    features = _columns(
        torch.log1p(positions.abs().clamp_max(LARGEST_DISTANCE)),
        _distance(positions),
        0.3 * relative.extents,
        uncovered,
        uncovered.sum(dim=1),
        0.3 * parameters.positive_log(weights * sampled.rates * counts).clamp(-14, 14),
        members.opacities,
        AREA_SCALE * relative.log_areas,
        3 * relative.contrasts,
        0.5 * relative.contrasts / (contrasts + 0.02),
        visible,
        3 * (visible - mean_visible),
        (sides[3:].T * positions).sum(dim=1).clamp(-3, 3),
    )
    return Descriptors(
        members=features,
        pairs=context.pairs,
        cells=_cell_features(context, totals, antialiased=scene.antialiased, pixel_size=pixel_size),
        weights=weights,
        shares=shares,
        rows=rows,
        offsets=offsets,
        positions=positions.clamp(-LARGEST_DISTANCE, LARGEST_DISTANCE),
        pair_positions=context.positions.clamp(-LARGEST_DISTANCE, LARGEST_DISTANCE),
    )


def _activate(scene: GaussianScene, rows: Int[Tensor, "r"]) -> ActivatedGaussians:
    means, quats, log_scales, colors = gather_columns(
        rows, scene.means, scene.quats, scene.log_scales, scene.sh0[:, 0]
    )
    logits = parameters.clamp_logits(scene.logit_opacities.index_select(0, rows))
    return ActivatedGaussians(
        means=means,
        rotations=parameters.rotation_matrices(quats),
        log_scales=log_scales,
        log_areas=parameters.log_mean_projected_area(log_scales),
        logits=logits,
        opacities=torch.sigmoid(logits),
        colors=colors * SH_C0,
    )


def _relate(
    merged: ActivatedGaussians, ids: Int[Tensor, "n"], others: ActivatedGaussians
) -> RelativeGaussians:
    """Express each Gaussian in the frame of the merged Gaussian given by ``ids``."""
    rotations = merged.rotations.permute(1, 2, 0).flatten(0, 1)
    columns = [merged.means.T, rotations, merged.log_scales.T, merged.colors.T]
    table = torch.cat([*columns, merged.log_areas[None]]).index_select(1, ids)
    means, log_scales, colors = table[:3].T, table[12:15].T, table[15:18].T
    rotations = table[3:12].unflatten(0, (3, 3)).permute(2, 0, 1)
    shifts = others.means - means
    largest = others.log_scales.amax(dim=1, keepdim=True)
    scales = torch.exp(others.log_scales - largest)
    x, y, z = (project_on_axes(rotations, others.rotations) * scales[:, None, :]).unbind(-1)
    squares = x.square().addcmul_(y, y).addcmul_(z, z)
    extents = 0.5 * parameters.positive_log(squares) + largest - log_scales
    contrasts = (others.colors - colors).square().mean(dim=1).sqrt()
    return RelativeGaussians(
        shifts=shifts,
        positions=_local_positions(rotations, log_scales, shifts),
        extents=extents.clamp(-9, 9),
        log_areas=(others.log_areas - table[18]).clamp(-14, 14),
        contrasts=contrasts.clamp_max(LARGEST_CONTRAST),
    )


def _local_positions(rotations: Tensor, log_scales: Tensor, shifts: Tensor) -> Tensor:
    """Express each shift in a frame, in units of its standard deviations."""
    turned = project_on_axes(rotations, shifts[:, :, None])[:, :, 0]
    units = torch.exp((-log_scales).clamp(-LARGEST_LOG, LARGEST_LOG))
    return (turned * units).clamp(-LARGEST_POSITION, LARGEST_POSITION)


def _total(
    members: ActivatedGaussians,
    relative: RelativeGaussians,
    weights: Float[Tensor, "n"],
    visible: Float[Tensor, "n"],
    *,
    sampled: SampledMembers,
    ids: Int[Tensor, "n"],
) -> CellTotals:
    """Sum over the members of every cell."""
    offsets, rates = sampled.part.offsets, sampled.rates
    depths = parameters.optical_depth_from_logit(members.logits) * torch.exp(relative.log_areas)
    columns = _columns(
        weights * relative.contrasts.square(),
        weights * visible,
        depths / rates,
        weights[:, None] * torch.exp(2 * relative.extents).clamp_max(4.0),
    )
    totals = _sum(columns, offsets)
    squares, mean_visible, cell_depths = totals[:, :3].unbind(1)
    lean = weights * (visible - mean_visible.index_select(0, ids))
    return CellTotals(
        counts=sampled.counts.to(weights.dtype),
        contrasts=squares.sqrt(),
        visibility=mean_visible,
        visibility_gradients=_sum(lean[:, None] * relative.positions, offsets),
        depths=cell_depths,
        extents=totals[:, 3:],
    )


def _cell_features(
    context: NeighborContext, totals: CellTotals, *, antialiased: bool, pixel_size: float
) -> Float[Tensor, "m c"]:
    """Return cover, inner extent, count, opacity, depth, shape, contrast, visibility of cells.

    The last two are the tag mip and the size in pixels: dilation closes gaps only without the tag.
    """
    merged, log_scales = context.merged, context.merged.log_scales
    distances = context.positions.square().sum(dim=2).sqrt()
    nearest = torch.nn.functional.pad(distances, (0, 1), value=LARGEST_DISTANCE).amin(dim=1)
    return _columns(
        context.cover.amin(dim=2),
        context.cover.amax(dim=2),
        totals.extents,
        0.2 * torch.log(totals.counts),
        torch.sigmoid(merged.logits),  # for these cells only: rounding depends on the length
        0.2 * merged.logits,
        0.3 * parameters.positive_log(totals.depths).clamp(-14, 14),
        0.5 * (log_scales[:, 0] - log_scales[:, 1]).clamp(-8, 8),
        0.3 * (log_scales[:, 1] - log_scales[:, 2]).clamp(-8, 8),
        5 * totals.contrasts,
        totals.visibility,
        torch.linalg.vector_norm(totals.visibility_gradients, dim=1).clamp_max(3.0),
        torch.log1p(nearest),
        torch.full_like(nearest, float(antialiased)),
        PIXEL_SCALE * (log_scales.mean(dim=1) - math.log(pixel_size)).clamp(LEAST_PIXELS - 1, 12),
    )


def _sum(values: Tensor, offsets: Tensor) -> Tensor:
    """Sum over the members of every cell, in float64."""
    return segment_sum(values.double(), offsets).to(values.dtype)


def _columns(*features: Tensor) -> Tensor:
    """Join features of one or several columns each; the result is column-major in memory."""
    return torch.cat(list(map(torch.atleast_2d, map(torch.t, features)))).T


def _distance(positions: Tensor) -> Tensor:
    """Return compressed distances."""
    return torch.log1p(positions.square().sum(dim=1).sqrt().clamp_max(LARGEST_DISTANCE))


def _density(positions: Tensor) -> Tensor:
    """Return the unnormalised density of a Gaussian; positions are in its standard deviations."""
    return torch.exp(-0.5 * positions.square().sum(dim=1).clamp_max(60.0))
