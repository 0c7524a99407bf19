"""Grouping of Gaussians into cells: a tessellation, then allocation by merge costs."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs import cells, cvt
from cvtgs.analysis import EffectPlan, SceneAnalysis
from cvtgs.config import AllocationConfig, SimplifyConfig
from cvtgs.counts import checked_whole
from cvtgs.cvt.nearest import search_device
from cvtgs.devices import move_together
from cvtgs.filters import filter_rows
from cvtgs.math.frames import RobustFrame, morton_order
from cvtgs.math.segments import segment_ids
from cvtgs.scene import GaussianScene

MEMBERS_PER_CELL = 4  # if cells would have fewer Gaussians on average, the tessellation is skipped
REASSIGN = 7  # number of neighbouring cells that a Gaussian may move to
COLOR_CELLS = 10_000  # the number of cells at which ``cvt.color`` applies unchanged

FULL_RELIEF = 0.1  # ratio of cells to Gaussians from which on ``far_relief`` applies unchanged
FULL_GAIN = 0.4  # strength of the effect unbounded from which on ``far_gain`` applies unchanged
NEAR = 6  # number of neighbouring cells whose errors count, by half, for a cell
SMALL_ERROR = 0.02  # share of the mean error that is added to those of all cells
LARGEST_FACTOR = 12.0  # limit of the factors on masses, and of their inverse


class WeightedRows(NamedTuple):
    """Gaussians to group, in the order of the Morton curve.

    Attributes:
        scene: The Gaussians.
        rows: ``(k,)`` rows of the scene.
        weights: ``(k,)`` weights in the tessellation.
        masses: ``(k,)`` masses, the weights in the moments of a cell.
        apparent_masses: ``(k,)`` apparent masses, which scale the costs of merging.
        moments: Moments of each Gaussian; None if not computed yet.
        neighbors: Gaussians that each may merge with; None if not computed yet.
    """

    scene: GaussianScene
    rows: Int[Tensor, "k"]
    weights: Float[Tensor, "k"]
    masses: Float[Tensor, "k"]
    apparent_masses: Float[Tensor, "k"]
    moments: cells.Moments | None = None
    neighbors: Int[Tensor, "k j"] | None = None


class OrderedRows(NamedTuple):
    """The part of grouping that does not depend on the number of cells.

    Attributes:
        filtered: ``(k,)`` rows that passed the filter.
        points: The same rows in Morton order, with their moments.
    """

    filtered: Int[Tensor, "k"]
    points: WeightedRows


def weigh_rows(
    scene: GaussianScene,
    rows: Int[Tensor, "k"],
    analysis: SceneAnalysis,
    config: SimplifyConfig,
    *,
    ordered: OrderedRows | None = None,
) -> WeightedRows:
    """Sort Gaussians along the Morton curve, and compute their weights, unless they are ordered."""
    if ordered is not None and torch.equal(ordered.filtered, rows):
        return ordered.points
    # Advanced indexing (`values[rows]`) takes three to five times as long as `index_select`.
    opacities = analysis.opacities.index_select(0, rows)
    masses = analysis.apparent_areas.index_select(0, rows) * opacities
    order = curve_order(scene, rows, analysis.frame, masses=masses)
    rows, masses = rows.index_select(0, order), masses.index_select(0, order)
    opacities = opacities.index_select(0, order)
    weights = cvt.tessellation_weights(
        opacities,
        analysis.apparent_areas.index_select(0, rows),
        area_power=config.cvt.area_power,
        floor=config.cvt.weight_floor,
    )
    return WeightedRows(
        scene=scene,
        rows=rows,
        weights=weights,
        masses=analysis.areas.index_select(0, rows) * opacities,
        apparent_masses=masses,
    )


def factors_by_errors(
    means: Float[Tensor, "m 3"],
    *,
    errors: Float[Tensor, "m"],
    pixels: Float[Tensor, "m"],
    power: float,
) -> Float[Tensor, "m"]:
    """Return factors of cells on the masses of their members in the costs of merging.

    They are larger where ``errors``, squared ones, of cells that show in ``pixels`` are larger.
    """
    near = cvt.nearest_neighbors(means, NEAR)
    errors = errors.nan_to_num(0.0, 0.0, 0.0)  # images of extreme scenes overflow
    errors = errors + 0.5 * errors[near].sum(dim=1)  # also caused by what a cell does not cover
    logs = (errors + SMALL_ERROR * errors.mean()).clamp_min(1e-300).log()
    seen = pixels.double() / (pixels + 1.0)  # near 0 for cells that images hardly show
    logs = logs - (seen * logs).sum() / seen.sum().clamp_min(1e-300)
    return (power * seen * logs).exp().clamp(1.0 / LARGEST_FACTOR, LARGEST_FACTOR)


def factors_of_members(
    factors: Float[Tensor, "m"], partition: cells.Partition, count: int
) -> Float[Tensor, "n"]:
    """Return the factors of the cells of ``count`` Gaussians; 1 for those in no cell."""
    found = factors.new_ones(count)
    found[partition.order] = factors[segment_ids(partition.offsets, len(partition.order))]
    return found


def tessellate_rows(
    points: WeightedRows,
    analysis: SceneAnalysis,
    target: int,
    config: SimplifyConfig,
    *,
    on_iteration: Callable[[int], None] = lambda done: None,
) -> cvt.Tessellation:
    """Tessellate Gaussians into cells, more than ``target`` if pairs of cells will merge.

    ``on_iteration`` is called with the number of finished Lloyd iterations.
    """
    scene, rows = points.scene, points.rows
    target = checked_whole(target, "target", most=len(rows), things="Gaussians")
    count = finer_count(target, len(rows), config.allocation)
    if count == len(rows):  # every Gaussian is its own cell, so the space does not matter
        space = scene.means.index_select(0, rows)
    else:
        space = embed_rows(scene, rows, target, config, frame=analysis.frame, plan=analysis.plan)
    return cvt.tessellate(
        space,
        points.weights,
        count,
        config=config.cvt,
        seed=config.seed,
        has_duplicates=analysis.plan.duplicates.active,
        on_iteration=on_iteration,
    )


def allocate(
    points: WeightedRows,
    tessellation: cvt.Tessellation,
    analysis: SceneAnalysis,
    target: int,
    config: AllocationConfig,
) -> Int[Tensor, "k"]:
    """Merge cells in pairs down to the target count, and move members to the cell that fits best.

    No cell is empty, before and after; cell ``i`` is Gaussian ``i`` if there are as many.
    """
    labels, count = tessellation.labels, len(tessellation.sites)
    is_own = count == len(labels)
    if count == target and (is_own or not config.reassign):
        return labels
    members = points.moments or row_moments(points, analysis, config)
    config = allocation_at(target / len(labels), config, unbounded=analysis.plan.unbounded.strength)
    groups = members if is_own else cells.group_moments(members, labels, count)
    merged = torch.arange(count, device=labels.device)
    if count > target:
        groups = cells.Moments(*move_together(groups, search_device(labels.device)))
        neighbors = points.neighbors if is_own else None
        if neighbors is None:
            neighbors = cvt.nearest_neighbors(groups.means.T, config.neighbors)
        area = float(points.apparent_masses.double().sum()) / analysis.frame.radius**2
        merged = cells.merge_pairs(groups, neighbors, target, config, area=area)
        groups = cells.group_moments(groups, merged, target)
    if not config.reassign:
        return merged.to(labels.device).index_select(0, labels)
    near = cvt.nearest_neighbors(groups.means.T, REASSIGN)
    merged, near, *moments = move_together([merged, near, *groups], labels.device)
    labels = merged.index_select(0, labels)
    return cells.reassign(members, labels, cells.Moments(*moments), near, config)


def collect_cells(points: WeightedRows, labels: Int[Tensor, "k"], target: int) -> cells.Partition:
    """Collect the Gaussians of the full scene that make up every cell, none of them empty."""
    local = cells.Partition.from_labels(labels, target)
    return replace(local, order=points.rows.index_select(0, local.order))


def row_moments(
    points: WeightedRows, analysis: SceneAnalysis, config: AllocationConfig
) -> cells.Moments:
    """Compute the moments of each Gaussian, in robust radii."""
    components = None
    if config.compares_view_colors:
        components = cells.view_components(points.scene, points.rows, points.apparent_masses)
    return cells.gaussian_moments(
        points.scene,
        points.rows,
        analysis.frame,
        masses=points.masses,
        apparent_masses=points.apparent_masses,
        components=components,
    )


def finer_count(target: int, available: int, config: AllocationConfig) -> int:
    """Return the number of cells of the tessellation, before pairs of cells merge."""
    if config.oversampling == 1.0:
        return target
    count = math.ceil(config.oversampling * target)
    # Merging starts from single Gaussians if cells would have few members.
    return available if count * MEMBERS_PER_CELL > available else count


def most_cells(target: int, total: int, config: AllocationConfig) -> int:
    """Return the largest possible :func:`finer_count`, whatever the filter leaves of a scene."""
    return min(total, MEMBERS_PER_CELL * math.ceil(config.oversampling * target))


def allocation_at(ratio: float, config: AllocationConfig, *, unbounded: float) -> AllocationConfig:
    """Return the weights of the costs at a ratio, and a strength of the effect unbounded."""
    update = {
        "color": config.color * ratio**config.color_power,
        "far_relief": config.far_relief * min(1.0, ratio / FULL_RELIEF),
        "far_gain": config.far_gain ** min(1.0, unbounded / FULL_GAIN),
    }
    return config.model_copy(update=update)


def curve_order(
    scene: GaussianScene, rows: Int[Tensor, "k"], frame: RobustFrame, *, masses: Float[Tensor, "k"]
) -> Int[Tensor, "k"]:
    """Return the order of Gaussians along a Morton curve, ties by mass."""
    # Contracted, so that flyaways do not coarsen the curve near the middle.
    points = cvt.embed(scene.means.index_select(0, rows), frame=frame, contraction=1.0)
    return morton_order(points, ties=masses)


def embed_rows(
    scene: GaussianScene,
    rows: Int[Tensor, "k"],
    target: int,
    config: SimplifyConfig,
    *,
    frame: RobustFrame,
    plan: EffectPlan,
) -> Float[Tensor, "k d"]:
    """Embed Gaussians in the space of the tessellation; colour counts more with fewer cells."""
    return cvt.embed(
        scene.means.index_select(0, rows),
        scene.sh0.index_select(0, rows),
        frame=frame,
        contraction=plan.unbounded.strength,
        color=config.cvt.color * (target / COLOR_CELLS) ** config.cvt.color_power,
    )


def order_rows(
    scene: GaussianScene, analysis: SceneAnalysis, config: SimplifyConfig
) -> OrderedRows:
    """Compute the part of grouping that does not depend on the number of cells, for reuse.

    :func:`weigh_rows` uses it only if the filter leaves enough rows for its target; otherwise the
    filter brings some rows back, and this part is computed again. At most 256 bytes per Gaussian.
    """
    rows = filter_rows(scene, analysis, 1, config.filter).rows
    points = weigh_rows(scene, rows, analysis, config)
    moments = row_moments(points, analysis, config.allocation)
    return OrderedRows(rows, points._replace(moments=moments))


def add_neighbors(ordered: OrderedRows, target: int, config: AllocationConfig) -> OrderedRows:
    """Add the neighbours of single Gaussians, 48 bytes each, if merging starts from these."""
    points, total = ordered.points, len(ordered.filtered)
    from_singles = target < total and finer_count(target, total, config) == total
    if not from_singles or points.neighbors is not None or points.moments is None:
        return ordered
    means = points.moments.means
    near = cvt.nearest_neighbors(means.T.to(search_device(means.device)), config.neighbors)
    return ordered._replace(points=points._replace(neighbors=near))
