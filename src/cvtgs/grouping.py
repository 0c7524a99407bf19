"""Grouping: which Gaussians become one, by a tessellation and what merging its cells costs."""

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
from cvtgs.math.frames import RobustFrame, morton_order
from cvtgs.math.segments import label_sums
from cvtgs.scene import GaussianScene

MEMBERS_PER_CELL = 4
"""A tessellation whose cells would have fewer Gaussians on average is left out."""

REASSIGN = 7
"""Cells around its own that a Gaussian may move to."""

COLOR_CELLS = 10_000
"""The number of cells that ``cvt.color`` is meant for."""


class Grouping(NamedTuple):
    """Which Gaussians form which cell, and how good the tessellation is.

    Attributes:
        partition: Rows of the scene that make up every cell.
        weights: ``(m,)`` summed weights of the members of every cell.
        refilled: Cells that were empty after Lloyd and took a Gaussian from another.
        energies: Energy before every Lloyd iteration, over the Gaussians that Lloyd samples.
        energy: Energy of the final cells, over all Gaussians.
        backend: Name of the nearest-site search.
    """

    partition: cells.Partition
    weights: Float[Tensor, "m"]
    refilled: int
    energies: tuple[float, ...]
    energy: float
    backend: str


class WeightedRows(NamedTuple):
    """Gaussians to group, in the order of the Morton curve.

    Attributes:
        scene: The Gaussians.
        rows: ``(k,)`` which of them.
        weights: ``(k,)`` what each weighs in the tessellation.
        masses: ``(k,)`` what each weighs in the moments of its cell.
        apparent_masses: ``(k,)`` mass as images show it, by which merging costs.
        moments: Moments of each; None if they are not known yet.
        neighbors: Gaussians that each may merge with; None if they are not known yet.
    """

    scene: GaussianScene
    rows: Int[Tensor, "k"]
    weights: Float[Tensor, "k"]
    masses: Float[Tensor, "k"]
    apparent_masses: Float[Tensor, "k"]
    moments: cells.Moments | None = None
    neighbors: Int[Tensor, "k j"] | None = None


class OrderedRows(NamedTuple):
    """What grouping computes of Gaussians whatever the number of cells.

    Attributes:
        filtered: ``(k,)`` the rows as the filter left them.
        points: The same along the Morton curve, with their moments.
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
    """Group Gaussians into cells: tessellate, merge cheap pairs of cells, move what fits others.

    Args:
        scene: The Gaussians.
        rows: Which of them, after the filter.
        analysis: Frame, apparent areas and effect plan.
        target: Number of cells, at most k.
        config: The tessellation (``config.cvt``), what follows it (``config.allocation``), and
            the seed.
        ordered: What was computed of the same rows before; ignored if the rows are others.
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
        has_duplicates=analysis.plan.duplicates.active,
        on_iteration=on_iteration,
    )
    sums = label_sums([points.weights], labels, target)[:, 0]
    return _grouping(tessellation, points.rows, labels, sums)


def _weighted(
    scene: GaussianScene, rows: Int[Tensor, "k"], analysis: SceneAnalysis, config: SimplifyConfig
) -> WeightedRows:
    """Bring Gaussians into the order of the curve, and weigh them."""
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


def _moments(points: WeightedRows, analysis: SceneAnalysis) -> cells.Moments:
    """Compute the moments of each, in robust radii."""
    return cells.gaussian_moments(
        points.scene,
        points.rows,
        analysis.frame,
        weights=points.masses,
        masses=points.apparent_masses,
    )


def _tessellate(
    points: WeightedRows,
    analysis: SceneAnalysis,
    target: int,
    config: SimplifyConfig,
    *,
    total: int,
    has_duplicates: bool,
    on_iteration: Callable[[int], None],
) -> tuple[cvt.Tessellation, Int[Tensor, "k"]]:
    """Tessellate Gaussians in the order of the curve, and allocate the cells; return both.

    ``total`` is the number of Gaussians that all cells hold.
    """
    scene, rows = points.scene, points.rows
    count = finer_count(target, len(rows), config.allocation)
    if count == len(rows):  # each is a cell of its own, in any space
        space = scene.means.index_select(0, rows)
    else:
        space = embed_rows(scene, rows, analysis, target, config)
    tessellation = cvt.tessellate(
        space,
        points.weights,
        count,
        config=config.cvt,
        seed=config.seed,
        has_duplicates=has_duplicates,
        on_iteration=on_iteration,
    )
    labels, allocation = tessellation.labels, config.allocation
    if count > target or (allocation.reassign and count < len(rows)):
        labels = allocate(
            points.moments or _moments(points, analysis),
            labels,
            count,
            target,
            allocation_at(target / total, allocation),
            neighbors=points.neighbors if count == len(rows) else None,
        )
    return tessellation, labels


def finer_count(target: int, available: int, config: AllocationConfig) -> int:
    """Return how many cells the tessellation makes, from which pairs merge.

    Where its cells would have few members, pairs merge from single Gaussians: all that are there.
    """
    if config.oversampling == 1.0:
        return target
    count = math.ceil(config.oversampling * target)
    return available if count * MEMBERS_PER_CELL > available else count


