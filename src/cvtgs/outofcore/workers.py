"""Workers, which call functions for ranges of a file and for blocks, here or elsewhere."""

import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Protocol, Self, TypeVar, runtime_checkable

from cvtgs.clock import StageClock
from cvtgs.devices import core_count
from cvtgs.errors import RunError
from cvtgs.mergenet import Checkpoint
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.memory import ROOMY_BYTES

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


@runtime_checkable
class CheckedWorkers(Workers, Protocol):
    """Workers that may be on other machines, and are checked before a job."""

    def check(self, job: Job) -> int:
        """Raise if a worker cannot do a job.

        Args:
            job: The job; its folder must exist.

        Returns:
            The number of workers.
        """
        ...


def begin(
    job: Job, workers: Workers, clock: StageClock, checkpoint: Checkpoint | None, *, resumes: bool
) -> None:
    """Make the folder of a job and write its network, unless it resumes; check the workers."""
    if not resumes:
        job.start_over()
    if isinstance(workers, CheckedWorkers):
        with clock.stage("workers"):
            workers.check(job)
    if not resumes and checkpoint is not None:
        job.write_network(checkpoint)


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
        At least 1, and at most one per GB, which torch and a block of some size need.

    Example:
        >>> worker_count(4_000_000_000, 8)
        4
    """
    return max(1, min(wanted or core_count(), memory // (2 * ROOMY_BYTES)))


class LocalWorkers:
    """Context manager that calls functions in processes of this machine.

    However this process ends, the others end with it. A program that uses them must guard its main
    code with ``if __name__ == "__main__":``, since they import it.

    Args:
        count: Number of processes.
    """

    def __init__(self, count: int) -> None:
        self._count = count

    def __enter__(self) -> Self:
        context = get_context("spawn")  # fork would copy locks that torch's threads hold
        self._watched, self._alive = context.Pipe(duplex=False)
        threads = max(1, core_count() // self._count)
        self._pool = ProcessPoolExecutor(
            self._count, context, initializer=_begin, initargs=(self._watched, threads)
        )
        for _ in range(self._count):  # they start while this process reads the sample
            self._pool.submit(os.getpid)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is None:
            self._pool.shutdown()
        self._alive.close()  # ends processes that still work
        self._pool.shutdown(cancel_futures=True)
        self._watched.close()

    def __call__(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[Result]:
        """Call a function for every item.

        Args:
            function: A function that can be pickled.
            items: The arguments.

        Yields:
            The results, in the order of the items.

        Raises:
            RunError: A process ended unexpectedly.
        """
        futures = deque(self._pool.submit(_call, pickle.dumps((function, one))) for one in items)
        try:
            while futures:  # drops results once yielded: a scan has dozens of megabytes
                result: Result = pickle.loads(futures.popleft().result())
                yield result
        except BrokenProcessPool as error:
            raise RunError(
                "a worker process ended unexpectedly, most likely for lack of memory; run the "
                "same command again, with less --memory or fewer --workers."
            ) from error
        finally:
            for future in futures:
                future.cancel()


def _call(work: bytes) -> bytes:
    """Call a pickled function; as objects, torch would pass tensors through files in a folder."""
    function, item = pickle.loads(work)  # made by the process that started this one
    return pickle.dumps(function(item))


def _begin(watched: Connection, threads: int) -> None:
    """Prepare a worker process: it leaves Ctrl-C to its parent, and ends when the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = str(threads)
    threading.Thread(target=_end_with, args=(watched,), daemon=True).start()


def _end_with(watched: Connection) -> None:
    try:
        watched.recv_bytes()
    except (EOFError, OSError):
        os._exit(1)
