"""Workers: what calls functions for ranges of a file and for blocks, here or elsewhere."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Protocol, TypeVar, runtime_checkable

from cvtgs.clock import StageClock
from cvtgs.mergenet import Checkpoint
from cvtgs.outofcore.job import Job

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
            items: Its arguments; the calls are independent.

        Returns:
            The results, in the order of the items.
        """
        ...


@runtime_checkable
class CheckedWorkers(Workers, Protocol):
    """Workers that may be elsewhere, and are asked first whether they can do a job."""

    def check(self, job: Job) -> int:
        """Refuse workers that cannot do a job.

        Args:
            job: The job; its folder is there.

        Returns:
            How many workers there are.
        """
        ...


def begin(
    job: Job, workers: Workers, clock: StageClock, checkpoint: Checkpoint | None, *, resumes: bool
) -> None:
    """Make the folder of a job, unless it resumes, and ask workers whether they can do it."""
    if not resumes:
        job.start_over()
    if isinstance(workers, CheckedWorkers):
        with clock.stage("workers"):
            workers.check(job)
    if not resumes and checkpoint is not None:
        job.write_network(checkpoint)


def sequentially(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Call a function for one item after the other, in this process."""
    yield from map(function, items)


def with_progress(results: Iterable[Result], advance: Callable[[int], None]) -> Iterator[Result]:
    """Return the results, and report how many there are so far."""
    for done, result in enumerate(results, start=1):
        yield result
        advance(done)
