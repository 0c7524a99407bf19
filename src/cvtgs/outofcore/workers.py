"""Workers, which call functions for ranges of a file and for blocks, here or elsewhere."""

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol, TypeVar

from cvtgs.clock import StageClock
from cvtgs.devices import core_count
from cvtgs.errors import CvtgsError
from cvtgs.mergenet import Checkpoint
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.memory import ROOMY_BYTES
from cvtgs.processes import pool_size

Item = TypeVar("Item")
Result = TypeVar("Result")


class Workers(Protocol):
    """Calls a function for every item, in this process or in others."""

    def __call__(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterable[Result]:
        """Call the function for every item.

        Args:
            function: A function that can be pickled.
            items: The arguments; the calls are independent.

        Returns:
            The results, in the order of the items.
        """
        ...


@contextmanager
def started(
    job: Job, workers: Workers, clock: StageClock, checkpoint: Checkpoint | None, *, resumes: bool
) -> Iterator[None]:
    """Make the folder of a job and write its network, unless it resumes; check the workers.

    The folder is removed if the job fails before there is anything to resume.
    """
    try:
        if not resumes:
            job.start_over()
        check: Callable[[Job], object] | None = getattr(workers, "check", None)
        if check is not None:  # workers on other machines
            with clock.stage("workers"):
                check(job)
        if not resumes and checkpoint is not None:
            job.write_network(checkpoint)
        yield
    except CvtgsError:
        if not resumes:
            shutil.rmtree(Path(job.folder).parent, ignore_errors=True)
        raise


def sequentially(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Call a function for each item in order, in this process."""
    yield from map(function, items)


def with_progress(results: Iterable[Result], advance: Callable[[int], None]) -> Iterator[Result]:
    """Yield the results, and report their number so far."""
    for done, result in enumerate(results, start=1):
        yield result
        advance(done)


def worker_count(memory: int, wanted: int | None = None) -> int:
    """Choose the number of processes that work on blocks.

    Args:
        memory: Bytes for all processes together.
        wanted: The wanted number; None for one per core.

    Returns:
        At least 1, and at most one per GB, which torch and a block of some size need; on Windows,
        at most 61.

    Example:
        >>> worker_count(4_000_000_000, 8)
        4
    """
    return pool_size(max(1, min(wanted or core_count(), memory // (2 * ROOMY_BYTES))))
