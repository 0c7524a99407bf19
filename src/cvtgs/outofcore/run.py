"""Simplify a file block by block: in bounded memory, resumable, on one or many machines."""

import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from cvtgs.analysis import restore_columns
from cvtgs.analysis.effects import select_columns
from cvtgs.boxes import Box, listed
from cvtgs.cameras import Cameras
from cvtgs.checks import checked
from cvtgs.clock import StageClock
from cvtgs.config import SimplifyConfig
from cvtgs.counts import checked_whole, shared_out, shortfall, target_count, whole_number
from cvtgs.devices import HOST, full_precision, on_host, one_thread
from cvtgs.edit import concatenate
from cvtgs.errors import ConfigError, check_path, warn
from cvtgs.evaluation.blind_views import check_seen
from cvtgs.grouping import most_cells
from cvtgs.io import atomic_output, check_save, load, save
from cvtgs.io.axes import SCENE_AXES, checked_axes
from cvtgs.io.locks import output_lock
from cvtgs.io.ply import PlyRows, join_plys, open_rows
from cvtgs.outofcore.folders import in_folder, started
from cvtgs.outofcore.images import LEAST_CAMERAS, join_matchings, join_refinements
from cvtgs.outofcore.job import Job, Manifest
from cvtgs.outofcore.memory import (
    IMAGE_BYTES,
    cell_room,
    check_memory,
    chosen_blocks,
    joint_cells,
    memory_to_plan,
    merging_rows,
    sample_rows,
    warn_of_writing,
)
from cvtgs.outofcore.merge import read_report
from cvtgs.outofcore.rows import kept_rows
from cvtgs.outofcore.scan import CHUNK, read_chunks, read_sample
from cvtgs.outofcore.sort import sort_into_blocks
from cvtgs.outofcore.steps import run_steps
from cvtgs.prepared import check_cameras
from cvtgs.processes import Workers
from cvtgs.progress import ProgressListener, silent
from cvtgs.rendering.projection import warn_of_near_plane
from cvtgs.report import SimplifyReport, origin_of_views
from cvtgs.scene import GaussianScene
from cvtgs.simplifier import Simplifier
from cvtgs.validity import warn_of_dropped
from cvtgs.views import find_own_cameras

RANGE_ROWS, MOST_RANGES = 1 << 18, 64
"""Minimum rows of the file that one process reads in one call; maximum number of such calls."""

SAMPLED = 10_000  # number of Gaussians that tell whether cameras look at the scene


