"""The errors and warnings of cvtgs; each also derives from the builtin that it specialises."""

import errno
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Self

from cvtgs.text import printable_name

__all__ = [
    "CheckpointError",
    "ConfigError",
    "CvtgsError",
    "DeviceError",
    "DroppedDataWarning",
    "FileFormatError",
    "GoalError",
    "InputError",
    "InputNotFoundError",
    "InvalidArgumentError",
    "InvalidSceneError",
    "MissingDependencyError",
    "OutOfMemoryError",
    "OutputBusyError",
    "OutputError",
    "OutputExistsError",
    "RunError",
    "TrainingError",
]

_ADDRESS = re.compile(r"(https?|ftp):/")

_NO_MEMORY = re.compile(
    r"(?i)(can.?not|can't|not enough|out of|failed to) (allocate )?memory|bad.?alloc|"
    r"ALLOC_FAILED|failed to map segment|can't start new thread|could not allocate|"
    r"returned NULL without setting an exception|paging file is too small|error code: <1455>"
)
"""Out-of-memory messages of torch, CUDA, dynamic loaders and Python's imports."""

_NO_MEMORY_ON_WINDOWS = (8, 14, 1455)
"""NOT_ENOUGH_MEMORY, OUTOFMEMORY and COMMITMENT_LIMIT of Windows, whose texts are translated."""

BLOCKS_ADVICE = (
    "free some, or simplify a binary .ply block by block: cvtgs simplify IN OUT --memory AMOUNT"
)
"""What to do if a scene needs more memory than there is."""

RENAMINGS: ContextVar[tuple[Callable[[str], str], ...]] = ContextVar("RENAMINGS", default=())
"""What replaces the names of temporary files in warnings, while streams are read."""

_LEFT_OUT: ContextVar[tuple[type[Warning], ...]] = ContextVar("_LEFT_OUT", default=())


class CvtgsError(Exception):
    """Base of every error that cvtgs raises on purpose; its text is one clear sentence."""

    def __str__(self) -> str:  # names of files hold any character; OSError would add numbers
        return printable_name(Exception.__str__(self))


class InvalidArgumentError(CvtgsError, ValueError):
    """An argument is not acceptable (a ratio, a count, a shape)."""


class InvalidSceneError(CvtgsError, ValueError):
    """A scene cannot be used (wrong shape, dtype or device, no valid row)."""


class ConfigError(CvtgsError, ValueError):
    """A configuration has an unknown key, an unknown preset or a value out of range."""


class FileFormatError(CvtgsError, ValueError):
    """A file violates its format; the message names path, property and row."""


class _FileError(CvtgsError, OSError):
    """Base of errors about a file; ``filename`` and ``errno`` are set if they are known."""

    filename: Any
    errno: int | None

    def __reduce__(self) -> tuple[Any, ...]:  # OSError pickles neither without the other
        return type(self), self.args, {"errno": self.errno, "filename": self.filename}

    def about(self, path: str | os.PathLike[str], number: int | None) -> Self:
        """Return the error with the name of its file and the number of the system's error."""
        self.filename, self.errno = os.fspath(path), number
        return self


class InputError(_FileError):
    """The file to read cannot be read (missing, a directory, no permission, a failing disk)."""


class InputNotFoundError(InputError, FileNotFoundError):
    """The file to read does not exist."""


class OutputExistsError(_FileError, FileExistsError):
    """The file to write already exists and overwriting was not requested."""


class OutputError(_FileError):
    """The output could not be written (missing directory, no permission, disk full)."""


class OutputBusyError(OutputError):
    """Another run is writing the same output; the message says which process."""


class DeviceError(CvtgsError, RuntimeError):
    """The requested device does not exist, or does not support the operation."""


class CheckpointError(CvtgsError, ValueError):
    """A MergeNet checkpoint cannot be used."""


class OutOfMemoryError(CvtgsError, MemoryError):
    """There is not enough memory; the message says what to do."""


