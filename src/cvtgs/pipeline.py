"""The stages of the method in order: filter, weigh, tessellate, allocate, merge, correct.

Single runs, levels and protected regions call :func:`reduce_scene`. Out-of-core runs of several
blocks call the functions of each stage in the same order, block by block (``outofcore/run.py``).
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs import cells, cvt
from cvtgs.analysis import SceneAnalysis, drop_unused_bands, restore_columns
from cvtgs.clock import StageClock
from cvtgs.config import MergeConfig, SimplifyConfig
from cvtgs.cvt.nearest import search_name
from cvtgs.devices import chunk_length
from cvtgs.filters import filter_rows
from cvtgs.grouping import OrderedRows, allocate, collect_cells, tessellate_rows, weigh_rows
from cvtgs.math.segments import label_sums, segment_ids
from cvtgs.mergenet import Net, correct_cells
from cvtgs.report import CellStatistics, MatchReport, rms_error
from cvtgs.scene import GaussianScene
from cvtgs.validity import standardized, with_finite_opacities

__all__ = ["Merged", "Reduced", "group_and_merge", "merge_and_inflate", "reduce_scene"]

NEIGHBORS = 8
"""Number of neighbouring cells that may cover the ends of a cell, and that the network sees."""

CHUNK = 1 << 18  # Gaussians per chunk of distances, to bound memory


class Merged(NamedTuple):
    """One Gaussian per cell, not yet corrected by the network.

    Attributes:
        scene: The merged Gaussians, in the order of the cells.
        partition: Members that each merged Gaussian stands for; one if it is a representative.
        neighbors: ``(m, k)`` nearest other cells; k is 0 if neither inflation nor a network needs
            them.
    """

    scene: GaussianScene
    partition: cells.Partition
    neighbors: Int[Tensor, "m k"]


class Reduced(NamedTuple):
    """A small scene before it is reported.

    Attributes:
        scene: The small scene.
        statistics: Statistics of the filter and the cells, for the report.
        partition: Rows of the scene that make up every cell; None if all Gaussians are kept.
        matching: Report of the matching to images; None if there was none.
    """

    scene: GaussianScene
    statistics: CellStatistics = CellStatistics()
    partition: cells.Partition | None = None
    matching: MatchReport | None = None


def reduce_scene(  # noqa: PLR0913 (options by name)
    scene: GaussianScene,
    analysis: SceneAnalysis,
    target: int,
    config: SimplifyConfig,
    *,
    net: Net | None,
    clock: StageClock,
    total: int = 0,
    ordered: OrderedRows | None = None,
    importance: Float[Tensor, "n"] | None = None,
) -> Reduced:
    """Run the stages after the analysis: filter, weigh, tessellate, allocate, merge, correct.

    Args:
        scene: The Gaussians, on the device to compute on; all rows must be valid.
        analysis: Their analysis.
        target: Number of Gaussians to keep.
        config: The configuration.
        net: Network that corrects merged Gaussians, on the same device; None for no correction.
        clock: Measures each stage.
        total: Number of Gaussians before invalid rows were dropped.
        ordered: Result of :func:`cvtgs.grouping.order_rows` for the scene; None computes it.
        importance: Factors on the apparent masses in the costs of merging; None for none.

    Returns:
        The small scene, with its cells. If all Gaussians are kept, they have finite opacities, and
        are standardized if the target is below ``total``.
    """
    if target >= len(scene.means):
        singles = CellStatistics(single_member_cells=len(scene), largest_cell=1)
        kept = standardized(scene) if target < total else with_finite_opacities(scene)
        return Reduced(kept, singles)
    used = drop_unused_bands(scene, analysis.plan)
    origin = analysis.frame.far_origin(used.means)
    merged, partition, statistics = group_and_merge(
        used,
        analysis,
        target,
        config,
        with_network=net is not None and net.sees_surroundings,
        clock=clock,
        ordered=ordered,
        importance=importance,
        origin=origin,
    )
    small = merged.scene
    if net is not None:
        with clock.stage("network", target) as advance:
            small = correct_cells(
                net,
                moved_from(used, origin),
                small,
                merged.partition,
                neighbors=merged.neighbors,
                visibility=analysis.visibility,
                pixel_size=analysis.frame.view_radius / config.merge.image_size,
                on_cells=advance,
            )
    if origin is not None:
        small = moved_back(small, origin, scene, merged.partition)
    return Reduced(
        restore_columns(standardized(small), scene, analysis.plan), statistics, partition
    )


def moved_from(scene: GaussianScene, origin: Float[Tensor, "3"] | None) -> GaussianScene:
    """Subtract an origin from positions, so that merging does not round those of float32."""
    return scene if origin is None else scene.with_tensors(means=scene.means - origin)


def moved_back(
    small: GaussianScene,
    origin: Float[Tensor, "3"],
    scene: GaussianScene,
    represented: cells.Partition,
) -> GaussianScene:
    """Move the results of cells back, those of a single member to its very position."""
    rows = represented.order[represented.offsets[:-1]]
    is_single = (represented.counts == 1)[:, None]
    return small.with_tensors(means=torch.where(is_single, scene.means[rows], small.means + origin))


def group_and_merge(  # noqa: PLR0913 (options by name)
    scene: GaussianScene,
    analysis: SceneAnalysis,
    target: int,
    config: SimplifyConfig,
    *,
    with_network: bool,
    clock: StageClock,
    ordered: OrderedRows | None = None,
    importance: Float[Tensor, "n"] | None = None,
    origin: Float[Tensor, "3"] | None = None,
) -> tuple[Merged, cells.Partition, CellStatistics]:
    """Run the stages before the network: filter, weigh, tessellate, allocate, merge.

    Args:
        scene: The Gaussians, without bands that the plan drops; more than ``target`` of them.
        analysis: Their analysis.
        target: Number of Gaussians to keep.
        config: The configuration.
        with_network: Whether a network needs the neighbours.
        clock: Measures each stage.
        ordered: As for :func:`reduce_scene`.
        importance: As for :func:`reduce_scene`.
        origin: Point that is subtracted from positions before cells merge; None for none.

    Returns:
        One Gaussian per cell, the rows that make up every cell, and statistics.
    """
    with clock.stage("filter"):
        rows, left_out, left_out_mass_share = filter_rows(scene, analysis, target, config.filter)
    with clock.stage("weigh"):
        points = weigh_rows(scene, rows, analysis, config, ordered=ordered)
        if importance is not None:
            masses = points.apparent_masses * importance.index_select(0, points.rows)
            points = points._replace(apparent_masses=masses, moments=None)
    del rows  # frees memory
    with clock.stage("tessellate", config.cvt.iterations + 1) as advance:
        tessellation = tessellate_rows(points, analysis, target, config, on_iteration=advance)
    with clock.stage("allocate"):
        labels = allocate(points, tessellation, analysis, target, config.allocation)
        partition = collect_cells(points, labels, target)
    refilled, energies, energy = tessellation.refilled, tessellation.energies, tessellation.energy
    del points, labels, tessellation
    with clock.stage("merge", target) as advance:
        merged = merge_and_inflate(
            moved_from(scene, origin),
            partition,
            config.merge,
            areas=analysis.areas,
            clamping=analysis.plan.clamping.active,
            with_network=with_network,
            on_cells=advance,
        )
    statistics = CellStatistics(
        filtered_count=left_out,
        filtered_mass_share=left_out_mass_share,
        single_member_cells=merged.partition.count_singles(),
        largest_cell=int(partition.counts.amax()),
        refilled_cells=refilled,
        energies=energies,
        energy=energy,
        backend=search_name(scene.device),
    )
    return merged, partition, statistics


def merge_and_inflate(
    scene: GaussianScene,
    partition: cells.Partition,
    config: MergeConfig,
    *,
    areas: Float[Tensor, "n"],
    clamping: bool,
    with_network: bool,
    on_cells: Callable[[int], None] = lambda done: None,
) -> Merged:
    """Merge every cell into one Gaussian, align its axes, and inflate it if it must cover its cell.

    Args:
        scene: The Gaussians.
        partition: Rows of every cell.
        config: Settings of the merge.
        areas: Mean projected areas of the Gaussians.
        clamping: Whether merged colours make up for members with colours below zero.
        with_network: Whether a network needs the neighbours.
        on_cells: Called with the number of finished cells.

    Returns:
        One Gaussian per cell.
    """
    merged, represented = merge_members(
        scene, partition, config, areas=areas, clamping=clamping, on_cells=on_cells
    )
    near = neighbor_count(config, with_network=with_network)
    neighbors = cvt.nearest_neighbors(merged.means, near)
    return Merged(shape_merged(merged, represented, neighbors, config), represented, neighbors)


def merge_members(
    scene: GaussianScene,
    partition: cells.Partition,
    config: MergeConfig,
    *,
    areas: Float[Tensor, "n"],
    clamping: bool,
    on_cells: Callable[[int], None] = lambda done: None,
) -> tuple[GaussianScene, cells.Partition]:
    """Merge every cell by its members alone; also return the members each result stands for."""
    merged = cells.merge_cells(
        scene, partition, config=config, clamping=clamping, on_cells=on_cells
    )
    if not config.representatives:
        return merged, partition
    return cells.keep_representatives(scene, merged, partition, areas=areas)


def neighbor_count(config: MergeConfig, *, with_network: bool) -> int:
    """Return how many neighbours inflation or a network needs; 0 if neither needs any."""
    inflates = config.inflation > 0.0 or config.covered_inflation > 0.0
    return NEIGHBORS if inflates or with_network else 0


def shape_merged(
    merged: GaussianScene,
    represented: cells.Partition,
    neighbors: Int[Tensor, "m k"],
    config: MergeConfig,
) -> GaussianScene:
    """Align axes and inflate; merged Gaussians beyond the partition only serve as neighbours."""
    if config.align_axes:
        merged = cells.align_axes(merged, represented, neighbors)
    if config.inflation == 0.0 and config.covered_inflation == 0.0:
        return merged
    return cells.inflate_cells(
        merged,
        represented,
        neighbors,
        everywhere=config.inflation,
        covered=config.covered_inflation,
    )


def level_facts(
    scene: GaussianScene,
    analysis: SceneAnalysis,
    reduced: Reduced,
    *,
    is_valid: Bool[Tensor, "n"] | None = None,
) -> tuple[float, Int[Tensor, "n"] | None, Float[Tensor, "2 m"] | None]:
    """Return error, assignment and error sums of a level, as in :class:`cvtgs.Level`, on the CPU.

    ``is_valid`` says which input rows the scene has; None if it has all of them.
    """
    partition = reduced.partition
    if partition is None and is_valid is None:
        return 0.0, None, None
    error, sums = 0.0, None
    if partition is None:
        labels = torch.arange(len(scene), dtype=torch.int32, device=scene.device)
    else:
        masses = analysis.apparent_areas * analysis.opacities
        sums = error_sums(scene, reduced.scene, partition, masses=masses).cpu()
        error = rms_error(sums)
        labels = partition.labels(len(scene))
    if is_valid is not None:
        of_valid, labels = labels, labels.new_full((len(is_valid),), -1)
        labels[is_valid] = of_valid
    return error, labels.cpu(), sums


def error_sums(
    scene: GaussianScene,
    small: GaussianScene,
    partition: cells.Partition,
    *,
    masses: Float[Tensor, "n"],
) -> Float[Tensor, "2 m"]:
    """Sum the masses that each small Gaussian replaces, and mass times squared distance."""
    sums = torch.zeros(2, len(small), dtype=torch.float64, device=scene.device)
    ids = segment_ids(partition.offsets, len(partition.order))
    chunk = chunk_length(CHUNK, scene.device)
    for rows, cell in zip(partition.order.split(chunk), ids.split(chunk), strict=True):
        shifts = scene.means[rows].double() - small.means[cell].double()
        weights = masses[rows].double()
        first, last = cell[[0, -1]].tolist()
        columns = [weights, weights * shifts.square().sum(dim=1)]
        sums[:, first : last + 1] += label_sums(columns, cell - first, last - first + 1)
    return sums
