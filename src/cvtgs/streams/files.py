"""The files of a stream: the chunks of one or more parts of a scene, and an index of them."""

import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import pydantic

from cvtgs.boxes import Corner
from cvtgs.clock import check_listener
from cvtgs.config.base import Record
from cvtgs.errors import (
    DroppedDataWarning,
    InvalidArgumentError,
    OutputError,
    OutputExistsError,
    check_path,
    reason_of,
    warn,
)
from cvtgs.io import check_output
from cvtgs.io.atomic import make_folder, replace_file, write_atomically
from cvtgs.io.limits import phrases
from cvtgs.io.locks import hidden_path
from cvtgs.progress import ProgressListener
from cvtgs.streams.plan import StreamPlan, join_boxes

INDEX_NAMES = {"sog": "lod-meta.json", "3dtiles": "tileset.json"}
"""The file that a viewer opens, by the kind of the stream."""

_OWN = r"\d+_\d+\.glb|\d+_\d+_\d+|environment"
"""Matches the names of files and folders that cvtgs itself can have written."""

_OWN_NAME = re.compile(r'"(\d+_\d+\.glb|\d+_\d+_\d+(?=/meta\.json")|environment(?=/meta\.json"))')
"""Matches these names in an index."""


class StreamLevel(NamedTuple):
    """Counts of a written level.

    Attributes:
        gaussians: Number of Gaussians.
        files: Number of files, or of folders of files.
        bytes: Total bytes of the files.
    """

    gaussians: int
    files: int
    bytes: int


class StreamPart(Record):
    """A written part of a scene; a part is the share that is in memory at once."""

    levels: tuple[StreamLevel, ...]  # the finest first
    chunks: int
    names: tuple[str, ...]  # of files as in the index, in the order of its file numbers
    tree: dict[str, Any]  # the node of the index that holds the part
    box_min: Corner
    box_max: Corner
    dropped: dict[str, int]  # as :func:`cvtgs.io.limits.dropped_within` returns it
    far: tuple[int, ...] = ()  # Gaussians of each level in no chunk; empty if there are none
    environments: dict[int, str] = pydantic.Field(default_factory=dict)
    """Files with them by level, from the finest that can be the environment, without empty ones."""


class StreamFormat(Protocol):
    """A format of streams."""

    @property
    def kind(self) -> str:
        """Name of the format, a key of ``INDEX_NAMES``."""
        ...

    def write_part(
        self, plan: StreamPlan, folder: Path, *, part: int, listener: ProgressListener
    ) -> StreamPart:
        """Write the chunks of a part, by its number, under names that no other part uses."""
        ...

    def index(self, parts: Sequence[StreamPart], folder: Path) -> dict[str, Any]:
        """Return the index of parts in spatial order; write the files that they share."""
        ...


def write_stream(
    form: StreamFormat,
    plan: StreamPlan,
    folder: str | os.PathLike[str],
    *,
    overwrite: bool,
    listener: ProgressListener,
) -> tuple[StreamLevel, ...]:
    """Write a stream of one part; either all files are written or none."""
    check_stream(folder, form.kind, overwrite=overwrite)
    check_listener(listener)
    place = Path(folder)
    hidden = hidden_path(place, "stream")
    shutil.rmtree(hidden, ignore_errors=True)
    try:
        make_folder(hidden)
        part = form.write_part(plan, hidden, part=0, listener=listener)
        publish(form, [part], hidden, place, overwrite=overwrite)
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
    return part.levels


def _warn_of_losses(parts: Sequence[StreamPart], place: Path) -> None:
    """Warn once of data that the files of the parts do not hold, with the sums of their counts."""
    dropped = Counter[str]()
    for part in parts:
        dropped.update(part.dropped)
    if dropped:
        warn(
            f"{place}: the files of this stream, all levels together, do not hold "
            f"{'; '.join(phrases(dropped))}.",
            DroppedDataWarning,
        )


def join_levels(parts: Sequence[StreamPart]) -> tuple[StreamLevel, ...]:
    """Add up the counts of each level over all parts."""
    levels = zip(*(part.levels for part in parts), strict=True)
    return tuple(StreamLevel(*map(sum, zip(*level, strict=True))) for level in levels)


