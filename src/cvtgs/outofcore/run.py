"""Simplify a file block by block: in bounded memory, resumable, on one machine or on many."""

import math
import os
import shutil
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cvtgs.boxes import Box
from cvtgs.clock import StageClock
from cvtgs.config import SimplifyConfig
from cvtgs.counts import shared_out, shortfall, target_count
from cvtgs.devices import one_thread
from cvtgs.errors import (
    ConfigError,
    DroppedDataWarning,
)
from cvtgs.grouping import finer_count
from cvtgs.io import atomic_output, check_save, load, save
from cvtgs.io.locks import output_lock
from cvtgs.io.ply import join_plys, open_rows
from cvtgs.io.tensors import map_tensors
from cvtgs.outofcore.job import Job, job_folder
from cvtgs.outofcore.lloyd import accumulate, assign, move_sites, seed
from cvtgs.outofcore.memory import available_memory, block_count, memory_to_plan
from cvtgs.outofcore.merge import BlockReport, correct, inflate, merge, simplify_block
from cvtgs.outofcore.scan import CHUNK
from cvtgs.outofcore.sort import sort_into_blocks
from cvtgs.outofcore.workers import CheckedWorkers, Result, Workers, sequentially, with_progress
from cvtgs.progress import ProgressListener, silent
from cvtgs.report import SimplifyReport
from cvtgs.scene import concatenate
from cvtgs.simplifier import Simplifier

