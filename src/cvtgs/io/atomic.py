"""Write a file completely or not at all."""

import ctypes
import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from cvtgs.errors import CvtgsError, OutputError, OutputExistsError

_HERE, _NO_REPLACE = -100, 1
"""AT_FDCWD and RENAME_NOREPLACE of Linux."""

_DISK_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))


def check_output(path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Check that a file could be written, before the work that it takes to fill it.

    Args:
        path: The file to write; symbolic links are followed.
        overwrite: Whether an existing file may be replaced.

    Raises:
        OutputExistsError: The file exists and may not be replaced.
        OutputError: It is not a regular file, or its directory is missing or not writable.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     check_output(Path(folder) / "new.ply")
    """
    target = _target(path)
    try:
        if target.is_dir():
            raise OutputError(f"{os.fspath(path)}: the output must be a file, found a directory.")
        if target.exists() and not target.is_file():
            raise OutputError(
                f"{os.fspath(path)}: the output must be a regular file, found a device or a pipe."
            )
        if target.exists() and not overwrite:
            raise _exists(path)
        if not target.parent.is_dir():
            raise OutputError(
                f"{os.fspath(path)}: the output must be in an existing directory, "
                f"found no directory {os.fspath(target.parent)}."
            )
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise OutputError(
                f"{os.fspath(path)}: the output must be in a writable directory, "
                f"found no permission to write in {os.fspath(target.parent)}."
            )
    except OSError as error:
        if isinstance(error, CvtgsError):
            raise
        raise _failed(path, error) from error


@contextmanager
def atomic_output(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[BinaryIO]:
    """Open a file for writing that appears under its name only when it is complete.

    The content goes to a new file in the same directory, which takes the name at the end, in
    one step. If the body raises anything, the new file is removed and an old one stays as it
    was. Symbolic links are followed; a replaced file keeps its permissions.

    Args:
        path: The file to write.
        overwrite: Whether an existing file may be replaced. If not, a file that appears under
            this name meanwhile is not replaced either.

    Yields:
        The open binary file.

    Raises:
        OutputExistsError: The file exists and may not be replaced.
        OutputError: The file cannot be written (directory missing, no permission, disk full).

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with atomic_output(Path(folder) / "note.txt") as file:
        ...         _ = file.write(b"done")
        ...     (Path(folder) / "note.txt").read_text()
        'done'
    """
    check_output(path, overwrite)
    target = _target(path)
    temporary = target.with_name(f".{target.name[:48]}.{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        _publish(temporary, target, overwrite=overwrite)
    except OSError as error:
        if isinstance(error, CvtgsError) or not _concerns(error, temporary):
            raise
        if isinstance(error, FileExistsError):
            raise _exists(path) from error
        raise _failed(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def _target(path: str | os.PathLike[str]) -> Path:
    return Path(os.path.realpath(path))


def _publish(temporary: Path, target: Path, *, overwrite: bool) -> None:
    """Move the finished file to its name."""
    if overwrite:
        if target.exists():
            temporary.chmod(stat.S_IMODE(target.stat().st_mode))
        temporary.replace(target)
        return
    for take in (_link, _rename):
        try:
            take(temporary, target)
        except FileExistsError:
            raise
        except (OSError, NotImplementedError):  # this system or this disk cannot
            continue
        return
    _claim(temporary, target)


def _link(temporary: Path, target: Path) -> None:
    """Take the name unless it is taken: unlike a rename, a link never replaces."""
    target.hardlink_to(temporary)


def _rename(temporary: Path, target: Path) -> None:
    """Take the name unless it is taken, where there are no hard links (FAT, some shares)."""
    if os.name == "nt":
        temporary.rename(target)  # there it never replaces
        return
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "renameat2"):
        raise NotImplementedError
    names = (os.fsencode(temporary), os.fsencode(target))
    if libc.renameat2(_HERE, names[0], _HERE, names[1], ctypes.c_uint(_NO_REPLACE)):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), os.fspath(target))


def _claim(temporary: Path, target: Path) -> None:
    """Take the name with an empty file, then replace that: only a kill in between leaves it."""
    own = None
    try:
        with target.open("xb") as file:
            own = os.fstat(file.fileno())
        temporary.replace(target)
    except BaseException:
        if own is not None and _is(target, own):
            target.unlink()
        raise


def _is(path: Path, empty: os.stat_result) -> bool:
    """Return whether a path is still the empty file that we made."""
    try:
        found = path.stat()
    except OSError:
        return False
    return os.path.samestat(found, empty) and found.st_size == 0


def _concerns(error: OSError, temporary: Path) -> bool:
    """Return whether an error is about this output, not about other files of the caller."""
    if error.filename is None:
        return True
    return Path(os.fsdecode(error.filename)).parent == temporary.parent


def _exists(path: str | os.PathLike[str]) -> OutputExistsError:
    return OutputExistsError(
        f"{os.fspath(path)}: the output must not exist yet, found a file; pass overwrite=True "
        f"(--overwrite) to replace it."
    )


def _failed(path: str | os.PathLike[str], error: OSError) -> OutputError:
    if error.errno in _DISK_FULL:
        return OutputError(
            f"{os.fspath(path)}: the output needs more space than the disk has left; "
            f"nothing was written."
        )
    reason = (error.strerror or str(error)).lower()
    return OutputError(f"{os.fspath(path)}: the output must be writable, found: {reason}.")
