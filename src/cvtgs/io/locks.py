"""Locks beside outputs, so that one run at a time works on each; they name their holder."""

import json
import os
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from hashlib import sha256
from pathlib import Path

from cvtgs.errors import OutputBusyError, OutputError, reason_of
from cvtgs.io.files import LONGEST_NAME, is_folder


@contextmanager
def output_lock(path: str | os.PathLike[str]) -> Iterator[None]:
    """Hold the lock of an output, a hidden file, which the system releases after a kill."""
    from filelock import FileLock, SoftFileLock, Timeout  # noqa: PLC0415 (loaded when used)

    file = lock_path(path)
    lock = FileLock(file, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise OutputBusyError(
            f"{os.fspath(path)}: only one run at a time may work on it, found {_holder(file)} at "
            "work; wait until it ends, or choose another output."
        ) from error
    except (OSError, NotImplementedError) as error:
        raise OutputError(
            f"{os.fspath(path)}: its folder must allow a lock file, found: {reason_of(error)}."
        ) from error
    is_soft = isinstance(lock, SoftFileLock)  # its file has its own content
    try:
        if not is_soft:
            command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:2]]) if sys.argv else "python"
            holder = {"process": os.getpid(), "host": socket.gethostname(), "command": command}
            holder["since"] = time.strftime("%Y-%m-%d %H:%M:%S")
            with suppress(OSError):  # a locked file cannot be written to on Windows
                file.write_text(json.dumps(holder), encoding="utf-8")
        yield
    finally:
        if os.name == "posix" and not is_soft:  # while locked, so no other lock is removed
            with suppress(OSError):
                file.unlink()
        lock.release()


@contextmanager
def folder_lock(path: str | os.PathLike[str]) -> Iterator[None]:
    """Hold the lock of a folder to write to; no lock if it takes no files, as the writer says."""
    place = lock_path(path).parent
    usable = place.is_dir() and os.access(place, os.W_OK | os.X_OK)
    with output_lock(path) if usable else nullcontext():
        yield


def lock_path(path: str | os.PathLike[str]) -> Path:
    """Return the lock file of an output, a hidden path."""
    return hidden_path(path, "lock")


def hidden_path(path: str | os.PathLike[str], ending: str) -> Path:
    """Return a hidden path beside an output, from which files can be moved to it.

    It is in a folder whose parent is not writable or on another disk, such as a volume of Docker.
    """
    target = Path(os.path.realpath(path))
    is_apart = os.path.ismount(target) or not os.access(target.parent, os.W_OK | os.X_OK)
    if is_folder(target) and is_apart:
        return target / f".{ending}"
    name = f".{target.name}.{ending}"
    own = os.fsencode(target.name)
    if len(own) <= LONGEST_NAME < len(os.fsencode(name)):  # no file can have a longer name
        start = own[: LONGEST_NAME // 2].decode(errors="ignore")
        name = f".{start}.{sha256(own).hexdigest()[:16]}.{ending}"
    return target.with_name(name)


def _holder(file: Path) -> str:
    """Describe the process that holds a lock, as far as it is known."""
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        return "process {process} on {host} ({command}, since {since})".format_map(found)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return "another process"
