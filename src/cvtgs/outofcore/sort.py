"""Sort a file into blocks: the first pass scans it, the second writes the rows of every block."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from cvtgs import validity
from cvtgs.analysis import frame_of
from cvtgs.boxes import check_room
from cvtgs.clock import StageClock
from cvtgs.errors import InvalidArgumentError, InvalidSceneError
from cvtgs.grouping import finer_count
from cvtgs.outofcore.attempts import SortedFile
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.rows import sort_range
from cvtgs.outofcore.scan import (
    RowRange,
    SceneScan,
    add_totals,
    read_sample,
    scan_range,
    scan_scene,
)
from cvtgs.outofcore.visibility import write_views
from cvtgs.outofcore.workers import Workers, with_progress


class SortedBlocks(NamedTuple):
    """The blocks after all rows are sorted into them.

    Attributes:
        rest: Number of Gaussians that all blocks keep together.
        rows: Number of Gaussians in each block.
        cells: Weight of each block, in cells; a Gaussian counts at most 1.
        left_out_mass: Mass that the filter leaves out, squared scene units.
    """

    rest: int
    rows: list[int]
    cells: list[float]
    left_out_mass: float


def sort_into_blocks(
    job: Job, workers: Workers, clock: StageClock, *, keep_all: bool = False
) -> SortedBlocks:
    """Scan the file and sort its rows into blocks; ``keep_all`` turns the filter off."""
    ranges = job.ranges()
    with clock.stage("scan", len(ranges)) as advance:
        rest, scan = _scan(job, workers, ranges, advance)
    unfiltered = replace(scan, min_opacity=0.0, max_flyaway_mass=-1.0)
    with clock.stage("sort", len(ranges)) as advance:
        job.write_scan(unfiltered if keep_all else scan)
        found = _sort(job, rest, workers, ranges, advance)
        if sum(found.rows) < rest:  # the filter was too strict for so large a target
            job.write_scan(unfiltered)
            found = _sort(job, rest, workers, ranges, advance)
    return found


def _scan(
    job: Job, workers: Workers, ranges: Sequence[RowRange], advance: Callable[[int], None]
) -> tuple[int, SceneScan]:
    """Return the number of Gaussians that all blocks keep, and the scan of the scene.

    The sample is freed on return.
    """
    sample = read_sample(job.source, job.sample_rows)
    if len(sample) == 0:
        raise InvalidSceneError(f"{job.source.path}: found no valid Gaussian.")
    validity.warn_of_lost_digits(sample)
    frame = frame_of(sample.means, sample.opacities)
    scan_rows = partial(scan_range, job.source, frame, job.boxes)
    totals = add_totals(with_progress(workers(scan_rows, ranges), advance))
    valid, kept = totals.valid_count, totals.kept_count
    check_room(kept, target=job.target, total=valid)
    if kept == valid:
        raise InvalidArgumentError(
            f"all {kept:,} valid Gaussians are protected, so there is nothing to simplify."
        )
    if job.config.uses_renders:
        write_views(job, sample, total=valid)
    rest = min(job.target, valid) - kept
    scan = scan_scene(
        sample,
        totals,
        boxes=job.boxes,
        target=max(1, rest),
        cell_count=finer_count(max(1, rest), valid - kept, job.config.allocation),
        blocks=job.blocks,
        config=job.config,
        frame=frame,
    )
    return rest, scan


def _sort(
    job: Job,
    rest: int,
    workers: Workers,
    ranges: Sequence[RowRange],
    advance: Callable[[int], None],
) -> SortedBlocks:
    """Sort all rows into blocks."""
    rows, cells, files = [0] * job.blocks, [0.0] * job.blocks, list[SortedFile]()
    left_out_mass = 0.0
    for part in with_progress(workers(partial(sort_range, job), ranges), advance):
        rows = [a + b for a, b in zip(rows, part.rows, strict=True)]
        for chunk in part.cells:  # in order: the same bits for any division into ranges
            cells = [a + b for a, b in zip(cells, chunk, strict=True)]
        for mass in part.left_out:
            left_out_mass += mass
        files += part.files
    job.adopt(files)
    return SortedBlocks(rest, rows, cells, left_out_mass)
