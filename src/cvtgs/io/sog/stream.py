"""Read a streamed SOG: ``lod-meta.json`` with a tree of chunks, and SOGs with rows of chunks."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import torch
from pydantic import Field

from cvtgs.counts import whole_number
from cvtgs.edit import concatenate
from cvtgs.errors import FileFormatError, InvalidArgumentError
from cvtgs.io.files import (
    LONGEST_NAME,
    Document,
    Items,
    Size,
    Text,
    Whole,
    check_expansion,
    is_within,
    read_json,
    scene_size,
    validated,
)
from cvtgs.io.sog.read import META, read_sog
from cvtgs.scene import GaussianScene
from cvtgs.text import shown


class _LodMeta(Document):
    version: Annotated[Whole, Field(ge=1, le=1, description="1")] | None = None
    lodLevels: Annotated[Whole, Field(ge=1, description="1 or more")]  # noqa: N815
    counts: Annotated[list[Size], Field(description="a list of whole numbers")] | None = None
    filenames: Annotated[list[Text], Field(description="a list of strings")]
    environment: Text | None = None
    tree: Annotated[dict[str, Any], Field(description="a JSON object")]


class _Rows(Document):
    file: Size
    offset: Size = 0
    count: Size


class _LodNode(Document):
    lods: Annotated[dict[str, Any], Field(description="a JSON object")] | None = None
    children: Items = Field(default_factory=list)


def read_lod_sog(path: Path, *, lod: int = 0, trust_sizes: bool = False) -> GaussianScene:
    """Read one level of a streamed SOG, the format of splat-transform and PlayCanvas' engine.

    Args:
        path: The ``lod-meta.json``; its SOGs are in its folder.
        lod: The level, 0 for the finest. Chunks without this level give their next coarser level,
            or their coarsest, unless the others hold as many Gaussians as the file states.
        trust_sizes: Whether images may unpack to any size.

    Returns:
        The Gaussians of the level, file by file, and those of the environment.

    Raises:
        InputError: A file is missing, or cannot be opened or read.
        FileFormatError: It is not a streamed SOG, damaged, or names files outside its folder.
        InvalidArgumentError: The level does not exist.
    """
    meta = validated(_LodMeta, read_json(path), str(path))
    if not 0 <= whole_number(lod) < meta.lodLevels:
        raise InvalidArgumentError(
            f"lod must be from 0 to {meta.lodLevels - 1}, the levels of {path}, found {shown(lod)}."
        )
    places = list(_places(meta, lod, path))
    own = [rows for level, rows in places if level == lod]
    stated = None if meta.counts is None else meta.counts[lod : lod + 1]
    found = sum(rows.count for rows in own)
    complete = len(own) == len(places) or (found > 0 and stated == [found])
    ranges: dict[int, list[range]] = {}
    for rows in own if complete else [rows for _, rows in places]:
        if rows.count:
            part = range(rows.offset, rows.offset + rows.count)
            ranges.setdefault(rows.file, []).append(part)
    _check_count(meta, ranges, lod if complete else None, path)
    names = [(meta.filenames[number], parts) for number, parts in sorted(ranges.items())]
    sources = [(_inside(path, name), parts) for name, parts in names]
    if meta.environment:
        sources.append((_inside(path, meta.environment), []))
    if not sources:
        raise FileFormatError(f"{path}: level {lod} must hold at least one Gaussian, found none.")
    if len(dict(sources)) < len(sources):  # a short file could make reading take hours
        raise FileFormatError(f"{path}: each file must be in 'filenames' or 'environment' once.")
    stored = sum(scene_size(source) for source, _ in sources)
    scenes: list[GaussianScene] = []
    for source, parts in sources:
        scenes.append(_read_rows(source, parts, trust_sizes=trust_sizes))
        if not trust_sizes:  # many small files
            count, degree = sum(map(len, scenes)), max(scene.sh_degree for scene in scenes)
            check_expansion(path, count=count, sh_degree=degree, stored=stored)
    return concatenate(scenes, fill=True)


def _places(meta: _LodMeta, lod: int, path: Path) -> Iterator[tuple[int, _Rows]]:
    """Yield the rows of every chunk at ``lod`` or the level that stands for it, and that level."""
    for chunk, levels in enumerate(_chunks(meta.tree, path)):
        wrong = [key for key in levels if not (key.isascii() and key.isdigit() and len(key) < 4)]
        if wrong:
            raise FileFormatError(
                f"{path}: chunk {chunk}: levels must be whole numbers, found {shown(wrong[0])}."
            )
        if not levels:
            continue
        numbers = sorted(map(int, levels))
        level = next((number for number in numbers if number >= lod), numbers[-1])
        rows = validated(_Rows, levels[str(level)], f"{path}: chunk {chunk}, level {level}")
        if rows.file >= len(meta.filenames):
            raise FileFormatError(
                f"{path}: filenames has {len(meta.filenames):,} entries, found number {rows.file}."
            )
        yield level, rows


def _chunks(tree: dict[str, Any], path: Path) -> Iterator[dict[str, Any]]:
    """Yield the levels of every leaf of the tree."""
    waiting: list[Any] = [tree]
    while waiting:
        node = validated(_LodNode, waiting.pop(), f"{path}: a node")
        if node.lods is not None:
            yield node.lods
        else:
            waiting += reversed(node.children)


def _check_count(
    meta: _LodMeta, ranges: dict[int, list[range]], lod: int | None, path: Path
) -> None:
    """Refuse rows that are in two chunks, and a total other than the file states."""
    for number, parts in ranges.items():
        parts.sort(key=lambda part: part.start)
        for before, after in pairwise(parts):
            if after.start < before.stop:
                raise FileFormatError(
                    f"{path}: each row of a file must be in one chunk, found row {after.start:,} "
                    f"of {shown(meta.filenames[number])} in two."
                )
    if meta.counts is None or lod is None:
        return
    total = sum(len(part) for parts in ranges.values() for part in parts)
    if len(meta.counts) != meta.lodLevels or meta.counts[lod] != total:
        raise FileFormatError(
            f"{path}: 'counts' must hold the number of Gaussians of each of {meta.lodLevels} "
            f"levels, found {shown(meta.counts)} and {total:,} in the chunks of level {lod}."
        )


def _inside(path: Path, name: str) -> Path:
    """Return the path of a SOG of the stream, which must be in its folder."""
    pure = PurePosixPath(name)
    is_sog = pure.name == META or pure.suffix == ".sog"
    if not is_sog or not is_within(name) or len(name) > LONGEST_NAME:
        raise FileFormatError(
            f"{path}: the files of a stream must be {META} or .sog in its folder, with names of at "
            f"most {LONGEST_NAME} characters, found {shown(name)}."
        )
    return path.parent / pure


def _read_rows(source: Path, parts: Sequence[range], *, trust_sizes: bool) -> GaussianScene:
    """Read ranges of rows of a SOG, in ascending order; all rows if no range is given."""
    scene = read_sog(source, trust_sizes=trust_sizes)
    if parts and parts[-1].stop > len(scene):
        raise FileFormatError(
            f"{source}: the stream needs {parts[-1].stop:,} Gaussians, found {len(scene):,}."
        )
    if not parts or sum(map(len, parts)) == len(scene):
        return scene
    rows = [torch.arange(part.start, part.stop, device="cpu") for part in parts]
    return scene.select(torch.cat(rows))