def allocation_at(ratio: float, config: AllocationConfig) -> AllocationConfig:
    """Return the configuration with the weight of colour for a ratio of cells to Gaussians."""
    return config.model_copy(update={"color": config.color * ratio**config.color_power})


def allocate(
    members: cells.Moments,
    labels: Int[Tensor, "n"],
    count: int,
    target: int,
    config: AllocationConfig,
    *,
    neighbors: Int[Tensor, "n k"] | None = None,
) -> Int[Tensor, "n"]:
    """Merge cells in pairs until the target is met, and move members to the cell that fits.

    Args:
        members: Moments of what is grouped.
        labels: Cell of each; none is empty. As many cells as members are numbered as they are.
        count: Number of cells.
        target: Number of cells to leave.
        config: Costs.
        neighbors: Neighbours of the cells; None finds them.

    Returns:
        The new cell of each member; none is empty.
    """
    groups = members if count == len(labels) else cells.group_moments(members, labels, count)
    if count > target:
        groups = groups.to(torch.device("cpu"))  # many small steps
        if neighbors is None:
            neighbors = cvt.nearest_neighbors(groups.means.T, config.neighbors)
        merged = cells.merge_pairs(groups, neighbors, target, config)
        labels = merged.to(labels.device).index_select(0, labels)
        groups = cells.group_moments(groups, merged, target)
    if not config.reassign or target == len(labels):
        return labels
    near = cvt.nearest_neighbors(groups.means.T, REASSIGN).to(labels.device)
    return cells.reassign(members, labels, groups.to(labels.device), near, config)


def group_cells(
    merged: GaussianScene,
    grouping: Grouping,
    analysis: SceneAnalysis,
    target: int,
    config: SimplifyConfig,
    *,
    on_iteration: Callable[[int], None] = lambda done: None,
) -> Grouping:
    """Group the cells of a finer size into coarser ones, so that levels are nested.

    Args:
        merged: The merged Gaussians of the finer size.
        grouping: The cells of the finer size.
        analysis: Frame and effect plan of the scene.
        target: Number of cells, at most that of the finer size.
        config: As for :func:`group_rows`.
        on_iteration: Called with the number of finished Lloyd iterations.

    Returns:
        Cells that consist of whole finer cells; members are Gaussians of the scene.
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
        has_duplicates=False,
        on_iteration=on_iteration,
    )
    coarse = torch.empty_like(labels)
    coarse[rows] = labels
    partition = grouping.partition
    of_rows = torch.repeat_interleave(coarse, partition.counts)
    sums = label_sums([grouping.weights], coarse, target)[:, 0]
    return _grouping(tessellation, partition.order, of_rows, sums)


def _grouping(
    tessellation: cvt.Tessellation, rows: Tensor, labels: Tensor, weights: Tensor
) -> Grouping:
    """Return the cells of labelled rows, with their weights."""
    local = cells.Partition.from_labels(labels, len(weights))
    return Grouping(
        partition=replace(local, order=rows.index_select(0, local.order)),
        weights=weights,
        refilled=tessellation.refilled,
        energies=tessellation.energies,
        energy=tessellation.energy,
        backend=tessellation.backend,
    )


def curve_order(
    scene: GaussianScene,
    rows: Int[Tensor, "k"],
    frame: RobustFrame,
    *,
    masses: Float[Tensor, "k"],
) -> Int[Tensor, "k"]:
    """Return the order of Gaussians along a Morton curve, ties by mass.

    The curve runs through contracted space: it stays fine where the bulk is, whatever flies away.
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
    scene: GaussianScene,
    rows: Int[Tensor, "k"],
    analysis: SceneAnalysis,
    config: SimplifyConfig,
) -> OrderedRows:
    """Compute what does not depend on the number of cells, to group the same Gaussians again.

    Args:
        scene: The Gaussians.
        rows: Which of them, after the filter.
        analysis: Frame, apparent areas and effect plan.
        config: Weights.

    Returns:
        What :func:`group_rows` takes; 152 bytes per Gaussian.
    """
    points = _weighted(scene, rows, analysis, config)
    return OrderedRows(rows, points._replace(moments=_moments(points, analysis)))


def add_neighbors(ordered: OrderedRows, target: int, config: AllocationConfig) -> OrderedRows:
    """Find the neighbours of single Gaussians, if pairs of them are to merge.

    Args:
        ordered: What was computed of them before.
        target: Number of cells.
        config: How many neighbours each has.

    Returns:
        The same with neighbours, 48 bytes per Gaussian; itself if they are there or of no use.
    """
    points, total = ordered.points, len(ordered.filtered)
    if points.neighbors is not None or points.moments is None:
        return ordered
    if target >= total or finer_count(target, total, config) < total:
        return ordered
    near = cvt.nearest_neighbors(points.moments.means.T, config.neighbors)
    return ordered._replace(points=points._replace(neighbors=near))
