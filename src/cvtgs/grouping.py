"""Grouping of Gaussians into cells: a tessellation, then allocation by merge costs."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs import cells, cvt
from cvtgs.analysis import SceneAnalysis
from cvtgs.config import AllocationConfig, SimplifyConfig
from cvtgs.devices import HOST, move_together
from cvtgs.filters import filter_rows
from cvtgs.math.frames import RobustFrame, morton_order
from cvtgs.math.segments import label_sums
from cvtgs.scene import GaussianScene

MEMBERS_PER_CELL = 4
"""If cells would have fewer Gaussians on average, the tessellation is skipped."""

REASSIGN = 7
"""Number of neighbouring cells that a Gaussian may move to."""

COLOR_CELLS = 10_000
"""The number of cells at which ``cvt.color`` applies unchanged."""

FULL_RELIEF = 0.1
"""Ratio of cells to Gaussians from which on ``allocation.far_relief`` applies unchanged."""


class Grouping(NamedTuple):
    """The cells, and the quality of the tessellation.

    Attributes:
        partition: Rows of the scene that make up every cell.
        weights: ``(m,)`` summed weights of the members of every cell.
        refilled: Number of cells that were empty after Lloyd and took a Gaussian from another.
        energies: Energy before every Lloyd iteration, over the Gaussians that Lloyd samples.
        energy: Energy of the final cells, over all Gaussians.
    """

    partition: cells.Partition
    weights: Float[Tensor, "m"]
    refilled: int
    energies: tuple[float, ...]
    energy: float


class WeightedRows(NamedTuple):
    """Gaussians to group, in the order of the Morton curve.

    Attributes:
        scene: The Gaussians.
        rows: ``(k,)`` rows of the scene.
        weights: ``(k,)`` weights in the tessellation.
        masses: ``(k,)`` weights in the moments of a cell.
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


def group_rows(
    scene: GaussianScene,
    rows: Int[Tensor, "k"],
    analysis: SceneAnalysis,
    target: int,
    config: SimplifyConfig,
    *,
    ordered: OrderedRows | None = None,
    on_iteration: Callable[[int], None] = lambda done: None,
) -> Grouping:
    """Group Gaussians into cells: tessellate, merge cheap pairs of cells, reassign members.

    Args:
        scene: The Gaussians.
        rows: Rows that passed the filter.
        analysis: Frame, apparent areas and effect plan.
        target: Number of cells, at most k.
        config: The configuration; ``cvt``, ``allocation`` and ``seed`` are used.
        ordered: Cached result of :func:`order_rows`; ignored if its rows differ.
        on_iteration: Called with the number of finished Lloyd iterations.

    Returns:
        The cells.
    """
    if ordered is not None and torch.equal(ordered.filtered, rows):
        points = ordered.points
    else:
        points = _weighted(scene, rows, analysis, config)
    tessellation, labels = _tessellate(
        points,
        analysis,
        target,
        config,
        total=len(rows),
        on_iteration=on_iteration,
    )
    sums = label_sums([points.weights], labels, target)[0]
    return _grouping(tessellation, points.rows, labels, sums)


def _weighted(
    scene: GaussianScene, rows: Int[Tensor, "k"], analysis: SceneAnalysis, config: SimplifyConfig
) -> WeightedRows:
    """Sort Gaussians along the Morton curve, and compute their weights."""
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


def _moments(
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
        weights=points.masses,
        masses=points.apparent_masses,
        components=components,
    )