class TrainingError(CvtgsError, RuntimeError):
    """A training run cannot continue; the message says where it stopped and which file is good."""


class RunError(CvtgsError, RuntimeError):
    """A process that cvtgs started has failed; the message says why."""


class GoalError(CvtgsError, ValueError):
    """No result meets the goal (a quality, a time); the message names the closest one."""


class MissingDependencyError(CvtgsError, ImportError):
    """An optional package is not installed; the message says what to install."""


class DroppedDataWarning(UserWarning):
    """Data of a scene were dropped or clamped; the message says what, how much and why."""


class CameraWarning(UserWarning):
    """Cameras show little of a scene; steps after the first check need not say so again."""


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """Issue a warning at the line of the caller's program that led to it."""
    if issubclass(category, _LEFT_OUT.get()):
        return
    for rename in RENAMINGS.get():
        text = rename(text)
    # Lines of cvtgs are skipped, and those between them: decorators of torch and of contextlib.
    level, frame, skipped = 1, sys._getframe(), {"cvtgs", "contextlib", "torch"}
    while frame.f_back and str(frame.f_globals.get("__name__")).partition(".")[0] in skipped:
        level, frame = level + 1, frame.f_back
    warnings.warn(text, category, stacklevel=level)


@contextmanager
def without_warnings(category: type[Warning] = Warning) -> Iterator[None]:
    """Issue no warnings of cvtgs of a category in this thread; filters are of the whole process."""
    token = _LEFT_OUT.set((*_LEFT_OUT.get(), category))
    try:
        yield
    finally:
        _LEFT_OUT.reset(token)


def reason_of(error: Exception) -> str:
    """Return the text of an operating-system error within a sentence: no number, no path."""
    return (getattr(error, "strerror", None) or str(error)).lower()


def how_to_install(*packages: str) -> str:
    """Return the end of a message about a missing package: the command that installs it."""
    # Shells of all systems know these quotes, which brackets of an extra need.
    words = (f'"{package}"' if "[" in package else package for package in packages)
    return f"install it with python -m pip install {' '.join(words)}"


def is_out_of_memory(error: BaseException) -> bool:
    """Check whether an error of any library means that there is not enough memory."""
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    if getattr(error, "winerror", None) in _NO_MEMORY_ON_WINDOWS:
        return True
    told = isinstance(error, RuntimeError | ImportError | OSError | SystemError)
    return told and _NO_MEMORY.search(str(error)) is not None


@contextmanager
def memory_errors(work: str, advice: str) -> Iterator[None]:
    """Turn the out-of-memory errors of all libraries into one OutOfMemoryError."""
    try:
        yield
    except Exception as error:
        cause = error.__cause__ if isinstance(error, CvtgsError) else error
        if isinstance(error, OutOfMemoryError) or cause is None or not is_out_of_memory(cause):
            raise
        raise OutOfMemoryError(f"{work} needs more memory than is available; {advice}.") from error


def check_path(path: object) -> None:
    """Raise unless a value can be the path of a file or folder."""
    if not isinstance(path, str | os.PathLike) or isinstance(os.fspath(path), bytes):
        kind = "one of bytes" if isinstance(path, os.PathLike) else type(path).__name__
        raise InvalidArgumentError(f"a path must be a str or Path, found {kind}.")
    if not os.fspath(path):
        raise InvalidArgumentError("a path must not be empty, found ''.")


@contextmanager
def input_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn system errors about a file into input errors of cvtgs."""
    try:
        yield
    except CvtgsError:
        raise
    except FileNotFoundError as error:
        found = "a web address; download it first" if _ADDRESS.match(str(path)) else "none"
        text = f"{path}: the file to read must exist, found {found}."
        raise InputNotFoundError(text).about(path, errno.ENOENT) from error
    except OSError as error:
        text = f"{path}: the file must be readable, found: {reason_of(error)}."
        raise InputError(text).about(path, error.errno) from error
