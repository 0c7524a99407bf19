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
    """Open a regular file, and translate what the system says while it is read."""
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
    """Read a whole file."""
    with open_input(path) as file:
        return file.read()


def read_json(path: Path) -> Any:
    """Parse a JSON file."""
    return parse_json(read_bytes(path), path)


def parse_json(data: bytes, path: str | Path) -> Any:
    """Parse JSON that is read already."""
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
    """Report whether a file is there, also where its folder may not be looked into."""
    return os.path.isfile(path)  # noqa: PTH113 (Path.is_file raises without permission)