def _tessellate(
    points: WeightedRows,
    analysis: SceneAnalysis,
    target: int,
    config: SimplifyConfig,
    *,
    total: int,
    on_iteration: Callable[[int], None],
) -> tuple[cvt.Tessellation, Int[Tensor, "k"]]:
    """Tessellate Gaussians in Morton order, allocate cells, and return tessellation and labels.

    ``total`` is the number of Gaussians of the scene in all cells.
    """
    scene, rows = points.scene, points.rows
    count = finer_count(target, len(rows), config.allocation)
    if count == len(rows):  # every Gaussian is its own cell, so the space does not matter
        space = scene.means.index_select(0, rows)
    else:
        space = embed_rows(scene, rows, analysis, target, config)
    tessellation = cvt.tessellate(
        space,
        points.weights,
        count,
        config=config.cvt,
        seed=config.seed,
        has_duplicates=analysis.plan.duplicates.active,
        on_iteration=on_iteration,
    )
    labels = tessellation.labels
    if count > target or (config.allocation.reassign and count < len(rows)):
        labels = allocate(
            points.moments or _moments(points, analysis, config.allocation),
            labels,
            count,
            target,
            allocation_at(target / total, config.allocation),
            neighbors=points.neighbors if count == len(rows) else None,
        )
    return tessellation, labels


def finer_count(target: int, available: int, config: AllocationConfig) -> int:
    """Return the number of cells of the tessellation, before pairs of cells merge.

    If its cells would have few members, merging starts from single Gaussians, all ``available``.
    """
    if config.oversampling == 1.0:
        return target
    count = math.ceil(config.oversampling * target)
    return available if count * MEMBERS_PER_CELL > available else count


def allocation_at(ratio: float, config: AllocationConfig) -> AllocationConfig:
    """Return the weights of the costs at a ratio of cells to Gaussians."""
    color = config.color * ratio**config.color_power
    relief = config.far_relief * min(1.0, ratio / FULL_RELIEF)
    return config.model_copy(update={"color": color, "far_relief": relief})


def allocate(
    members: cells.Moments,
    labels: Int[Tensor, "n"],
    count: int,
    target: int,
    config: AllocationConfig,
    *,
    neighbors: Int[Tensor, "n k"] | None = None,
) -> Int[Tensor, "n"]:
    """Merge cells in pairs down to the target count, and move members to the cell that fits best.

    Args:
        members: Moments of the members.
        labels: Cell of each member, none empty; ``i`` of member ``i`` if there is one for each.
        count: Number of cells.
        target: Target number of cells.
        config: Weights of the costs.
        neighbors: Neighbours of the cells; None computes them.

    Returns:
        The new cell of each member; no cell is empty.
    """
    groups = members if count == len(labels) else cells.group_moments(members, labels, count)
    if count > target:
        groups = cells.Moments(*move_together(groups, HOST))  # many small steps
        if neighbors is None:
            neighbors = cvt.nearest_neighbors(groups.means.T, config.neighbors)
        merged = cells.merge_pairs(groups, neighbors, target, config)
        groups = cells.group_moments(groups, merged, target)
    else:
        merged = torch.arange(count, device=labels.device)
    if not config.reassign or target == len(labels):
        return labels if count == target else merged.to(labels.device).index_select(0, labels)
    near = cvt.nearest_neighbors(groups.means.T, REASSIGN)
    merged, near, *moments = move_together([merged, near, *groups], labels.device)
    labels = merged.index_select(0, labels)
    return cells.reassign(members, labels, cells.Moments(*moments), near, config)


def group_cells(
    merged: GaussianScene,
    grouping: Grouping,
    analysis: SceneAnalysis,
    target: int,
    config: SimplifyConfig,
    *,
    on_iteration: Callable[[int], None] = lambda done: None,
) -> Grouping:
    """Group the cells of a finer level into coarser ones, so that levels are nested.

    Args:
        merged: The merged Gaussians of the finer level.
        grouping: The cells of the finer level.
        analysis: Frame and effect plan of the scene.
        target: Number of cells, at most that of the finer level.
        config: As for :func:`group_rows`.
        on_iteration: Called with the number of finished Lloyd iterations.

    Returns:
        Cells that consist of whole finer cells; their members are Gaussians of the scene.
    """
    fine = torch.arange(len(merged), device=merged.device)
    masses = grouping.weights * merged.opacities
    rows = curve_order(merged, fine, analysis.frame, masses=masses)
    weights = grouping.weights[rows]
    points = WeightedRows(
        scene=merged,
        rows=rows,
        weights=weights,
        masses=merged.masses[rows],
        apparent_masses=weights,
    )
    tessellation, labels = _tessellate(
        points,
        analysis,
        target,
        config,
        total=len(grouping.partition.order),
        on_iteration=on_iteration,
    )
    coarse = torch.empty_like(labels)
    coarse[rows] = labels
    partition = grouping.partition
    of_rows = torch.repeat_interleave(coarse, partition.counts)
    sums = label_sums([grouping.weights], coarse, target)[0]
    return _grouping(tessellation, partition.order, of_rows, sums)


