"""Find and open the files of scenes and cameras; every failure is one clear sentence."""

import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from cvtgs.errors import CvtgsError, FileFormatError, InputError, InputNotFoundError

_POINTER = b"version https://git-lfs."
"""How the few lines start that a clone without Git LFS has in place of a large file."""

_ITERATION = re.compile(r"iteration_(\d{1,18})")
_STEP = re.compile(r"step-(\d{1,18})\.ckpt")


@contextmanager
def open_input(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file; what the system refuses, also while it is read, is an InputError."""
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


def is_file(path: Path) -> bool:
    """Return whether there is a file; False where its folder may not be read."""
    return os.path.isfile(path)  # noqa: PTH113 (Path.is_file raises without permission)


def scene_file(path: str | os.PathLike[str]) -> Path:
    """Find the file that holds the scene of a folder.

    It looks for these, in this order:

    - ``point_cloud/iteration_*/point_cloud.ply``, the largest iteration: a model of INRIA's code;
    - ``nerfstudio_models/step-*.ckpt`` or ``step-*.ckpt``, the largest step: a run of Splatfacto;
    - ``point_cloud.ply``;
    - ``lod-meta.json``: a streamed SOG;
    - ``meta.json``: an unbundled SOG.

    Args:
        path: A folder, or a file, which is its own scene.

    Returns:
        The file.

    Raises:
        InputError: There is none of these in the folder, or it cannot be read.

    Example:
        >>> scene_file("scene.ply").name
        'scene.ply'
    """
    folder = Path(path)
    if not os.path.isdir(folder):  # noqa: PTH112 (Path.is_dir raises without permission)
        return folder
    try:
        found = next(_scenes(folder), None)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{folder}: the folder must be readable, found: {reason}.") from error
    if found is None:
        raise InputError(
            f"{folder}: must be a file or the folder of a trained model, found a directory "
            f"without point_cloud/iteration_*/point_cloud.ply, step-*.ckpt, point_cloud.ply, "
            f"lod-meta.json or meta.json."
        )
    return found


def scene_size(path: str | os.PathLike[str]) -> int:
    """Return the size of a scene on the disk.

    Args:
        path: A file, or a folder that :func:`scene_file` finds a scene in.

    Returns:
        Bytes of its file; of an unbundled or a streamed SOG, those of its other files too.

    Example:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile(suffix=".splat") as file:
        ...     scene_size(file.name)
        0
    """
    file = scene_file(path)
    streamed = ("**/*.webp", "**/*.sog", "**/meta.json")
    patterns = {"meta.json": ("*.webp",), "lod-meta.json": streamed}.get(file.name, ())
    parts = [part for pattern in patterns for part in file.parent.glob(pattern)]
    return sum(part.stat().st_size for part in (file, *parts))


def _scenes(folder: Path) -> Iterator[Path]:
    iterations = _numbered(folder / "point_cloud", _ITERATION)
    yield from filter(is_file, (part / "point_cloud.ply" for part in iterations))
    for steps in (folder / "nerfstudio_models", folder):
        yield from filter(is_file, _numbered(steps, _STEP))
    for name in ("point_cloud.ply", "lod-meta.json", "meta.json"):
        if is_file(folder / name):
            yield folder / name


def _numbered(folder: Path, pattern: re.Pattern[str]) -> list[Path]:
    """Return the numbered entries of a folder, the largest number first."""
    if not folder.is_dir():
        return []
    matches = [(pattern.fullmatch(part.name), part) for part in folder.iterdir()]
    numbers = [(int(match[1]), part) for match, part in matches if match]
    return [part for _, part in sorted(numbers, reverse=True)]