RANGE_ROWS, MOST_RANGES = 1 << 20, 64
"""Rows of the file that one process reads in one call, at least, and number of such calls."""


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
    simplifier: Simplifier | None = None,
    workers: Workers | None = None,
    range_rows: int | None = None,
    overwrite: bool = False,
    listener: ProgressListener = silent,
) -> SimplifyReport:
    """Simplify a file that need not fit into memory.

    The file is read in parts and sorted into blocks of space, which lie in a hidden folder beside
    the output; each block is simplified with its exact share of the Gaussians to keep. If this
    is interrupted, the same call continues with the blocks that are not finished. The result
    depends on the number of blocks, not on the workers or their order.

    Args:
        source: A binary PLY file.
        output: The file to write; a ``.ply`` is written without being held in memory.
        rho: Ratio of Gaussians to keep, in (0, 1].
        count: Number of Gaussians to keep, instead of ``rho``.
        max_count: Number of Gaussians to keep if there are more.
        memory: Bytes that one process may use; None for what is free.
        blocks: Number of blocks, instead of ``memory``.
        boxes: Gaussians with their centres in these are kept as they are, and come first.
        simplifier: Configuration and network; None for the defaults.
        workers: Calls functions for ranges of the file and for blocks; None calls them here, one
            after the other.
        range_rows: Rows of the file that one process reads in one call; None for a million, or a
            64th of the file.
        overwrite: Whether an existing output may be replaced.
        listener: Called with progress events.

    Returns:
        The report; statistics of cells are those of all blocks, seconds those of every process.

    Raises:
        ConfigError: The configuration takes images of the scene, which needs all of it.
        InvalidArgumentError: Ratio, count or boxes cannot be met.
        InvalidSceneError: No row is valid.
        FileFormatError: The file cannot be read in parts.
        OutputBusyError: Another run is at work on this output.

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
    workers = workers or sequentially
    check_config(simplifier.config)
    check_save(output, overwrite=overwrite)
    rows = open_rows(source)
    rows = replace(rows, path=str(Path(rows.path).absolute()))  # for workers in other folders
    target = target_count(rows.count, rho, count=count, max_count=max_count)
    wanted = blocks or block_count(rows, memory or memory_to_plan(available_memory()))
    job = Job(
        folder="",
        source=rows,
        target=target,
        blocks=max(1, min(wanted, target)),
        boxes=tuple(boxes),
        config=simplifier.config,
        has_network=simplifier.checkpoint is not None,
        range_rows=range_rows or rows_per_range(rows.count),
    )
    key = job.key(simplifier.checkpoint)
    job = replace(job, folder=job_folder(output, key))
    clock = StageClock(listener, torch.device("cpu"))
    with output_lock(output):
        is_resumed = job.can_resume(key)
        if not is_resumed:
            job.start_over()
        if isinstance(workers, CheckedWorkers):
            with clock.stage("workers"):
                workers.check(job)
        if not is_resumed:
            if simplifier.checkpoint is not None:
                job.write_network(simplifier.checkpoint)
            with one_thread():
                targets, finer = _scan_and_sort(job, workers, clock)
            job.write_manifest(key, targets, finer)
        resumed = _run_blocks(job, workers, clock)
        with clock.stage("assemble"):
            _assemble(job, output, overwrite=overwrite)
        report = _report(job, simplifier, clock, resumed=resumed)
        shutil.rmtree(Path(job.folder).parent, ignore_errors=True)
    return report


def rows_per_range(count: int) -> int:
    """Choose how many rows one process reads in one call, in whole chunks."""
    return max(RANGE_ROWS, CHUNK * math.ceil(count / MOST_RANGES / CHUNK))


def check_config(config: SimplifyConfig) -> None:
    """Refuse a configuration that needs the whole scene in one piece.

    Args:
        config: Every choice.

    Raises:
        ConfigError: It takes images of the scene, or refines.
    """
    if config.uses_renders or config.refine.enabled:
        raise ConfigError(
            "blocks need a preset that takes no images of the scene (draft, fast, standard, "
            f"paper) and no refinement; found {config.preset!r} with {config.visibility.views} "
            f"views and {config.refine.steps} steps of refinement."
        )


def _scan_and_sort(job: Job, workers: Workers, clock: StageClock) -> tuple[list[int], list[int]]:
    """Scan the file and sort its rows into blocks.

    Returns how many Gaussians each block keeps, and how many cells its tessellation makes.
    """
    rest, rows, cells = sort_into_blocks(job, workers, clock)
    if rest < sum(1 for count in rows if count):  # tiny targets: the heaviest blocks get one each
        order = sorted(range(job.blocks), key=lambda block: -cells[block])
        targets = [int(block in order[:rest]) for block in range(job.blocks)]
    else:
        targets = shared_out(rest, cells, rooms=rows)
    finer = [
        finer_count(kept, available, job.config.allocation)
        for kept, available in zip(targets, rows, strict=True)
    ]
    return targets, finer


def _run_blocks(job: Job, workers: Workers, clock: StageClock) -> int:
    """Simplify the blocks that are not finished; return how many were."""
    with_cells = job.blocks_with_cells()
    resumed = sum(job.small_path(block).exists() for block in with_cells)
    if job.blocks > 1:
        _tessellate_and_merge(job, workers, clock)
    last = correct if job.blocks > 1 else simplify_block
    with clock.stage("blocks", len(with_cells)) as advance:
        _run_all(workers, partial(last, job), with_cells, advance)
    return resumed


def _tessellate_and_merge(job: Job, workers: Workers, clock: StageClock) -> None:
    """Group the Gaussians of all blocks into cells, merge and inflate these.

    Each step is done for all blocks before the next, so the result has no seams: the sites of
    Lloyd move together, and neighbours are those of the whole scene.
    """
    blocks, iterations = job.blocks_with_rows(), job.config.cvt.iterations
    with clock.stage("tessellate", (iterations + 2) * len(blocks)) as advance:

        def run(step: Callable[[int], Result], nth: int) -> list[Result]:
            first = nth * len(blocks)
            return _run_all(workers, step, blocks, lambda done: advance(first + done))

        run(partial(seed, job), 0)
        moves, energy, least = 0, math.inf, 1.0 - job.config.cvt.tolerance
        for iteration in range(iterations):
            before, energy = energy, sum(run(partial(accumulate, job, iteration), iteration + 1))
            if energy >= least * before:
                break
            move_sites(job, iteration)
            moves = iteration + 1
        run(partial(assign, job, moves), iterations + 1)
    with_cells = job.blocks_with_cells()
    for name, step in (("merge", merge), ("inflate", inflate)):
        with clock.stage(name, len(with_cells)) as advance:
            _run_all(workers, partial(step, job), with_cells, advance)


def _run_all(
    workers: Workers,
    step: Callable[[int], Result],
    blocks: Sequence[int],
    advance: Callable[[int], None],
) -> list[Result]:
    return list(with_progress(workers(step, blocks), advance))


def _assemble(job: Job, output: str | os.PathLike[str], *, overwrite: bool) -> None:
    """Write protected rows and blocks behind one another."""
    blocks = [job.small_path(block) for block in job.blocks_with_cells()]
    name = Path(output).name.lower()
    if name.endswith(".ply") and not name.endswith(".compressed.ply"):
        with atomic_output(output, overwrite=overwrite) as file:
            join_plys(blocks, file, before=_kept_rows(job))
        return
    kept = [job.source.scene(rows) for rows in _kept_rows(job)]
    save(concatenate([*kept, *map(load, blocks)]), output, overwrite=overwrite)


def _kept_rows(job: Job) -> list[NDArray[Any]]:
    """Map the protected rows of every range."""
    paths = [job.kept_path(rows.number) for rows in job.ranges()]
    return [np.memmap(path, job.source.dtype, "r") for path in paths if path.exists()]


def _report(job: Job, simplifier: Simplifier, clock: StageClock, *, resumed: int) -> SimplifyReport:
    """Add up the reports of all blocks."""
    scan, with_cells = job.read_scan(), job.blocks_with_cells()
    reports = [
        BlockReport.model_validate_json(job.report_path(block).read_bytes()) for block in with_cells
    ]
    total, valid = job.source.count, scan.row_count + scan.kept_count
    if valid < total:
        warnings.warn(
            f"dropped {total - valid} of {total} Gaussians with NaN, infinite or zero values.",
            DroppedDataWarning,
            stacklevel=3,
        )
    energy_elsewhere = sum(  # of Gaussians in blocks without cells, which have no report
        float(map_tensors(job.labels_path(block))[0]["energy"])
        for block in job.blocks_with_rows()
        if block not in with_cells
    )
    kept_mass = sum(float(job.source.scene(rows).masses.sum()) for rows in _kept_rows(job))
    return SimplifyReport(
        input_count=total,
        output_count=min(job.target, valid),
        target_count=job.target,
        rho=job.target / total,
        invalid_count=total - valid,
        shortfall=shortfall(valid, total, job.target),
        filtered_count=scan.row_count - sum(report.input_count for report in reports),
        kept_count=scan.kept_count,
        single_member_cells=sum(report.single_member_cells for report in reports),
        largest_cell=max((report.largest_cell for report in reports), default=0),
        refilled_cells=sum(report.refilled_cells for report in reports),
        mass_in=scan.mass,
        mass_out=sum(report.mass_out for report in reports) + kept_mass,
        energy=sum(report.energy for report in reports) + energy_elsewhere,
        backend=reports[0].backend if reports else "none",
        checkpoint="none" if simplifier.checkpoint is None else simplifier.checkpoint.name,
        plan=scan.plan,
        stages=tuple(clock.costs),
        blocks=job.blocks,
        resumed_blocks=resumed,
        config=simplifier.config,
    )
