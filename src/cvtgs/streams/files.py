"""The files of a stream: chunks of one or more parts of a scene, and the index that names them."""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from cvtgs.config.base import Record
from cvtgs.errors import OutputError, OutputExistsError
from cvtgs.io import atomic_output, check_output
from cvtgs.io.atomic import make_folder
from cvtgs.progress import ProgressListener
from cvtgs.streams.plan import Corner, StreamPlan

__all__ = ["INDEX_NAMES", "StreamLevel", "check_stream"]

INDEX_NAMES = {"sog": "lod-meta.json", "3dtiles": "tileset.json"}
"""The file that a viewer opens, by the kind of the stream."""


_OWN_NAME = re.compile(r'"(\d+_\d+\.glb|\d+_\d+_\d+(?=/meta\.json")|environment(?=/meta\.json"))')
"""In an index, what a stream of ours consists of."""


class StreamLevel(NamedTuple):
    """What was written of a level.

    Attributes:
        gaussians: How many.
        files: Files, or folders of files.
        bytes: Bytes of all of them.
    """

    gaussians: int
    files: int
    bytes: int


class StreamPart(Record):
    """What was written of a part of a scene; parts are those that are in memory at once.

    Attributes:
        levels: What was written of each level, the finest first.
        chunks: Number of chunks.
        names: Files as the index names them, in the order in which it counts them.
        tree: The node of the index that holds the part.
        box_min: Least coordinates of its chunks.
        box_max: Largest coordinates.
        environment: File with its part of the environment; None if it has none.
    """

    levels: tuple[StreamLevel, ...]
    chunks: int
    names: tuple[str, ...]
    tree: dict[str, Any]
    box_min: Corner
    box_max: Corner
    environment: str | None = None


class StreamFormat(Protocol):
    """A kind of stream."""

    @property
    def kind(self) -> str:
        """Its name, a key of ``INDEX_NAMES``."""
        ...

    def write_part(
        self, plan: StreamPlan, folder: Path, *, part: int, listener: ProgressListener
    ) -> StreamPart:
        """Write the chunks of a part under names that no other part has.

        Args:
            plan: Levels and chunks of the part.
            folder: Where to write.
            part: Number of the part.
            listener: Called after each file.

        Returns:
            What was written.
        """
        ...

    def index(self, parts: Sequence[StreamPart], folder: Path) -> dict[str, Any]:
        """Return the content of the index, of parts in an order in which neighbours are near.

        Args:
            parts: All parts.
            folder: Where they are, and where files that all parts share are written.

        Returns:
            What is written as JSON.
        """
        ...


def write_stream(
    form: StreamFormat,
    plan: StreamPlan,
    folder: str | os.PathLike[str],
    *,
    overwrite: bool,
    listener: ProgressListener,
) -> tuple[StreamLevel, ...]:
    """Write a stream of one part; all of it is there, or nothing."""
    place = Path(folder)
    check_stream(place, form.kind, overwrite=overwrite)
    with _hidden_folder(place) as hidden:
        part = form.write_part(plan, hidden, part=0, listener=listener)
        write_index(form, [part], hidden)
        publish(hidden, place, form.kind, overwrite=overwrite)
    return part.levels


def write_index(form: StreamFormat, parts: Sequence[StreamPart], folder: Path) -> None:
    """Write the index of parts that are in a folder."""
    content = json.dumps(form.index(parts, folder), separators=(",", ":"))
    with atomic_output(folder / INDEX_NAMES[form.kind], overwrite=True) as file:
        file.write(content.encode())


def join_levels(parts: Sequence[StreamPart]) -> tuple[StreamLevel, ...]:
    """Add up what was written of each level."""
    levels = zip(*(part.levels for part in parts), strict=True)
    return tuple(StreamLevel(*map(sum, zip(*level, strict=True))) for level in levels)


