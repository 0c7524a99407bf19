"""The folder of a job: started, continued after an interruption, and removed."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from cvtgs.clock import StageClock
from cvtgs.config.base import Record
from cvtgs.errors import InputError, OutputError, warn
from cvtgs.io.files import is_file, is_folder
from cvtgs.io.locks import hidden_path, lock_path, output_lock
from cvtgs.mergenet import Checkpoint, encode_checkpoint
from cvtgs.outofcore.job import Job
from cvtgs.processes import Workers
from cvtgs.text import size_text

AnyJob = TypeVar("AnyJob", bound=Job)

EXTRA_BYTES = 12  # of the files of blocks for each Gaussian, beyond those of the source


class JobSizes(Record):
    """The sizes of a job that its memory decides."""

    blocks: int
    sample_rows: int
    cell_room: int


@contextmanager
def started(
    job: Job, workers: Workers, clock: StageClock, checkpoint: Checkpoint | None, *, resumes: bool
) -> Iterator[None]:
    """Make the folder of a job, unless it resumes; check the workers, and write the network.

    The body sorts the rows; if it fails or the source changes meanwhile, the folder is removed.
    """
    before = _stamp(job.source.path)
    try:
        if not resumes:
            job.start_over()
            sizes = {name: getattr(job, name) for name in JobSizes.model_fields}
            job.write_file("sizes.json", json.dumps(sizes).encode())
            _warn_of_full_disk(job)
        check: Callable[[Job], object] | None = getattr(workers, "check", None)
        if check is not None:  # workers on other machines
            with clock.stage("workers"):
                check(job)
        if checkpoint is not None:  # a resumed job may find it damaged
            content = encode_checkpoint(checkpoint.net, checkpoint.info)
            job.write_file("network.safetensors", content)
        yield
        if not resumes and _stamp(job.source.path) != before:
            raise InputError(
                f"{job.source.path}: must stay as it is while it is read, found it changed; start "
                "again."
            )
    except BaseException:
        if not resumes:
            shutil.rmtree(Path(job.folder).parent, ignore_errors=True)
        raise


def _warn_of_full_disk(job: Job) -> None:
    """Warn if the files of the blocks will probably not fit on their disk."""
    needed = job.source.count * (job.source.dtype.itemsize + EXTRA_BYTES)
    with suppress(OSError):
        free = shutil.disk_usage(job.folder).free
        if free < needed:
            warn(
                f"{Path(job.folder).parent}: the files of the blocks take some "
                f"{size_text(needed)}, but {size_text(free)} of the disk are free; write the "
                f"output to a larger one."
            )


def _stamp(path: str) -> tuple[int, int] | None:
    """Return size and time of a file; None if it does not exist any more."""
    try:
        stat = Path(path).stat()
    except OSError:
        return None
    return stat.st_size, stat.st_mtime_ns


def in_folder(
    job: AnyJob, output: str | os.PathLike[str], checkpoint: Checkpoint | None, *, adapts: bool
) -> AnyJob:
    """Return a job with its folder, which is named by its key: late workers use that of their job.

    One that adapts gets the sizes of an interrupted run of it, unless that needs more memory.
    """
    parent = hidden_path(output, "blocks")
    for path in parent.glob("*/sizes.json") if adapts else ():
        try:
            sizes = JobSizes.model_validate_json(path.read_bytes())
        except (OSError, ValueError):
            continue
        earlier = replace(job, **sizes.model_dump())
        fits = earlier.blocks >= job.blocks and earlier.sample_rows <= job.sample_rows
        fits = fits and earlier.cell_room <= job.cell_room
        if fits and earlier.key(checkpoint)[:16] == path.parent.name:
            job = earlier
            break
    return replace(job, folder=str(parent / job.key(checkpoint)[:16]))


def can_continue(output: str | os.PathLike[str]) -> bool:
    """Return whether an interrupted run of an output has rows to continue with."""
    return any(hidden_path(output, "blocks").glob("*/sorted.json"))


def remove_job_files(output: str | os.PathLike[str], *, is_stream: bool = False) -> None:
    """Remove the files that interrupted runs of an output left, unless another run uses them."""
    folder = hidden_path(output, "blocks")
    locked = folder if is_stream else output  # commands lock the output of a stream
    if is_folder(folder) or is_file(lock_path(locked)):
        with suppress(OutputError), output_lock(locked):
            shutil.rmtree(folder, ignore_errors=True)
