"""The folder of a job: made by one run, found and continued by another, and removed."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from cvtgs.clock import StageClock
from cvtgs.errors import InputError, OutputError, reason_of
from cvtgs.io.files import is_file, is_folder
from cvtgs.io.locks import hidden_path, lock_path, output_lock
from cvtgs.mergenet import Checkpoint, encode_checkpoint
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.memory import warn_of_full_disk
from cvtgs.processes import Workers

AnyJob = TypeVar("AnyJob", bound=Job)

SIZES = ("blocks", "sample_rows", "cell_room")  # attributes of a job that its memory decides


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
            _make_empty(Path(job.folder))
            sizes = {name: getattr(job, name) for name in SIZES}
            job.write_file("sizes.json", json.dumps(sizes).encode())
            warn_of_full_disk(job.folder, job.file_bytes)
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


def _make_empty(folder: Path) -> None:
    """Make an empty folder; remove files that earlier jobs of this output left."""
    shutil.rmtree(folder.parent, ignore_errors=True)
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise OutputError(
            f"{folder.parent}: must be replaceable by an empty folder for block files, "
            f"found: {reason_of(error)}."
        ) from error


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
            found = json.loads(path.read_bytes())
            sizes: dict[str, Any] = {name: int(found[name]) for name in SIZES}
            earlier = replace(job, **sizes)
        except (OSError, ValueError, KeyError, TypeError):
            continue
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