def join_trees(
    parts: Sequence[StreamPart],
    leaves: Sequence[dict[str, Any]],
    inner: Callable[[Corner, Corner, list[dict[str, Any]]], dict[str, Any]],
) -> dict[str, Any]:
    """Return the root of a tree above parts, whose nodes are ``leaves``; each node has two halves.

    ``inner`` returns an inner node from the corners of its box and its children.
    """
    if len(parts) == 1:
        return leaves[0]
    low, high = join_boxes((part.box_min, part.box_max) for part in parts)
    middle = len(parts) // 2
    halves = (slice(None, middle), slice(middle, None))
    return inner(low, high, [join_trees(parts[half], leaves[half], inner) for half in halves])


def check_stream(folder: str | os.PathLike[str], kind: str, *, overwrite: bool = False) -> None:
    """Check that a stream can be written, before the long work starts."""
    if not isinstance(kind, str) or kind not in INDEX_NAMES:
        names = " or ".join(INDEX_NAMES)
        raise InvalidArgumentError(f"kind of a stream must be {names}, found {kind!r}.")
    check_path(folder)
    place = Path(folder)
    if not os.path.exists(place):  # noqa: PTH110 (false for impossible names)
        check_output(place)  # checks that its parent exists and is writable
        return
    index = place / INDEX_NAMES[kind]
    check_output(index, overwrite=overwrite)
    # Hidden files do not matter: locks are such.
    if not index.exists() and any(not path.name.startswith(".") for path in place.iterdir()):
        raise OutputExistsError(
            f"{place}: a stream needs an empty folder, or one with {INDEX_NAMES[kind]} to replace, "
            f"found other files."
        )


def publish(
    form: StreamFormat, parts: Sequence[StreamPart], hidden: Path, place: Path, *, overwrite: bool
) -> None:
    """Write the index of all parts, and move their files to the output folder."""
    index = INDEX_NAMES[form.kind]
    content = json.dumps(form.index(parts, hidden), separators=(",", ":"))
    write_atomically(hidden / index, content.encode(), overwrite=True)
    _warn_of_losses(parts, place)
    check_stream(place, form.kind, overwrite=overwrite)
    _move(hidden, place, index)


def _move(hidden: Path, place: Path, index: str) -> None:
    """Move the files of a stream, but hidden ones, to the output folder, the index last.

    Replaced files are set aside, the index first, which thus never names files of another stream.
    """
    target = Path(os.path.realpath(place))
    try:
        if not target.exists():  # then one rename publishes all files
            replace_file(hidden, target)
            for path in target.glob(".*"):
                _remove(path)
            return
    except OSError as error:
        raise _refused(place, error) from error
    # A folder that exists is kept: it has permissions, and may be the current one of a shell.
    found = {path.name for path in hidden.iterdir()}
    names = sorted(name for name in found if name != index and not name.startswith("."))
    old = [index, *sorted({*names, *_names_of(place / index)})]
    aside = hidden / ".replaced"
    moves = [(place / name, aside / name) for name in old if os.path.lexists(place / name)]
    moves += [(hidden / name, place / name) for name in (*names, index)]
    try:
        _remove(aside)  # of an earlier run
        aside.mkdir()
        for source, goal in moves:
            replace_file(source, goal)
    except BaseException as error:
        for source, goal in reversed(moves) if (hidden / index).exists() else ():
            if not os.path.lexists(source):  # it was moved, even if an interrupt came right after
                with suppress(OSError):
                    replace_file(goal, source)  # a resumed run needs it there
        if isinstance(error, OSError):
            raise _refused(place, error) from error
        raise
    with suppress(OSError):
        _remove(aside)


def is_replaced(name: str, kind: str) -> bool:
    """Return whether a stream may replace a file or folder of this name in its folder."""
    return name == INDEX_NAMES[kind] or re.fullmatch(_OWN, name) is not None


def _names_of(index: Path) -> set[str]:
    """Return the files and folders in an index that cvtgs itself can have written."""
    try:
        text = index.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return set()
    return set(_OWN_NAME.findall(text))


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _refused(place: Path, error: OSError) -> OutputError:
    reason = reason_of(error)
    return OutputError(f"{place}: must be writable for the files of a stream, found: {reason}.")