def _grouping(
    tessellation: cvt.Tessellation, rows: Tensor, labels: Tensor, weights: Tensor
) -> Grouping:
    """Return the grouping of labelled rows, given the weights of the cells."""
    local = cells.Partition.from_labels(labels, len(weights))
    return Grouping(
        partition=replace(local, order=rows.index_select(0, local.order)),
        weights=weights,
        refilled=tessellation.refilled,
        energies=tessellation.energies,
        energy=tessellation.energy,
    )


def curve_order(
    scene: GaussianScene,
    rows: Int[Tensor, "k"],
    frame: RobustFrame,
    *,
    masses: Float[Tensor, "k"],
) -> Int[Tensor, "k"]:
    """Return the order of Gaussians along a Morton curve, ties by mass.

    The curve runs through contracted space, so that flyaways do not coarsen it near the middle.
    """
    points = cvt.embed(scene.means.index_select(0, rows), frame=frame, contraction=1.0)
    return morton_order(points, ties=masses)


def embed_rows(
    scene: GaussianScene,
    rows: Int[Tensor, "k"],
    analysis: SceneAnalysis,
    target: int,
    config: SimplifyConfig,
) -> Float[Tensor, "k d"]:
    """Embed Gaussians in the space of the tessellation; colour counts more with fewer cells."""
    return cvt.embed(
        scene.means.index_select(0, rows),
        scene.sh0.index_select(0, rows),
        frame=analysis.frame,
        contraction=analysis.plan.unbounded.strength,
        color=config.cvt.color * (target / COLOR_CELLS) ** config.cvt.color_power,
    )


def order_rows(
    scene: GaussianScene, analysis: SceneAnalysis, config: SimplifyConfig
) -> OrderedRows:
    """Compute the part of grouping that does not depend on the number of cells, for reuse.

    :func:`group_rows` uses it only if the filter leaves enough rows for its target; otherwise the
    filter brings some rows back, and this part is computed again.

    Args:
        scene: The Gaussians.
        analysis: Frame, apparent areas and effect plan.
        config: Filter and weights.

    Returns:
        The argument ``ordered`` of :func:`group_rows`; at most 256 bytes per Gaussian.
    """
    rows = filter_rows(scene, analysis, 1, config.filter).rows
    points = _weighted(scene, rows, analysis, config)
    return OrderedRows(rows, points._replace(moments=_moments(points, analysis, config.allocation)))


def add_neighbors(ordered: OrderedRows, target: int, config: AllocationConfig) -> OrderedRows:
    """Add the neighbours of single Gaussians, if merging starts from single Gaussians.

    Args:
        ordered: The result of :func:`order_rows`.
        target: Number of cells.
        config: Number of neighbours.

    Returns:
        The same with neighbours, 48 bytes per Gaussian; unchanged if it has them or needs none.
    """
    points, total = ordered.points, len(ordered.filtered)
    from_singles = target < total and finer_count(target, total, config) == total
    if not from_singles or points.neighbors is not None or points.moments is None:
        return ordered
    near = cvt.nearest_neighbors(points.moments.means.T, config.neighbors)
    return ordered._replace(points=points._replace(neighbors=near))