def join_trees(
    parts: Sequence[StreamPart],
    leaf: Callable[[int], dict[str, Any]],
    inner: Callable[[Corner, Corner, list[dict[str, Any]]], dict[str, Any]],
) -> dict[str, Any]:
    """Build the tree above parts: each node holds half of the parts of the one above.

    Args:
        parts: The parts.
        leaf: Returns the node of a part, by its number.
        inner: Returns a node of its box and its children.

    Returns:
        The root.
    """

    def node(numbers: range) -> dict[str, Any]:
        if len(numbers) == 1:
            return leaf(numbers[0])
        middle = len(numbers) // 2
        own = [parts[number] for number in numbers]
        low, high = join_boxes([part.box_min for part in own], [part.box_max for part in own])
        return inner(low, high, [node(numbers[:middle]), node(numbers[middle:])])

    return node(range(len(parts)))


def join_boxes(lows: Sequence[Corner], highs: Sequence[Corner]) -> tuple[Corner, Corner]:
    """Return the box around boxes."""
    x, y, z = map(min, zip(*lows, strict=True))
    right, down, far = map(max, zip(*highs, strict=True))
    return (x, y, z), (right, down, far)


def check_stream(folder: str | os.PathLike[str], kind: str, *, overwrite: bool = False) -> None:
    """Check that a stream could be written, before the long work that comes first.

    Args:
        folder: Where to write; made if it is missing.
        kind: ``sog`` or ``3dtiles``.
        overwrite: Whether files of an earlier stream may be replaced.

    Raises:
        OutputExistsError: There is a stream that may not be replaced, or something else that is
            not a stream of this kind.
        OutputError: Nothing can be written there.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as parent:
        ...     check_stream(Path(parent) / "new", "sog")
    """
    place = Path(folder)
    if not place.exists():
        check_output(place)  # its parent is there and writable
        return
    index = place / INDEX_NAMES[kind]
    check_output(index, overwrite)
    if not index.exists() and _has_files(place):
        raise OutputExistsError(
            f"{place}: a stream needs an empty folder, or one with {INDEX_NAMES[kind]} to replace, "
            f"found other files."
        )


@contextmanager
def _hidden_folder(place: Path) -> Iterator[Path]:
    """Make a hidden folder beside a folder to write; it is gone at the end."""
    target = Path(os.path.realpath(place))
    hidden = target.with_name(f".{target.name}.stream")
    if target.is_dir() and not os.access(target.parent, os.W_OK | os.X_OK):
        hidden = target / ".stream"
    shutil.rmtree(hidden, ignore_errors=True)
    make_folder(hidden, parents=False)
    try:
        yield hidden
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


def publish(hidden: Path, place: Path, kind: str, *, overwrite: bool) -> None:
    """Move the files of a finished stream to where they belong, the index last.

    Hidden files stay: they are for a run that continues.
    """
    check_stream(place, kind, overwrite=overwrite)
    index, target = INDEX_NAMES[kind], Path(os.path.realpath(place))
    try:
        if not target.exists() or not any(target.iterdir()):  # then all of them at once
            if target.exists():
                target.rmdir()
            hidden.rename(target)
            for path in target.glob(".*"):
                path.unlink()
            return
    except OSError as error:
        raise _refused(place, error) from error
    found = [path.name for path in hidden.iterdir()]
    names = [name for name in found if name != index and not name.startswith(".")]
    old = _names_of(place / index) - {*names}
    try:
        for name in [*names, index]:
            if (place / name).is_dir():
                _remove(place / name)
            (hidden / name).replace(place / name)
        for name in old:  # of the stream before, which had more of them
            _remove(place / name)
    except OSError as error:
        raise _refused(place, error) from error


def _names_of(index: Path) -> set[str]:
    """Return the files and folders of ours that an index names."""
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
    reason = (error.strerror or str(error)).lower()
    return OutputError(f"{place}: must take the files of a stream, found: {reason}.")


def _has_files(folder: Path) -> bool:
    """Return whether there is anything but hidden files, such as locks."""
    return any(not path.name.startswith(".") for path in folder.iterdir())
