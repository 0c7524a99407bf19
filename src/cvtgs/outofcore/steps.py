"""The steps of a run in blocks, in their order; each runs for all blocks before the next."""

import math
from collections.abc import Callable
from functools import partial

from cvtgs.clock import StageClock
from cvtgs.outofcore.allocate import allocate, join, repeat_parts
from cvtgs.outofcore.image_errors import compare_errors, measure_errors
from cvtgs.outofcore.images import add_contributions, improve, measure, warn_of_blind_cameras
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.lloyd import accumulate, assign, move_sites, seed
from cvtgs.outofcore.merge import correct, inflate, merge, simplify_block
from cvtgs.processes import Result, Workers, with_progress


def run_steps(job: Job, workers: Workers, clock: StageClock) -> tuple[tuple[float, ...], int]:
    """Simplify the sorted blocks, unless an earlier run has.

    Returns:
        The energy before every iteration of Lloyd, and the number of blocks that were finished.
    """
    if not job.goes_by_steps:
        resumed = _count_finished(job)
        _run(simplify_block, job, workers, clock, stage="blocks")
        return (), resumed
    if job.config.uses_renders:
        blocks = job.blocks_with_rows()
        with clock.stage("visibility", len(blocks)) as advance:
            list(with_progress(workers(partial(measure, job), blocks), advance))
            add_contributions(job)
    energies = _tessellate(job, workers, clock)
    _allocate(job, workers, clock)
    if job.allocates_again:
        _merge(job, workers, clock)
        _run(measure_errors, job, workers, clock, stage="errors")
        compare_errors(job)
        job = job.last
        _allocate(job, workers, clock)
    resumed = _count_finished(job)
    _merge(job, workers, clock)
    if job.uses_images:
        _run(improve, job, workers, clock, stage="images", before=warn_of_blind_cameras)
    return energies, resumed


def _tessellate(job: Job, workers: Workers, clock: StageClock) -> tuple[float, ...]:
    """Tessellate the Gaussians of all blocks; return the energy before every iteration."""
    blocks, iterations = job.blocks_with_rows(), job.config.cvt.iterations
    with clock.stage("tessellate", (iterations + 2) * len(blocks)) as advance:

        def run(step: Callable[[int], Result], nth: int) -> list[Result]:
            first = nth * len(blocks)
            results = workers(step, blocks)
            return list(with_progress(results, lambda done: advance(first + done)))

        run(partial(seed, job), 0)
        moves, energies, least = 0, [math.inf], 1.0 - job.config.cvt.tolerance
        for iteration in range(iterations):
            found = run(partial(accumulate, job, iteration), iteration + 1)
            energies.append(math.fsum(found))  # `sum` rounds differently from Python 3.12 on
            if energies[-1] >= least * energies[-2]:
                break
            move_sites(job, iteration)
            moves = iteration + 1
        run(partial(assign, job, moves), iterations + 1)
    return tuple(energies[1:])


def _allocate(job: Job, workers: Workers, clock: StageClock) -> None:
    """Merge cells down to the number of Gaussians to keep, in all blocks together."""
    blocks = job.blocks_with_rows()
    with clock.stage("allocate", len(blocks)) as advance:
        if job.is_again:
            list(workers(partial(repeat_parts, job), blocks))
        allocate(job)
        list(with_progress(workers(partial(join, job), blocks), advance))


def _merge(job: Job, workers: Workers, clock: StageClock) -> None:
    """Turn the cells of all blocks into Gaussians."""
    for name, step in {"merge": merge, "inflate": inflate, "blocks": correct}.items():
        _run(step, job, workers, clock, stage=name)


def _run(
    step: Callable[[Job, int], None],
    job: Job,
    workers: Workers,
    clock: StageClock,
    *,
    stage: str,
    before: Callable[[Job], None] = lambda job: None,
) -> None:
    """Run a step for all blocks that keep Gaussians."""
    blocks = job.blocks_with_cells()
    with clock.stage(stage, len(blocks)) as advance:
        before(job)
        list(with_progress(workers(partial(step, job), blocks), advance))


def _count_finished(job: Job) -> int:
    return sum(job.finished_path(block).exists() for block in job.blocks_with_cells())
