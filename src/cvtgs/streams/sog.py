"""Write a streamed SOG: ``lod-meta.json`` of version 1 and the SOGs that it names."""

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from cvtgs.errors import OutputExistsError
from cvtgs.io import atomic_output, check_output
from cvtgs.io.sog import encode_sog
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.streams.plan import StreamNode, StreamPlan

__all__ = ["INDEX_NAMES", "StreamLevel", "check_stream", "write_sog_stream"]

INDEX_NAMES = {"sog": "lod-meta.json", "3dtiles": "tileset.json"}
"""The file that a viewer opens, by the kind of the stream."""

FILE_GAUSSIANS = 1 << 18
"""Gaussians in a file, at most, unless a chunk has more."""


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


class _Unit(NamedTuple):
    """A SOG: consecutive chunks of a level."""

    name: str
    level: int
    chunks: range
    rows: Int[Tensor, "n"]


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
    if not index.exists() and any(place.iterdir()):
        raise OutputExistsError(
            f"{place}: a stream needs an empty folder, or one with {INDEX_NAMES[kind]} to replace, "
            f"found other files."
        )


def write_sog_stream(
    plan: StreamPlan,
    folder: str | os.PathLike[str],
    *,
    file_gaussians: int = FILE_GAUSSIANS,
    overwrite: bool = False,
    listener: ProgressListener = silent,
) -> tuple[StreamLevel, ...]:
    """Write a streamed SOG, as PlayCanvas' engine and SuperSplat's viewer load it.

    Chunks of a level lie one behind the other in SOGs of bounded size, so that what is near is in
    one file. ``lod-meta.json`` is written at last.

    Args:
        plan: Levels and chunks.
        folder: Where to write; made if it is missing.
        file_gaussians: Gaussians in a SOG, at most; a chunk is never cut.
        overwrite: Whether files of an earlier stream may be replaced.
        listener: Called after each SOG.

    Returns:
        What was written of each level, the finest first.

    Raises:
        OutputExistsError: There is something that may not be replaced.
        OutputError: A file cannot be written.
        InvalidSceneError: A Gaussian is not finite.

    Example:
        >>> import tempfile
        >>> import cvtgs
        >>> from cvtgs.streams import plan_stream
        >>> scene = cvtgs.synthetic.scene("object", 500)
        >>> levels = cvtgs.Simplifier(device="cpu").levels(scene, [0.5, 0.05])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = write_sog_stream(plan_stream(levels, chunk_gaussians=100), folder)
        ...     [len(cvtgs.load(folder, lod=lod)) for lod in (0, 1)]
        [250, 25]
    """
    place = Path(folder)
    check_stream(place, "sog", overwrite=overwrite)
    place.mkdir(exist_ok=True)
    units = list(_units(plan, file_gaussians))
    sizes = [0] * len(plan.levels)
    for number, unit in enumerate(units):
        scene = plan.levels[unit.level].scene
        encoded = encode_sog(scene.select(unit.rows.to(scene.device)))
        (place / unit.name).mkdir(exist_ok=True)
        for name, content in encoded.files():
            with atomic_output(place / unit.name / name, overwrite=True) as file:
                file.write(content)
            sizes[unit.level] += len(content)
        listener(ProgressEvent(stage="write", done=number + 1, total=len(units)))
    with atomic_output(place / INDEX_NAMES["sog"], overwrite=overwrite) as file:
        file.write(json.dumps(_document(plan, units), separators=(",", ":")).encode())
    return tuple(
        StreamLevel(len(level.scene), sum(unit.level == number for unit in units), size)
        for number, (level, size) in enumerate(zip(plan.levels, sizes, strict=True))
    )


def _units(plan: StreamPlan, most: int) -> Iterator[_Unit]:
    """Return the SOGs of all levels, the coarsest level first."""
    for level in reversed(range(len(plan.levels))):
        counts = [len(chunk.rows[level]) for chunk in plan.chunks]
        for number, chunks in enumerate(_packed(counts, most)):
            rows = torch.cat([plan.chunks[chunk].rows[level] for chunk in chunks])
            if len(rows):
                yield _Unit(f"{level}_{number}", level, chunks, rows)


def _packed(counts: Sequence[int], most: int) -> Iterator[range]:
    """Return runs of chunks with at most so many Gaussians, or of a single chunk."""
    start = total = 0
    for chunk, count in enumerate(counts):
        if total and total + count > most:
            yield range(start, chunk)
            start, total = chunk, 0
        total += count
    yield range(start, len(counts))


def _document(plan: StreamPlan, units: Sequence[_Unit]) -> dict[str, Any]:
    places: list[dict[str, Any]] = [{} for _ in plan.chunks]
    for number, unit in enumerate(units):
        offset = 0
        for chunk in unit.chunks:
            count = len(plan.chunks[chunk].rows[unit.level])
            if count:
                place = {"file": number, "offset": offset, "count": count}
                places[chunk][str(unit.level)] = place
            offset += count
    counts = [len(level.scene) for level in plan.levels]

    def node(one: StreamNode) -> dict[str, Any]:
        bound = {"min": list(one.box_min), "max": list(one.box_max)}
        if one.chunk is not None:
            return {"bound": bound, "lods": dict(sorted(places[one.chunk].items()))}
        return {"bound": bound, "children": [node(child) for child in one.children]}

    return {
        "version": 1,
        "asset": {"generator": "cvtgs"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(counts),
        "lodErrors": False,
        "filenames": [f"{unit.name}/meta.json" for unit in units],
        "tree": node(plan.root),
    }