@on_host()
@checked
def simplify_file(  # noqa: PLR0913 (options by name)
    source: str | os.PathLike[str],
    output: str | os.PathLike[str],
    rho: float | None = None,
    *,
    count: int | None = None,
    max_count: int | None = None,
    memory: int | None = None,
    blocks: int | None = None,
    boxes: Sequence[Box] = (),
    sh_degree: int | None = None,
    source_axes: str | None = None,
    output_axes: str | None = None,
    simplifier: Simplifier | None = None,
    cameras: Cameras | None = None,
    workers: Workers | None = None,
    range_rows: int | None = None,
    overwrite: bool = False,
    listener: ProgressListener = silent,
) -> SimplifyReport:
    """Simplify a file that need not fit into memory.

    The file is read in parts and sorted into blocks of space, which are stored in a hidden folder
    beside the output. Each block is simplified to its exact share of the Gaussians to keep. After
    an interruption, the same call continues with the unfinished blocks. The result depends on the
    number of blocks, not on the workers or their order.

    Args:
        source: A binary PLY file.
        output: The file to write; a ``.ply`` is written without holding all of it in memory.
        rho: Ratio of Gaussians to keep, in (0, 1].
        count: Number of Gaussians to keep, instead of ``rho``.
        max_count: Maximum number of Gaussians to keep, instead of ``rho``.
        memory: Bytes that one process may use; None for all free memory.
        blocks: Number of blocks, instead of ``memory``.
        boxes: Gaussians with centres in these are kept unchanged and come first in the output.
        sh_degree: SH bands above this degree are dropped; None keeps all.
        source_axes: Directions of x, y and z in the source; None for those of PLY files.
        output_axes: Directions of x, y and z in the output; None for those of its format.
        simplifier: Configuration and network, not its listener; None for the defaults.
        cameras: Cameras for presets that render the scene; None takes those beside the source if
            it has the axes of PLY files (:func:`cvtgs.views.find_own_cameras`), or else generates
            views.
        workers: Call functions for parts of the file and for blocks; None calls them here.
        range_rows: Rows of the file that one process reads in one call; None for 260,000, or a
            64th of the file if that is more.
        overwrite: Whether an existing output may be replaced.
        listener: Called with progress events.

    Returns:
        The report, with cell statistics of all blocks and wall-clock seconds of all stages.

    Raises:
        ConfigError: The configuration cannot be used with blocks.
        InvalidArgumentError: Ratio, count or boxes cannot be met, a number is out of range, no
            given camera sees the scene, or only one does for a refinement.
        InvalidSceneError: No row is valid.
        FileFormatError: The file cannot be read in parts.
        OutputExistsError: The output exists and may not be replaced.
        OutputBusyError: Another run is writing this output.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from cvtgs import save, synthetic
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "scene.ply"
        ...     save(synthetic.scene("object", 2000, sh_degree=0), file)
        ...     report = simplify_file(file, Path(folder) / "small.ply", 0.01, blocks=3)
        >>> report.output_count, report.blocks
        (20, 3)
    """
    simplifier = simplifier or Simplifier(device="cpu")
    workers = workers or map
    check_config(simplifier.config)
    check_cameras(cameras, simplifier.config)
    check_save(output, overwrite=overwrite)
    check_path(source)
    rows = open_rows(source, sh_degree=sh_degree, axes=source_axes)
    target = target_count(rows.count, rho, count=count, max_count=max_count)
    check_memory(memory, with_images=simplifier.config.uses_images)
    if range_rows is None:
        range_rows = rows_per_range(rows.count)
    range_rows = checked_whole(range_rows, "range_rows")
    memory = None if memory is None else whole_number(memory)
    room = memory or memory_to_plan()
    if not is_plain_ply(output):
        warn_of_writing(output, rows, target=target, memory=room, workers=workers)
    if simplifier.config.uses_images:
        room -= IMAGE_BYTES
        refines = simplifier.config.refine.enabled
        cameras = _cameras_to_fit(cameras, rows, source, axes=source_axes, refines=refines)
    allocation = simplifier.config.allocation
    merging = merging_rows(target, rows.count, allocation)
    job = Job(
        folder="",
        source=rows,
        target=target,
        blocks=chosen_blocks(rows, room, wanted=blocks, most=target, merging=merging),
        boxes=tuple(listed(boxes, Box, required="boxes must be of type Box")),
        config=simplifier.config,
        has_network=simplifier.checkpoint is not None,
        range_rows=range_rows,
        sample_rows=sample_rows(room, rows),
        cell_room=min(cell_room(memory), most_cells(target, rows.count, allocation)),
        axes=(
            SCENE_AXES
            if output_axes is None or not is_plain_ply(output)
            else checked_axes(output_axes)
        ),
        cameras=cameras if simplifier.config.uses_images else None,
    )
    job = in_folder(job, output, simplifier.checkpoint, adapts=blocks is None)
    clock = StageClock(listener, HOST)
    with output_lock(output), full_precision():
        resumes = job.can_resume()
        with started(job, workers, clock, simplifier.checkpoint, resumes=resumes):
            if not resumes:
                with one_thread():
                    manifest = _scan_and_sort(job, workers, clock)
                job.write_file("manifest.json", manifest.to_json().encode())
        energies, resumed = run_steps(job, workers, clock)
        job, is_complete = job.last, False
        try:
            with clock.stage("assemble"):
                assemble_blocks(job, output, axes=output_axes, overwrite=overwrite)
                is_complete = True
            checkpoint = "none" if simplifier.checkpoint is None else simplifier.checkpoint.name
            return report_blocks(job, checkpoint, clock, energies=energies, resumed=resumed)
        finally:
            if is_complete:  # also if the listener raises at the last event
                job.remove()


def _cameras_to_fit(
    given: Cameras | None,
    rows: PlyRows,
    source: str | os.PathLike[str],
    *,
    axes: str | None,
    refines: bool,
) -> Cameras | None:
    """Return the given cameras, which must show the scene, or those beside the source."""
    if given is None and axes not in (None, SCENE_AXES):
        return None
    sample = read_sample(rows, SAMPLED)
    if given is not None:
        check_seen(sample, given, name="the scene", parts=read_chunks(rows), refines=refines)
        return given
    own = find_own_cameras(sample, source)
    if own is None:
        return None
    warn_of_near_plane(sample, own.cameras.singles(), name="the scene")
    return own.cameras


def rows_per_range(count: int) -> int:
    """Choose how many rows one process reads in one call, in whole chunks."""
    return max(RANGE_ROWS, CHUNK * math.ceil(count / MOST_RANGES / CHUNK))


def check_config(config: SimplifyConfig, *, with_images: bool = True) -> None:
    """Raise if a configuration cannot be applied block by block."""
    if not with_images and config.uses_images:
        raise ConfigError(
            "streams in blocks need a preset without images of the scene (draft, fast, standard, "
            f"paper) and no refinement; found {config.preset!r} with {config.visibility.views} "
            f"views and {config.refine.steps} steps of refinement."
        )
    if config.refine.seconds:  # every run would give other bits
        raise ConfigError(
            "blocks are refined for a number of steps (--refine-steps, refine.steps), not "
            f"of seconds; found {config.refine.seconds:g} s."
        )


