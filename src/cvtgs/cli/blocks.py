"""Work block by block: its options, when it is needed, its workers, and ``cvtgs simplify``."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import cvtgs
from cvtgs.cli.cameras import read_cameras
from cvtgs.cli.display import say
from cvtgs.cli.goals import has_target
from cvtgs.cli.options import checkpoint_of
from cvtgs.errors import (
    ConfigError,
    FileFormatError,
    InputError,
    InvalidArgumentError,
    OutputBusyError,
    OutputError,
    RunError,
    warn,
)
from cvtgs.progress import ProgressListener
from cvtgs.text import size_text

if TYPE_CHECKING:
    from cvtgs.io.ply import PlyRows


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
    with _named_as_option():
        return read_bytes(options.memory)


def check_given_memory(
    options: argparse.Namespace, memory: int, config: "cvtgs.SimplifyConfig"
) -> None:
    """Raise if ``--memory`` is too small for blocks with images of the scene."""
    from cvtgs.outofcore.memory import check_memory

    if options.memory is not None:
        with _named_as_option():
            check_memory(memory, with_images=config.uses_images, written=options.memory)


@contextmanager
def _named_as_option() -> Iterator[None]:
    """Let errors call the memory ``--memory``."""
    try:
        yield
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
    """Return workers, None for this process alone, and the bytes of each; clean up on failure."""
    from cvtgs.io.locks import hidden_path
    from cvtgs.outofcore import ClusterWorkers, LocalWorkers, connect
    from cvtgs.outofcore.folders import can_continue, remove_job_files
    from cvtgs.outofcore.memory import WORKER_BYTES, worker_count
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


def block_memory(options: argparse.Namespace, config: "cvtgs.SimplifyConfig") -> int | None:
    """Return the bytes for simplifying in blocks; None if blocks are not needed or not possible."""
    from cvtgs.outofcore.run import check_config

    memory = memory_of(options)
    if options.scheduler is None and not needs_blocks(options, memory, config):
        return None
    try:
        for name in ("target_psnr", "target_ssim", "time_budget"):
            if getattr(options, name) is not None:
                images = "" if name == "time_budget" else " and 400 MB for images of it"
                raise InvalidArgumentError(
                    f"--{name.replace('_', '-')} cannot be used with blocks: it needs memory for "
                    f"the whole scene{images} at once."
                )
        check_block_device(options)
        check_config(config)
        check_given_memory(options, memory, config)
    except (ConfigError, InvalidArgumentError):
        if options.memory is not None or options.scheduler is not None:
            raise
        return None
    return memory


def needs_blocks(options: argparse.Namespace, memory: int, config: "cvtgs.SimplifyConfig") -> bool:
    """Return whether a file does not fit; only binary PLYs can be read in parts, and simplified."""
    from cvtgs.outofcore.memory import IMAGE_BYTES, block_count, merging_rows

    rows = rows_of(options.input)
    if rows is None:
        return False
    target = rows.count
    if not has_target(options):
        target = cvtgs.target_count(
            rows.count, options.rho, count=options.count, max_count=options.max_count
        )
        if target == rows.count:
            return False
    if config.uses_images or has_target(options):
        memory -= IMAGE_BYTES
    merging = merging_rows(target, rows.count, config.allocation)
    return block_count(rows, memory, merging=merging) > 1


def unused_block_options(options: argparse.Namespace) -> list[str]:
    """Return notes on the options of blocks that had no effect on a scene in one piece."""
    notes = []
    if options.memory is not None and rows_of(options.input) is None:
        notes.append("In one piece: --memory has an effect on binary .ply files only.")
    if options.workers is not None:
        notes.append("In one piece: --workers has an effect on blocks only.")
    return notes


def rows_of(path: Path) -> "PlyRows | None":
    """Open a binary PLY, which can be read in parts; return None for other files."""
    from cvtgs.io.ply import open_rows

    try:
        return open_rows(path)
    except (InputError, FileFormatError):
        return None


def simplify_blocks(
    options: argparse.Namespace,
    config: "cvtgs.SimplifyConfig",
    memory: int,
    listener: ProgressListener,
) -> "cvtgs.SimplifyReport":
    """Simplify a file block by block, on this machine or on a cluster."""
    if options.lod:
        raise InvalidArgumentError(
            f"--lod must be 0 unless for a streamed SOG, found {options.lod} for {options.input}."
        )
    with block_workers(options, memory) as (workers, share):
        return cvtgs.outofcore.simplify_file(
            options.input,
            options.output,
            options.rho,
            count=options.count,
            max_count=options.max_count,
            memory=share,
            boxes=() if options.keep is None else cvtgs.boxes.read_boxes(options.keep),
            sh_degree=options.sh_degree,
            source_axes=options.axes.source,
            output_axes=options.axes.target,
            simplifier=cvtgs.Simplifier(checkpoint_of(options), config=config, device="cpu"),
            cameras=read_cameras(options),
            workers=workers,
            overwrite=options.overwrite,
            listener=listener,
        )
