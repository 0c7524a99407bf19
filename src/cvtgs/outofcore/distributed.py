"""Run blocks on many machines with Dask's distributed scheduler; only this file imports it."""

import logging
import os
import platform
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

import torch

import cvtgs
from cvtgs.errors import (
    CvtgsError,
    MissingDependencyError,
    RunError,
    how_to_install,
    is_out_of_memory,
)
from cvtgs.outofcore.job import Job
from cvtgs.processes import Item, Result

if TYPE_CHECKING:
    from distributed import Client, Future

MAX_DEATHS = 5  # number of rounds in which workers may die with a task before it is given up

ANSWER_SECONDS = 30.0
"""Seconds in which a scheduler must answer, a first worker appear, or a worker answer a check."""

_SHARE_SECONDS = 10.0  # seconds that a shared disk may take to show a new file to a worker


def connect(address: str) -> "Client":
    """Connect to a scheduler.

    Args:
        address: Its address, such as ``tcp://10.0.0.1:8786``.

    Returns:
        A client, which the caller must close.

    Raises:
        MissingDependencyError: ``distributed`` is not installed.
        RunError: No scheduler answers at the address.
    """
    try:
        from distributed import Client  # noqa: PLC0415 (optional)
    except ImportError as error:
        raise MissingDependencyError(
            "running on several machines needs the package distributed; "
            f"{how_to_install('cvtgs[dask]')}."
        ) from error
    for name in ("distributed", "distributed.client"):  # their messages are raised as errors, too
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        return Client(address, timeout=ANSWER_SECONDS)
    except (OSError, ValueError, TypeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise RunError(f"{address}: no scheduler answers there: {reason}.") from error


def _versions() -> dict[str, str]:
    python = ".".join(platform.python_version_tuple()[:2])
    return {"cvtgs": cvtgs.__version__, "torch": torch.__version__, "Python": python}


def _other_versions(versions: dict[str, str]) -> str:
    """Return what is wrong with the packages of this worker; empty if nothing is."""
    pairs = [(name, own, versions.get(name, "none")) for name, own in _versions().items()]
    wrong = ", ".join(
        f"{name} {own} instead of {wanted}" for name, own, wanted in pairs if own != wanted
    )
    advice = "install the same versions there"
    return wrong and f"must have the same package versions as its caller, found {wrong}; {advice}"


def _problem(versions: dict[str, str], source: str, size: int, probe: str, token: str) -> str:
    """Return why this worker cannot do a job; wait for shared disks to show it the probe."""
    path, deadline = Path(probe), time.monotonic() + _SHARE_SECONDS
    while not path.exists() and path.parent.parent.parent.is_dir() and time.monotonic() < deadline:
        time.sleep(0.2)
    if problem := _other_versions(versions):
        return problem
    try:
        found = f"{Path(source).stat().st_size} bytes"
    except OSError:
        found = "none"
    if found != f"{size} bytes":
        return f"must see the input {source} of {size} bytes under the same path, found {found}"
    try:
        sees_folder = path.read_text(encoding="ascii") == token and os.access(path.parent, os.W_OK)
    except (OSError, ValueError):
        sees_folder = False
    folder = path.parent.parent.parent
    wanted = "must be able to read and write the output folder under the same path"
    return "" if sees_folder else f"{wanted}, found no access to {folder}"


def _call(function: Callable[[Any], Any], versions: dict[str, str], item: Any) -> Any:
    """Call a function on a worker; raise if the worker joined late and has other versions."""
    if problem := _other_versions(versions):
        raise RunError(f"a worker {problem}.")
    return function(item)


class ClusterWorkers:
    """Calls functions on the workers of a cluster; repeats calls if a worker dies or a disk fails.

    Args:
        client: A client of the cluster.
    """

    def __init__(self, client: "Client") -> None:
        self._client = client

    def check(self, job: Job) -> int:
        """Return the number of workers that can do a job, whose folder must exist.

        Raises:
            RunError: There is no worker, or one has no cvtgs, another version, or no access to
                the source or to the folder of the output.
        """
        token, probe = secrets.token_hex(8), job.path("probe")
        with _scheduler_errors():
            addresses = self._wait_for_workers()
            # Without this cvtgs, calls of its functions might never be answered.
            for address, version in self._ask(addresses, resolve_name, "cvtgs:__version__"):
                if version != cvtgs.__version__:
                    raise _has_no_cvtgs(address, version)
            probe.write_text(token, encoding="ascii")
            try:
                source, size = job.source.path, Path(job.source.path).stat().st_size
                facts = (_versions(), source, size, str(probe), token)
                for address, problem in self._ask(addresses, _problem, *facts):
                    if problem:
                        raise RunError(f"{address}: this worker {problem}.")
            finally:
                probe.unlink(missing_ok=True)
        return len(addresses)

    def _ask(
        self, addresses: Sequence[str], function: Callable[..., Any], *arguments: Any
    ) -> Iterator[tuple[str, Any]]:
        """Call a function on every worker; yield the answers, or raise if there is none."""
        from distributed import wait  # noqa: PLC0415 (optional)

        futures = [
            self._client.submit(function, *arguments, workers=[address], pure=False)
            for address in addresses
        ]
        with suppress(TimeoutError):
            wait(futures, timeout=ANSWER_SECONDS)
        try:
            for address, future in zip(addresses, futures, strict=True):
                if future.status == "error":
                    raise _has_no_cvtgs(address, _message_of(future.exception()))
                if future.status != "finished":
                    raise RunError(
                        f"{address}: this worker must answer within {ANSWER_SECONDS:g} s, found no "
                        "answer; stop it, install the same cvtgs there, or wait until it is less "
                        "busy."
                    )
                yield address, future.result()
        finally:
            self._cancel(futures)

    def _wait_for_workers(self) -> list[str]:
        deadline = time.monotonic() + ANSWER_SECONDS
        while not (addresses := self._addresses()):
            if time.monotonic() > deadline:
                if self._client.status != "running":
                    raise _gone()
                where = self._client.scheduler.address if self._client.scheduler else "ADDRESS"
                raise RunError(
                    f"{where}: must have workers, found none within {ANSWER_SECONDS:g} s; start "
                    f"some with: dask worker {where}."
                )
            time.sleep(0.2)
        return addresses

    def _addresses(self) -> list[str]:
        # A client that has just lost its scheduler knows of no workers.
        return sorted(self._client.scheduler_info(n_workers=-1).get("workers", ()))

    def __call__(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterable[Result]:
        """Call a function for every item, as :class:`Workers` do; raise if a task fails often."""
        with _scheduler_errors():
            submit = partial(self._client.submit, _call, function, _versions())
            futures = [submit(item, pure=False, retries=2) for item in items]
        try:
            for future in futures:
                with _scheduler_errors():
                    result = self._result_of(future)
                yield result
        finally:
            self._cancel(futures)

    def _cancel(self, futures: "Sequence[Future[Any]]") -> None:
        with suppress(Exception):  # the scheduler may be gone
            self._client.cancel(list(futures))

    def _result_of(self, future: "Future[Any]") -> Any:
        from distributed import KilledWorker, wait  # noqa: PLC0415 (optional)

        for _ in range(MAX_DEATHS):
            unanswered = 0
            while True:
                try:
                    wait([future], timeout=ANSWER_SECONDS)
                    break
                except TimeoutError as error:
                    works = self._client.status == "running" and self._addresses()
                    unanswered = 0 if works else unanswered + 1
                    if unanswered > 1:
                        raise _gone() from error
            try:
                return future.result()
            except KilledWorker:
                self._client.retry([future])
            except Exception as error:
                if isinstance(error, CvtgsError) or is_out_of_memory(error):
                    raise
                if future.status in ("cancelled", "lost"):
                    raise _gone() from error
                raise RunError(
                    f"a worker failed: {_message_of(error)}; all workers need the same packages "
                    "and access to input and output; run the same command again to continue."
                ) from error
        raise RunError(
            f"{MAX_DEATHS} rounds of workers died on the same task; give them more memory or lower "
            "--memory, and run the same command again to continue."
        )


def _has_no_cvtgs(address: str, found: str) -> RunError:
    return RunError(
        f"{address}: this worker must have cvtgs {cvtgs.__version__}, found {found}; "
        "install it in the environment of every worker."
    )


@contextmanager
def _scheduler_errors() -> Iterator[None]:
    """Turn the errors of a client whose scheduler is gone into one clear error."""
    try:
        yield
    except (CancelledError, OSError) as error:
        if isinstance(error, CvtgsError) or is_out_of_memory(error):
            raise
        raise _gone() from error


def _gone() -> RunError:
    return RunError(
        "the scheduler or all of its workers are gone; start them again, then run the same "
        "command again to continue."
    )


def _message_of(error: BaseException | None) -> str:
    """Return the message of a library's error in one line."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    text = f"{type(error).__name__}: {lines[0].strip()}" if lines else type(error).__name__
    return text[:200].rstrip(".")
