"""Workers, which call a function for many items: here, in other processes, or elsewhere."""

import os
import pickle
import shutil
import signal
import sys
import threading
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from multiprocessing import current_process, get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import NamedTemporaryFile, mkdtemp
from typing import Any, NamedTuple, Protocol, Self, TypeVar, runtime_checkable

from cvtgs.counts import checked_whole
from cvtgs.errors import InvalidArgumentError, OutputError, RunError, reason_of, warn
from cvtgs.startup import load_torch

if sys.platform == "win32":
    from multiprocessing.connection import PipeConnection as Connection
else:
    from multiprocessing.connection import Connection

Item = TypeVar("Item")
Result = TypeVar("Result")

WAKE_SECONDS = 0.5  # longest wait for a result at once: on Windows, Ctrl-C does not end a wait
# Larger results, bytes, are in temporary files. A pipe takes that much in one piece, so a process
# that ends never leaves a part of a result in it, for whose rest the pool would wait forever.
MOST_SENT = 256

SAFE_PATH = "PYTHONSAFEPATH"
"""Variable with which Python imports nothing from the current folder, where any file may lie."""

MOST_ON_WINDOWS = 61  # largest number of processes that a pool of Python has on Windows


@runtime_checkable
class Workers(Protocol):
    """Calls a function for every item, in this process (as ``map`` does) or in others."""

    def __call__(
        self, function: Callable[[Item], Result], items: Sequence[Item], /
    ) -> Iterable[Result]:
        """Return the results of a function, which can be pickled, in the order of the items."""
        ...


def with_progress(results: Iterable[Result], advance: Callable[[int], None]) -> Iterator[Result]:
    """Yield the results, and report their number so far."""
    for done, result in enumerate(results, start=1):
        yield result
        advance(done)


def can_start_processes() -> bool:
    """Return whether this process may start others; those of ``multiprocessing.Pool`` may not."""
    return not current_process().daemon


def pool_size(count: int) -> int:
    """Return the number of processes that a pool can have on this system, at most ``count``."""
    return min(count, MOST_ON_WINDOWS) if sys.platform == "win32" else count


