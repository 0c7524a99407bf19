"""Write a file completely or not at all."""

import ctypes
import errno
import os
import secrets
import stat
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PureWindowsPath
from typing import BinaryIO

from cvtgs.errors import CvtgsError, OutputError, OutputExistsError, check_path, reason_of
from cvtgs.text import shown

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_HERE, _NO_REPLACE = -100, 1  # AT_FDCWD and RENAME_NOREPLACE of Linux
_WINDOWS = os.name == "nt"
_RESERVED = {"CON", "PRN", "AUX", "NUL"}
_RESERVED |= {f"{port}{n}" for port in ("COM", "LPT") for n in "123456789"}

_MOST_WRITERS = 16  # concurrent writers of an output whose leftovers are found after a kill
_OLD_SECONDS = 3600  # without locks, a temporary file unchanged for this long is a leftover
_WAITS = (0.05, 0.1, 0.2, 0.4, 0.8)  # seconds, for virus scanners that hold a file on Windows


def check_outputs(
    folder: str | os.PathLike[str], names: Iterable[str], *, overwrite: bool = False
) -> None:
    """Make a folder, and check that files in it could be written, before they are computed."""
    make_folder(folder)
    for name in names:
        check_output(Path(folder) / name, overwrite=overwrite)


def check_output(path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Check that a file could be written, before its content is computed.

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
    check_path(path)
    if "\0" in os.fspath(path):
        raise OutputError(f"{shown(path)}: the output must have a valid name, found a null byte.")
    target = _target(path)
    fault = windows_fault(PureWindowsPath(path)) if _WINDOWS else None
    if fault is not None:
        raise _refusal(path, "have a valid name", fault)
    try:
        with suppress(FileNotFoundError, NotADirectoryError):
            target.lstat()  # since Python 3.14, exists() does not raise on a too long name
        if target.is_symlink():  # realpath follows all links but loops
            raise _refusal(path, "be a file", "a loop of symbolic links")
        if target.is_dir() or os.fspath(path).endswith(("/", os.sep)):
            raise _refusal(path, "be a file", "a directory", errno.EISDIR)
        # a path such as /dev/stdout leads to a pipe or a terminal, but its target does not exist
        if any(one.exists() and not one.is_file() for one in (target, Path(path))):
            raise _refusal(path, "be a regular file", "a device or a pipe")
        if target.exists() and not overwrite:
            raise _exists(path)
        if _WINDOWS and target.exists() and not os.access(target, os.W_OK):
            raise _refusal(path, "be writable", "a read-only file", errno.EACCES)
        for folder in (target.parent, Path(path).parent):  # "missing/.." is not resolved by name
            if not folder.is_dir():
                found = f"no directory {folder}"
                raise _refusal(path, "be in an existing directory", found, errno.ENOENT)
        if not os.access(target.parent, os.W_OK | os.X_OK):
            missing = f"no permission to write in {target.parent}"
            raise _refusal(path, "be in a writable directory", missing, errno.EACCES)
    except OSError as error:
        if isinstance(error, CvtgsError):
            raise
        raise write_error(path, error) from error


@contextmanager
def atomic_output(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[BinaryIO]:
    """Open a file for an atomic write: it appears under its name only when it is complete.

    The content goes to a temporary file in the same directory, which is moved to the name at the
    end, in one step. If the body raises, the temporary file is removed and an existing file does
    not change. Symbolic links are followed; a replaced file keeps its permissions.

    Args:
        path: The file to write.
        overwrite: Whether an existing file may be replaced. If not, a file that appears under
            this name during the write is not replaced either.

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
    check_output(path, overwrite=overwrite)
    target = _target(path)
    temporary, file = None, None
    try:
        temporary, file = _open_temporary(target)
        with file:
            try:
                yield file
                file.flush()
                os.fsync(file.fileno())
                if fcntl is not None:  # still locked, so not seen as a leftover
                    _publish(temporary, target, overwrite=overwrite)
            finally:
                if fcntl is not None and _is_own(temporary, file):
                    temporary.unlink()
        if fcntl is None:
            _publish(temporary, target, overwrite=overwrite)
    except OSError as error:
        named = error.filename
        if isinstance(error, CvtgsError):
            raise
        if named is not None and Path(os.fsdecode(named)).parent != target.parent:
            raise  # of another file of the caller
        if isinstance(error, FileExistsError):
            raise _exists(path) from error
        raise write_error(path, error) from error
    except BaseException:
        if temporary is not None:  # an interrupt may have ended the removal above
            _remove_leftover(temporary)
        raise
    finally:
        if fcntl is None and temporary is not None:
            with suppress(OSError):  # another program holds it; a later run removes it
                temporary.unlink(missing_ok=True)


def write_atomically(path: str | os.PathLike[str], content: bytes, *, overwrite: bool) -> None:
    """Write the whole content of a file as :func:`atomic_output` does."""
    with atomic_output(path, overwrite=overwrite) as file:
        file.write(content)


def make_folder(folder: str | os.PathLike[str]) -> None:
    """Create a folder to write to, unless it exists; symbolic links are followed."""
    try:
        Path(os.path.realpath(folder)).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{os.fspath(folder)}: must be a folder or a new path, found: {reason_of(error)}."
        ) from error


def windows_fault(path: PureWindowsPath) -> str | None:
    """Return why Windows rejects this name or writes to another one; None if it does not."""
    name = path.name
    wrong = sorted({letter for letter in name if letter in '<>:"|?*' or letter < " "})
    if wrong:  # "a.ply:b" is an alternate data stream of a.ply
        return f"the characters {' '.join(wrong)}, which Windows does not allow"
    if name.split(".")[0].rstrip(" ").upper() in _RESERVED:
        return f"{name}, which is a device on Windows"
    if name != name.rstrip(" ."):
        return "a dot or space at its end, which Windows drops"
    return None


def _open_temporary(target: Path) -> tuple[Path, BinaryIO]:
    """Open a temporary file beside a target, and remove those that killed processes left."""
    names = (f".{target.name[:48]}.{number}.tmp" for number in range(_MOST_WRITERS))
    places = [target.with_name(name) for name in names]
    for temporary in places:
        _remove_leftover(temporary)
    for temporary in places:
        try:
            file = temporary.open("xb")
        except FileExistsError:  # another process writes to it
            continue
        except BaseException:  # an interrupt, perhaps after it was created
            _remove_leftover(temporary)
            raise
        if _lock(file.fileno()) and os.fstat(file.fileno()).st_nlink:
            return temporary, file
        file.close()
    temporary = target.with_name(f".{target.name[:48]}.{secrets.token_hex(8)}.tmp")
    return temporary, temporary.open("xb")


def _lock(descriptor: int) -> bool:
    """Lock a file until it is closed; return False if another process holds the lock."""
    if sys.platform == "win32" or fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EWOULDBLOCK, errno.EACCES)  # else locks are unsupported
    return True


def _remove_leftover(temporary: Path) -> None:
    """Remove the temporary file of a killed process, but not one that is still written to."""
    with suppress(OSError):
        if sys.platform == "win32" or fcntl is None:
            if time.time() - temporary.stat().st_mtime > _OLD_SECONDS:
                temporary.unlink()
            return
        descriptor = os.open(temporary, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(descriptor), temporary.lstat()):
                temporary.unlink()
        finally:
            os.close(descriptor)


def _is_own(temporary: Path, file: BinaryIO) -> bool:
    """Return whether a path still names the open file, not one created after it moved."""
    try:
        return os.path.samestat(temporary.lstat(), os.fstat(file.fileno()))
    except (OSError, ValueError):
        return False


def _target(path: str | os.PathLike[str]) -> Path:
    try:
        return Path(os.path.realpath(path))
    except FileNotFoundError as error:  # the working directory was deleted
        raise write_error(path, error) from error
    except UnicodeEncodeError as error:
        raise OutputError(f"{shown(path)}: the output must have a valid name: {error}.") from error


def _publish(temporary: Path, target: Path, *, overwrite: bool) -> None:
    if overwrite:
        if target.exists() and not _WINDOWS:
            temporary.chmod(stat.S_IMODE(target.stat().st_mode))
        replace_file(temporary, target)
        return
    for take in (os.link, _rename):  # unlike a rename, a hard link never replaces
        try:
            take(temporary, target)
        except FileExistsError:
            raise
        except (OSError, NotImplementedError):  # not supported by this system or disk
            continue
        return
    _claim(temporary, target)


def replace_file(source: Path, target: Path) -> None:
    """Move a file, or a folder to a new name."""
    _patiently(source.replace, target)


def _patiently(move: Callable[[Path], object], target: Path) -> None:
    """Move something; on Windows, wait for a moment if another program holds a file of it."""
    for seconds in _WAITS if _WINDOWS else ():
        try:
            move(target)
        except PermissionError:
            time.sleep(seconds)
        else:
            return
    move(target)


def _rename(temporary: Path, target: Path) -> None:
    """Rename unless the name exists, for disks without hard links (FAT, some shares)."""
    if _WINDOWS:
        _patiently(temporary.rename, target)  # on Windows, this never replaces
        return
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "renameat2"):
        raise NotImplementedError
    source, name = os.fsencode(temporary), os.fsencode(target)
    if libc.renameat2(_HERE, source, _HERE, name, ctypes.c_uint(_NO_REPLACE)):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), os.fspath(target))


def _claim(temporary: Path, target: Path) -> None:
    """Create an empty file and replace it; only a kill in between leaves the empty file."""
    own = None
    try:
        with target.open("xb") as file:
            own = os.fstat(file.fileno())
        replace_file(temporary, target)
    except BaseException:
        with suppress(OSError):
            found = target.stat()
            if own is not None and os.path.samestat(found, own) and found.st_size == 0:
                target.unlink()
        raise


def _exists(path: str | os.PathLike[str]) -> OutputExistsError:
    text = (
        f"{os.fspath(path)}: the output must not exist yet, found a file; pass overwrite=True "
        f"(--overwrite) to replace it."
    )
    return OutputExistsError(text).about(path, errno.EEXIST)


def _refusal(
    path: str | os.PathLike[str], required: str, found: str, number: int | None = None
) -> OutputError:
    text = f"{os.fspath(path)}: the output must {required}, found {found}."
    return OutputError(text).about(path, number)


def write_error(path: str | os.PathLike[str], error: OSError) -> OutputError:
    """Return the error for an output that the system refused to write."""
    text = f"{os.fspath(path)}: the output must be writable, found: {reason_of(error)}."
    return OutputError(text).about(path, error.errno)
