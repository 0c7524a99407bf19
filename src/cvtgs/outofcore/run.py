"""Simplify a file block by block: in bounded memory, resumable, on one machine or on many."""

import os
import shutil
from collections.abc import Callable, Sequence
from functools import partial

import torch

from cvtgs.boxes import Box, check_room
from cvtgs.config import SimplifyConfig
from cvtgs.counts import shared_out, target_count
from cvtgs.devices import one_thread
from cvtgs.errors import ConfigError, InvalidArgumentError, InvalidSceneError
from cvtgs.io import check_save
from cvtgs.io.ply import open_rows
from cvtgs.math.frames import robust_frame
from cvtgs.outofcore.finish import join_blocks, report_of
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.memory import available_memory, block_count
from cvtgs.outofcore.merging import finish
from cvtgs.outofcore.survey import survey, take_sample, total
from cvtgs.outofcore.turns import Workers, do_all, group_blocks, this_process, told
from cvtgs.outofcore.work import look, simplify_whole, sort_into_blocks
from cvtgs.progress import ProgressListener, StageClock, silent
from cvtgs.report import SimplifyReport
from cvtgs.simplifier import Simplifier

RANGE_ROWS = 1 << 26
"""Rows of the file that one process looks at in one go."""


def simplify_file(  # noqa: PLR0913 (options by name)
    source: str | os.PathLike[str],
    output: str | os.PathLike[str],
    rho: float | None = None,
    *,
    count: int | None = None,
    memory: int | None = None,
    blocks: int | None = None,
    boxes: Sequence[Box] = (),
    simplifier: Simplifier | None = None,
    workers: Workers = this_process,
    range_rows: int = RANGE_ROWS,
    overwrite: bool = False,
    listener: ProgressListener = silent,
) -> SimplifyReport:
    """Simplify a file that need not fit into memory.

    The file is read in parts and sorted into blocks of space, which lie in a hidden folder beside
    the output; each block is simplified with its exact share of the Gaussians to keep. If this
    is interrupted, the same call goes on with the blocks that are not done. The number of blocks,
    not who works on them or when, decides the result.

    Args:
        source: A binary PLY file.
        output: The file to write; a ``.ply`` is written without being held in memory.
        rho: Ratio of Gaussians to keep, in (0, 1].
        count: Number of Gaussians to keep, instead of ``rho``.
        memory: Bytes that one process may use; None for what is free.
        blocks: Number of blocks, instead of ``memory``.
        boxes: Gaussians with their centres in these are kept as they are, and come first.
        simplifier: Configuration and network; None for the defaults.
        workers: What works on the blocks.
        range_rows: Rows of the file that one process looks at in one go.
        overwrite: Whether an existing output may be replaced.
        listener: Told about progress.

    Returns:
        The report; facts of cells are those of all blocks, seconds those of every process.

    Raises:
        ConfigError: The configuration looks at images of the scene, which needs all of it.
        InvalidArgumentError: Ratio, count or boxes cannot be met.
        InvalidSceneError: No row is valid.
        FileFormatError: The file cannot be read in parts.

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
    check_config(simplifier.config)
    check_save(output, overwrite=overwrite)
    rows = open_rows(source)
    target = target_count(rows.count, rho, count=count)
    wanted = blocks or block_count(rows, memory or available_memory())
    job = Job.beside(
        output,
        source=rows,
        target=target,
        blocks=max(1, min(wanted, target)),
        boxes=tuple(boxes),
        config=simplifier.config,
        has_network=simplifier.checkpoint is not None,
        range_rows=range_rows,
    )
    clock = StageClock(listener, torch.device("cpu"))
    key = job.key(simplifier.checkpoint)
    if not job.is_cut(key):
        job.start_over()
        if simplifier.checkpoint is not None:
            job.write_network(simplifier.checkpoint)
        with one_thread():
            _cut(job, workers, clock)
        job.declare_cut(key)
    found, _ = job.read_survey()
    busy = job.busy()
    resumed = sum(job.small_path(block).exists() for block in busy)
    if job.blocks > 1:
        group_blocks(job, workers, clock)
    last = finish if job.blocks > 1 else simplify_whole
    with clock.stage("blocks", len(busy)) as advance:
        do_all(workers, partial(last, job), busy, advance)
    with clock.stage("join"):
        join_blocks(job, busy, output, overwrite=overwrite)
    report = report_of(job, found, busy, simplifier=simplifier, clock=clock, resumed=resumed)
    shutil.rmtree(job.folder, ignore_errors=True)
    return report


def check_config(config: SimplifyConfig) -> None:
    """Refuse choices that need the whole scene in one piece."""
    if config.uses_renders or config.refine.enabled:
        raise ConfigError(
            "blocks need a preset that takes no images of the scene (draft, fast, standard, "
            f"paper) and no refinement; found {config.preset!r} with {config.visibility.views} "
            f"views and {config.refine.steps} steps of refinement."
        )


def _cut(job: Job, workers: Workers, clock: StageClock) -> None:
    """Look at the whole file, and sort its rows into blocks."""
    ranges = job.ranges()
    with clock.stage("survey", len(ranges)) as advance:
        sample = take_sample(job.source)
        if len(sample) == 0:
            raise InvalidSceneError(f"{job.source.path}: found no valid Gaussian.")
        frame = robust_frame(sample.means)
        depths = total(told(workers(partial(look, job, frame), ranges), advance))
        check_room(depths.kept, target=job.target, total=depths.valid)
        if depths.kept == depths.valid:
            raise InvalidArgumentError(
                f"all {depths.kept} valid Gaussians are to be kept as they are; none is left."
            )
        rest = min(job.target, depths.valid) - depths.kept
        found = survey(
            sample,
            depths,
            boxes=job.boxes,
            target=max(1, rest),
            blocks=job.blocks,
            config=job.config,
            frame=frame,
        )
    with clock.stage("cut", len(ranges)) as advance:
        job.write_survey(found, [])
        counts, shares = _sorted(job, workers, ranges, advance)
        if sum(counts) < rest:  # the filter was too strict for so large a target
            found = found._replace(faintest=0.0, lightest=-1.0)
            job.write_survey(found, [])
            counts, shares = _sorted(job, workers, ranges, advance)
    occupied = sum(1 for count in counts if count)
    if rest < occupied:  # tiny targets: the heaviest blocks get one each
        order = sorted(range(job.blocks), key=lambda block: -shares[block])
        targets = [int(block in order[:rest]) for block in range(job.blocks)]
    else:
        targets = shared_out(rest, shares, rooms=counts)
    job.write_survey(found, targets)


def _sorted(
    job: Job,
    workers: Workers,
    ranges: Sequence[tuple[int, int, int]],
    advance: Callable[[int], None],
) -> tuple[list[int], list[float]]:
    counts, shares = [0] * job.blocks, [0.0] * job.blocks
    for rows, cells in told(workers(partial(sort_into_blocks, job), ranges), advance):
        counts = [a + b for a, b in zip(counts, rows, strict=True)]
        shares = [a + b for a, b in zip(shares, cells, strict=True)]
    return counts, shares
