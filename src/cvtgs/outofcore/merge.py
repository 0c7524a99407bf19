"""Turn the cells of a block into Gaussians: merge, inflate, correct, with remote neighbours."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs import cells, cvt, validity
from cvtgs.analysis import drop_unused_bands, restore_columns
from cvtgs.analysis.effects import select_columns
from cvtgs.clock import StageClock
from cvtgs.cvt.nearest import search_name
from cvtgs.devices import one_thread
from cvtgs.errors import without_warnings
from cvtgs.io import save
from cvtgs.io.axes import SCENE_AXES
from cvtgs.io.tensors import add_prefix, under_prefix
from cvtgs.mergenet import correct_cells
from cvtgs.outofcore.halo import bounding_box, halo_cells, other_blocks
from cvtgs.outofcore.job import Job, Step
from cvtgs.outofcore.rows import analysis_of, read_members, read_rows
from cvtgs.pipeline import (
    merge_members,
    moved_back,
    moved_from,
    neighbor_count,
    reduce_scene,
    shape_merged,
)
from cvtgs.progress import silent
from cvtgs.report import CellStatistics, MatchReport, RefineReport
from cvtgs.scene import GaussianScene

EXTRA = "extra/"  # prefix of extra columns in files of tensors


class BlockReport(CellStatistics):
    """Report of a block."""

    input_count: int  # Gaussians in the cells of the block
    mass_out: float  # opacity times mean projected area of the result, squared scene units
    matching: MatchReport | None = None
    refinement: RefineReport | None = None


class BlockCells(NamedTuple):
    """The Gaussians in the cells of a block; ``scene`` has only the columns that are used."""

    original: GaussianScene
    scene: GaussianScene
    visibility: Float[Tensor, "n"]
    partition: cells.Partition


@one_thread()
def merge(job: Job, block: int) -> None:
    """Merge the members of every cell of a block."""
    if job.has("merged", block):
        return
    found = read_cells(job, block)
    scene, partition, scan = found.scene, found.partition, job.read_scan()
    merged, represented = merge_members(
        moved_from(scene, scan.frame.far_origin(scene.means)),
        partition,
        job.config.merge,
        areas=scene.areas,
        clamping=scan.plan.clamping.active,
    )
    first = represented.order[represented.offsets[:-1]]
    more = {
        "sizes": represented.counts,
        "representatives": torch.where(represented.counts < partition.counts, first, -1),
        "bounds": bounding_box(merged.means),
    }
    tensors = merged.tensors() | add_prefix(EXTRA, merged.extras) | more
    job.write("merged", block, tensors)


@one_thread()
def inflate(job: Job, block: int) -> None:
    """Find the neighbours of the cells of a block, align axes and inflate."""
    if job.has("inflated", block):
        return
    own = job.read("merged", block)
    own_count = len(own["sizes"])
    net = job.read_network(own["means"].dtype)
    sees = net is not None and net.sees_surroundings
    near = neighbor_count(job.config.merge, with_network=sees)
    numbers = [other for other in job.blocks_with_cells() if other != block]
    others = other_blocks(job, "merged", "means", numbers)
    remote = halo_cells(own["means"], others, count=near)
    merged, _ = _with_halo(job, "merged", block, remote)
    neighbors = cvt.nearest_neighbors(merged.means, near)[:own_count]
    # Only the number of members per cell matters here, so their rows are left out.
    offsets = torch.nn.functional.pad(own["sizes"].cumsum(0), (1, 0))
    represented = cells.Partition(order=own["sizes"][:0], offsets=offsets)
    inflated = shape_merged(merged, represented, neighbors, job.config.merge)
    found = {
        "quats": inflated.quats[:own_count],
        "log_scales": inflated.log_scales[:own_count],
        "neighbors": neighbors,
        "remote": remote,
    }
    job.write("inflated", block, own | found)


@one_thread()
def correct(job: Job, block: int) -> None:
    """Correct the cells of a block with the network, if there is one, and write the block."""
    if job.small_path(block).exists():
        return
    original, scene, visibility, partition = read_cells(job, block)
    scan = job.read_scan()
    origin = scan.frame.far_origin(scene.means)
    own = job.read("inflated", block)
    represented = partition.keep_only(own["representatives"])
    small, sizes = _with_halo(job, "inflated", block, own["remote"])
    net = job.read_network(scene.dtype)
    if net is not None:
        small = correct_cells(
            net,
            moved_from(scene, origin),
            small,
            represented,
            neighbors=own["neighbors"],
            visibility=visibility,
            pixel_size=scan.frame.view_radius / job.config.merge.image_size,
            sizes=sizes,
        )
    tensors = {name: values[: len(own["sizes"])] for name, values in small.tensors().items()}
    small = scene.with_tensors(tensors, under_prefix(EXTRA, own))
    if origin is not None:
        small = moved_back(small, origin, original, represented)
    is_whole = job.read_manifest().total == scan.row_count
    finish = validity.with_finite_opacities if is_whole else validity.standardized
    small = restore_columns(finish(small), original, scan.plan)
    report = BlockReport(
        input_count=len(scene),
        mass_out=float(small.masses.sum()),
        single_member_cells=represented.count_singles(),
        largest_cell=int(partition.counts.amax()),
        backend=search_name(scene.device),
    )
    write_block(job, block, small, report)


@one_thread()
def simplify_block(job: Job, block: int) -> None:
    """Simplify the only block of a job like a scene in memory, and write it."""
    if job.small_path(block).exists():
        return
    rows, scan = read_rows(job, block), job.read_scan()
    scene = select_columns(rows.scene, job.config.effects)
    no_filter = {"min_opacity": 0.0, "max_flyaway_share": 0.0}  # the sort has filtered the rows
    filter_config = job.config.filter.model_copy(update=no_filter)
    reduced = reduce_scene(
        scene,
        analysis_of(scan, rows._replace(scene=scene)),
        job.targets[block],
        job.config.model_copy(update={"filter": filter_config}),
        net=job.read_network(scene.dtype),
        clock=StageClock(silent, scene.device),
    )
    report = BlockReport(
        input_count=len(rows.scene),
        mass_out=float(reduced.scene.masses.sum()),
        **reduced.statistics.model_dump(),
    )
    write_block(job, block, restore_columns(reduced.scene, rows.scene, scan.plan), report)


def read_cells(job: Job, block: int) -> BlockCells:
    """Read the Gaussians in the cells of a block."""
    rows, labels = read_members(job, block)
    used = select_columns(rows.scene, job.config.effects)
    scene = drop_unused_bands(used, job.read_scan().plan)
    partition = cells.Partition.from_labels(labels, job.targets[block])
    return BlockCells(rows.scene, scene, rows.visibility, partition)


def _with_halo(
    job: Job, step: Step, block: int, remote: Tensor
) -> tuple[GaussianScene, Int[Tensor, "k"]]:
    """Read the merged Gaussians of a block, then of its halo, and their numbers of members."""
    own = job.read(step, block)
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN", "sizes")
    parts = {name: [own[name]] for name in names}
    for other in torch.unique(remote[:, 0]).tolist():
        tensors = job.read(step, other)
        numbers = remote[remote[:, 0] == other, 1]
        for name, values in parts.items():
            values.append(tensors[name].index_select(0, numbers))
    tensors = {name: torch.cat(values) for name, values in parts.items()}
    sizes = tensors.pop("sizes")
    return GaussianScene(**tensors, extras={}, comments=(), layout=()), sizes


def read_report(job: Job, block: int) -> BlockReport:
    """Read the report of a finished block."""
    return BlockReport.model_validate_json(job.report_path(block).read_bytes())


def write_block(
    job: Job, block: int, small: GaussianScene, report: BlockReport, *, is_improved: bool = False
) -> None:
    """Write a finished block; its report comes first, since the scene file marks it as finished."""
    path = job.finished_path(block) if is_improved else job.small_path(block)
    axes = job.axes if path == job.last.finished_path(block) else SCENE_AXES
    job.write_file(job.report_path(block).name, report.model_dump_json().encode())
    with without_warnings():
        save(small, path, overwrite=True, axes=axes)
