"""Options of commands that work block by block, and the workers that they choose."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager

from cvtgs.cli.display import say
from cvtgs.errors import InvalidArgumentError, OutputBusyError, OutputError, RunError, warn
from cvtgs.text import size_text


def add_block_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--memory``, ``--workers`` and ``--scheduler``."""
    parser.add_argument(
        "--memory",
        metavar="AMOUNT",
        help="memory to use, for example 4GB (default: the free memory); a binary .ply that needs "
        "more is processed in blocks, and the same command resumes an interrupted run",
    )
    places = parser.add_mutually_exclusive_group()
    places.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="processes for the blocks, which share --memory (default: one per core, as far as "
        "memory allows)",
    )
    places.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="address of a Dask cluster that processes the blocks; its workers need access to "
        "the files, and --memory is the memory of each task",
    )


def memory_of(options: argparse.Namespace) -> int:
    """Return the memory to use, in bytes; raise if there would be no worker."""
    from cvtgs.outofcore.memory import memory_to_plan, read_bytes

    if options.workers is not None and options.workers < 1:
        raise InvalidArgumentError(f"--workers must be at least 1, found {options.workers}.")
    if options.memory is None:
        return memory_to_plan()
    try:
        return read_bytes(options.memory)
    except InvalidArgumentError as error:
        raise InvalidArgumentError(f"--{error}") from None


def check_block_device(options: argparse.Namespace) -> None:
    """Raise if a device is wanted that blocks do not use."""
    if options.device not in ("auto", "cpu"):
        raise InvalidArgumentError(
            f"--device {options.device} cannot be used with blocks, which are computed on the CPU."
        )


@contextmanager
def block_workers(
    options: argparse.Namespace, memory: int
) -> Iterator[tuple["cvtgs.outofcore.Workers | None", int]]:
    """Return workers, None for this process alone, and the bytes that each may use.

    After an interrupt or a failure, print where the finished steps are.
    """
    from cvtgs.io.locks import hidden_path
    from cvtgs.outofcore import ClusterWorkers, LocalWorkers, connect
    from cvtgs.outofcore.memory import WORKER_BYTES, worker_count
    from cvtgs.outofcore.resume import can_continue, remove_job_files
    from cvtgs.processes import pool_size

    try:
        if options.scheduler is not None:
            with closing(connect(options.scheduler)) as client:
                yield ClusterWorkers(client), memory
            return
        count = worker_count(memory, options.workers)
        if options.workers is not None and count < pool_size(options.workers):
            warn(
                f"--workers {options.workers}: the memory is enough for {count}, at "
                f"{size_text(WORKER_BYTES)} each."
            )
        if count > 1:
            with LocalWorkers(count) as workers:
                yield workers, memory // count
        else:
            yield None, memory
    except (KeyboardInterrupt, OutputError, RunError, MemoryError) as error:
        if can_continue(options.output):
            if not isinstance(error, OutputBusyError):
                say(
                    f"cvtgs: {hidden_path(options.output, 'blocks')} has the finished steps, with "
                    "which the same command continues; delete it if that is not wanted.",
                    file=sys.stderr,
                )
        else:
            is_stream = getattr(options, "stream", None) is not None
            remove_job_files(options.output, is_stream=is_stream)  # processes wrote until they end
        raise