class LocalWorkers:
    """Context manager that calls functions in processes of this machine.

    However this process ends, the others end with it. A program that uses them must guard its main
    code with ``if __name__ == "__main__":``, since they import it.

    Args:
        count: Number of processes; Windows allows at most 61, which are used if it is larger.
        remedy: What to do when a process ends unexpectedly, for the error message.

    Raises:
        InvalidArgumentError: The number is below 1.
        RunError: This process is one of ``multiprocessing.Pool``, which may not start others.
    """

    def __init__(self, count: int, remedy: str = "with less --memory or fewer --workers") -> None:
        count = checked_whole(count, "the number of processes")
        self.count: int = pool_size(count)
        self._remedy = remedy

    def __enter__(self) -> Self:
        from cvtgs.devices import core_count  # noqa: PLC0415 (loads torch; see _begin)

        if not can_start_processes():
            raise RunError(
                "a process of multiprocessing.Pool may not start others; use "
                "concurrent.futures.ProcessPoolExecutor in its place, or no workers here."
            )
        self._owner, self._warned = os.getpid(), set[str]()
        context = get_context("spawn")  # fork would copy locks that torch's threads hold
        threads = max(1, core_count() // self.count)
        with ExitStack() as stack:
            with _temporary_errors():
                self._folder = mkdtemp(prefix="cvtgs-")
            stack.callback(shutil.rmtree, self._folder, ignore_errors=True)
            self._watched, self._alive = context.Pipe(duplex=False)
            stack.callback(self._watched.close)
            settings = (self._watched, threads, self._folder)
            with _hangup_ignored():
                self._pool = ProcessPoolExecutor(
                    self.count, context, initializer=_begin, initargs=settings
                )
                stack.callback(self._pool.shutdown, cancel_futures=True)
                stack.callback(self._end_processes)
                self._start_processes()
            self._cleanup = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        if os.getpid() != self._owner:  # in a process that a program has forked meanwhile
            self._alive.close()
            self._watched.close()
            return
        # Results are taken by now, and Ctrl-C in a wait for the pool would leave its processes.
        self._cleanup.close()
        del self._pool

    def _start_processes(self) -> None:
        """Let all processes start, while this one reads the sample."""
        self._starts = list[Future[int]]()
        try:
            with _interrupts_held(), _safe_path():
                for _ in range(self.count):
                    self._starts.append(self._pool.submit(os.getpid))
        except BrokenProcessPool as error:
            raise self._run_error() from error

    def _processes(self) -> list[BaseProcess]:
        return [*(self._pool._processes or {}).values()]

    def _end_processes(self) -> None:
        self._alive.close()  # ends processes that work
        for process in self._processes():
            process.terminate()  # also while it starts

    def __call__(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[Result]:
        """Call a function for every item, as :class:`Workers` do.

        Raises:
            InvalidArgumentError: The workers were not started by ``with``.
            RunError: A process ended unexpectedly.
            OutputError: There is no room for temporary files.
        """
        if not hasattr(self, "_pool"):
            raise InvalidArgumentError("workers run inside `with LocalWorkers(...) as workers:`.")
        futures = deque[Future[bytes | str]]()
        try:
            for one in items:  # the pool refuses work if a process ended since the last call
                work = pickle.dumps((function, one))
                futures.append(self._pool.submit(_call, work, self._folder))
            while futures:  # drops results once yielded: a scan has dozens of megabytes
                while not wait([futures[0]], WAKE_SECONDS).done:
                    pass
                found = futures.popleft().result()
                answer = pickle.loads(_taken(found) if isinstance(found, str) else found)
                if answer.error is not None:
                    answer.error.add_note(f"In a worker process:\n{answer.trace}")
                    raise answer.error
                for category, text in answer.warnings:
                    if text not in self._warned:  # several processes may have found the same
                        self._warned.add(text)
                        warn(text, category)
                result: Result = answer.result
                yield result
        except BrokenProcessPool as error:
            raise self._run_error() from error
        finally:
            for future in futures:
                future.cancel()

    def _run_error(self) -> RunError:
        """Return why the pool broke: by an error in starting processes, or by a signal."""
        wait(self._starts, WAKE_SECONDS)  # the pool is broken a moment before they have failed
        for process in self._processes():
            process.join(WAKE_SECONDS)
        never_worked = all(start.done() and start.exception() for start in self._starts)
        if never_worked and any(process.exitcode == 1 for process in self._processes()):
            return RunError(
                "no worker process could start; a script that starts some must be a file, and "
                'guard its main code with `if __name__ == "__main__":`.'
            )
        return RunError(
            f"a worker process ended unexpectedly, most likely for lack of memory; run the "
            f"same command again, {self._remedy}."
        )


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Start processes that Ctrl-C does not reach, until :func:`_begin` ignores it."""
    # The pool must have been made before: Python ends the hold when it starts a process of its own.
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _safe_path() -> Iterator[None]:
    """Start processes that import nothing from the current folder; spawned ones begin there."""
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before


@contextmanager
def _hangup_ignored() -> Iterator[None]:
    """Start processes that ignore the signal of a closed terminal: they end with this one."""
    is_main = threading.current_thread() is threading.main_thread()  # others set no handlers
    if sys.platform == "win32" or not is_main or signal.getsignal(signal.SIGHUP) is None:
        yield  # None is a handler of a program around Python, which could not be restored
        return
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


class _Answer(NamedTuple):
    """What a call returned or raised, and its warnings."""

    result: Any = None
    warnings: tuple[tuple[type[Warning], str], ...] = ()
    error: Exception | None = None
    trace: str = ""


def _call(work: bytes, folder: str) -> bytes | str:
    """Call a pickled function; return its pickled answer, or the path of a file with it."""
    try:
        function, item = pickle.loads(work)  # made by the process that started this one
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result = function(item)
        found = [one for one in caught if issubclass(one.category, UserWarning)]
        texts = tuple((one.category, str(one.message)) for one in found)
        answer = pickle.dumps(_Answer(result, texts))
    except Exception as error:
        answer = _pickled_error(error)
    if len(answer) <= MOST_SENT:
        return answer
    with _temporary_errors(), NamedTemporaryFile(dir=folder, delete=False) as file:
        file.write(answer)
    return file.name


def _pickled_error(error: Exception) -> bytes:
    """Pickle an error and its traceback; one that cannot be pickled becomes a RunError."""
    trace = traceback.format_exc()
    try:
        content = pickle.dumps(_Answer(error=error, trace=trace))
        pickle.loads(content)
    except Exception:
        text = f"a worker process failed: {type(error).__name__}: {error}"
        content = pickle.dumps(_Answer(error=RunError(text), trace=trace))
    return content


def _taken(path: str) -> bytes:
    """Read and remove a temporary file."""
    with _temporary_errors():
        content = Path(path).read_bytes()
        Path(path).unlink()
    return content


@contextmanager
def _temporary_errors() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"the folder of temporary files must be writable and have room for results of worker "
            f"processes, found: {reason_of(error)}; TMPDIR sets another folder."
        ) from error


def _begin(watched: Connection, threads: int, folder: str) -> None:
    """Prepare a worker process: it leaves Ctrl-C to its parent, and ends when the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(watched, folder), daemon=True).start()
    os.environ["OMP_NUM_THREADS"] = str(threads)  # for searches and for libraries loaded later
    load_torch()
    import torch  # noqa: PLC0415 (with these settings)

    torch.set_num_threads(threads)  # the program of the parent may have loaded it


def _end_with(watched: Connection, folder: str) -> None:
    try:
        watched.recv_bytes()
    except (EOFError, OSError):
        shutil.rmtree(folder, ignore_errors=True)  # the parent may have been killed
        os._exit(1)
