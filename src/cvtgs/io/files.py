"""Open the files of scenes and cameras, or say in one sentence why not."""

import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from cvtgs.errors import CvtgsError, FileFormatError, InputError, InputNotFoundError

_POINTER = b"version https://git-lfs."
"""How the few lines start that a clone without Git LFS has in place of a large file."""


@contextmanager
def open_input(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file, and translate what the system says while it is read.

    Args:
        path: The file.

    Yields:
        The open binary file.

    Raises:
        InputNotFoundError: There is no such file.
        InputError: It cannot be opened or read.
        FileFormatError: It only points to a file of Git LFS.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "a").write_bytes(b"text")
        ...     with open_input(Path(folder) / "a") as file:
        ...         file.read()
        b'text'
    """
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):  # opening a pipe would wait for ever
            kind = "directory" if stat.S_ISDIR(mode) else "device or a pipe"
            raise InputError(f"{path}: must be a regular file, found a {kind}.")
        with path.open("rb") as file:
            if file.peek(len(_POINTER)).startswith(_POINTER):
                raise FileFormatError(
                    f"{path}: must be the file itself, found a pointer of Git LFS to it; get the "
                    "file with: git lfs pull."
                )
            yield file
    except CvtgsError:
        raise
    except FileNotFoundError as error:
        raise InputNotFoundError(f"{path}: the file to read must exist, found none.") from error
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{path}: the file must be readable, found: {reason}.") from error


def read_bytes(path: Path) -> bytes:
    """Read a whole file.

    Args:
        path: The file.

    Returns:
        Its content.

    Raises:
        InputNotFoundError: There is no such file.
        InputError: It cannot be opened or read.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "a").write_bytes(b"text")
        ...     read_bytes(Path(folder) / "a")
        b'text'
    """
    with open_input(path) as file:
        return file.read()


def read_json(path: Path) -> Any:
    """Parse a JSON file.

    Args:
        path: The file; UTF-8, with or without a byte order mark.

    Returns:
        What is in it.

    Raises:
        InputNotFoundError: There is no such file.
        InputError: It cannot be opened or read.
        FileFormatError: It is not JSON.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "a.json").write_text("[1, 2]")
        ...     read_json(Path(folder) / "a.json")
        [1, 2]
    """
    return parse_json(read_bytes(path), path)


def parse_json(data: bytes, path: str | Path) -> Any:
    """Parse JSON that is read already.

    Args:
        data: The text; UTF-8, with or without a byte order mark.
        path: Where it stands, for error texts.

    Returns:
        What is in it.

    Raises:
        FileFormatError: It is not JSON.

    Example:
        >>> parse_json(b"[1, 2]", "a.json")
        [1, 2]
    """
    try:
        return json.loads(data.decode("utf-8-sig"))
    except json.JSONDecodeError as error:
        raise FileFormatError(
            f"{path}: must be JSON, found an error in line {error.lineno}, column {error.colno}: "
            f"{error.msg.lower()}."
        ) from error
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{path}: must be JSON in UTF-8, found another byte at {error.start:,}."
        ) from error
    except (RecursionError, ValueError) as error:  # nested without end; numbers without end
        raise FileFormatError(f"{path}: must be plain JSON, found: {error}.") from error


def is_file(path: Path) -> bool:
    """Say whether a file is there, also where its folder may not be looked into.

    Args:
        path: The file.

    Returns:
        Whether there is a regular file that can be seen.

    Example:
        >>> is_file(Path("there is none"))
        False
    """
    return os.path.isfile(path)  # noqa: PTH113 (Path.is_file raises without permission)
