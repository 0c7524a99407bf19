"""Who works, and in which order: each step on every block, before the next step."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Protocol, TypeVar

from cvtgs.outofcore.job import Job
from cvtgs.outofcore.merging import merge, widen
from cvtgs.outofcore.sites import assign, move, place, settle
from cvtgs.progress import StageClock

Item = TypeVar("Item")
Result = TypeVar("Result")


class Workers(Protocol):
    """Whatever calls a function for every item; results come in the order of the items."""

    def __call__(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterable[Result]:
        """Call the function for every item."""
        ...


def this_process(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Call a function for one item after the other, here."""
    yield from map(function, items)


def told(results: Iterable[Result], advance: Callable[[int], None]) -> Iterator[Result]:
    """Return how many results have come."""
    for done, result in enumerate(results, start=1):
        yield result
        advance(done)


def do_all(
    workers: Workers,
    step: Callable[[int], Result],
    blocks: Sequence[int],
    advance: Callable[[int], None],
) -> list[Result]:
    """Do one step for every block."""
    return list(told(workers(step, blocks), advance))


def group_blocks(job: Job, workers: Workers, clock: StageClock) -> None:
    """Group the Gaussians of all blocks into cells, merge these and widen them.

    What is one step for a scene in one piece is one step here for all blocks, so that none sees
    a border: the sites of Lloyd move together, and neighbours are those of the whole scene.
    """
    blocks, iterations = job.filled(), job.config.cvt.iterations
    with clock.stage("tessellate", (iterations + 2) * len(blocks)) as advance:

        def do(step: Callable[[int], Result], nth: int) -> list[Result]:
            return do_all(workers, step, blocks, lambda done: advance(nth * len(blocks) + done))

        do(partial(place, job), 0)
        moves, energy, least = 0, math.inf, 1.0 - job.config.cvt.tolerance
        for turn in range(iterations):
            before, energy = energy, sum(do(partial(settle, job, turn), turn + 1))
            if energy >= least * before:
                break
            move(job, turn)
            moves = turn + 1
        do(partial(assign, job, moves), iterations + 1)
    busy = job.busy()
    for name, step in (("merge", merge), ("widen", widen)):
        with clock.stage(name, len(busy)) as advance:
            do_all(workers, partial(step, job), busy, advance)