def _scan_and_sort(job: Job, workers: Workers, clock: StageClock) -> Manifest:
    """Scan the file and sort its rows into blocks; return the manifest."""
    found = sort_into_blocks(job, workers, clock)
    total = sum(found.rows)
    finer = joint_cells(found.rest, total, job.cell_room, job.config.allocation)
    if finer < sum(1 for count in found.rows if count):  # the heaviest get one each
        order = sorted(range(job.blocks), key=lambda block: -found.cells[block])
        cells = [int(block in order[:finer]) for block in range(job.blocks)]
    else:
        cells = shared_out(finer, found.cells, rooms=found.rows)
    return Manifest(
        grouped=total, total=found.rest, cells=tuple(cells), left_out_mass=found.left_out_mass
    )


def assemble_blocks(
    job: Job, output: str | os.PathLike[str], *, axes: str | None, overwrite: bool
) -> None:
    """Write the protected rows and then all blocks."""
    blocks = [job.finished_path(block) for block in job.blocks_with_cells()]
    if not is_plain_ply(output):
        scene = concatenate([*_kept_scenes(job), *map(load, blocks)])
        save(scene, output, overwrite=overwrite, axes=axes)
        return
    kept = []
    for number, scene in enumerate(_kept_scenes(job)):
        kept.append(job.path("unchanged", number, suffix=".ply"))
        save(scene, kept[-1], overwrite=True, axes=job.axes)
    with atomic_output(output, overwrite=overwrite) as file:
        join_plys([*kept, *blocks], file)


def is_plain_ply(output: str | os.PathLike[str]) -> bool:
    """Return whether an output is an uncompressed PLY, into which rows are copied unchanged."""
    name = Path(output).name.lower()
    return name.endswith(".ply") and not name.endswith(".compressed.ply")


def _kept_scenes(job: Job) -> Iterator[GaussianScene]:
    """Yield the protected rows, with the columns of blocks."""
    plan = job.read_scan().plan
    for rows in kept_rows(job):
        scene = job.source.scene(rows)
        yield restore_columns(select_columns(scene, job.config.effects), scene, plan)


def report_blocks(
    job: Job, checkpoint: str, clock: StageClock, *, energies: tuple[float, ...], resumed: int
) -> SimplifyReport:
    """Add up the reports of all blocks."""
    scan, with_cells = job.read_scan(), job.blocks_with_cells()
    reports = [read_report(job, block) for block in with_cells]
    if job.cameras is not None and (job.config.match.enabled or job.config.refine.enabled):
        left = sum(report.matching is None and report.refinement is None for report in reports)
        if left:
            warn(
                f"{left} of {len(reports)} blocks are shown by fewer than {LEAST_CAMERAS} cameras, "
                f"so they were not matched to images or refined; what no camera shows has fewer "
                f"Gaussians than with presets without images."
            )
    matchings = [report.matching for report in reports if report.matching is not None]
    refinements = [report.refinement for report in reports if report.refinement is not None]
    total, valid = job.source.count, scan.row_count + scan.kept_count
    if valid < total:
        warn_of_dropped(total - valid, total, scan.invalid_rows)
    tessellated = job.blocks_with_rows() if job.goes_by_steps else []
    parts = [job.read("parts", block) for block in tessellated]
    kept_mass = sum(float(job.source.scene(rows).masses.sum()) for rows in kept_rows(job))
    renders = job.config.uses_renders or bool(refinements)
    return SimplifyReport(
        input_count=total,
        output_count=min(job.target, valid),
        target_count=job.target,
        rho=job.target / total,
        invalid_rows=scan.invalid_rows,
        invalid_count=total - valid,
        shortfall=shortfall(valid, total, job.target),
        filtered_count=scan.row_count - sum(report.input_count for report in reports),
        filtered_mass_share=job.read_manifest().left_out_mass / (scan.mass or 1.0),
        kept_count=scan.kept_count,
        single_member_cells=sum(report.single_member_cells for report in reports),
        largest_cell=max((report.largest_cell for report in reports), default=0),
        refilled_cells=sum(report.refilled_cells for report in reports)
        + sum(int(part["refilled"]) for part in parts),
        mass_in=scan.mass,
        mass_out=math.fsum([kept_mass, *(report.mass_out for report in reports)]),
        energies=energies or (reports[0].energies if reports else ()),
        energy=math.fsum(
            [report.energy for report in reports] + [float(part["energy"]) for part in parts]
        ),
        backend=reports[0].backend if reports else "none",
        checkpoint=checkpoint,
        plan=scan.plan,
        views=origin_of_views(job.cameras) if renders else "none",
        stages=tuple(clock.costs),
        matching=join_matchings(matchings) if matchings else None,
        refinement=join_refinements(refinements) if refinements else None,
        blocks=job.blocks,
        resumed_blocks=resumed,
        config=job.config,
    )
