"""Write 3D Tiles 1.1: ``tileset.json``, and glTF tiles with SPZ inside, as CesiumJS loads them."""

import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from cvtgs.io import atomic_output
from cvtgs.io.axes import SCENE_AXES, change_axes
from cvtgs.io.gltf import write_spz_glb
from cvtgs.io.gltf.document import AXES, SPLATS, SPZ
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.streams.plan import Corner, StreamNode, StreamPlan
from cvtgs.streams.sog import INDEX_NAMES, StreamLevel, check_stream

__all__ = ["write_tiles"]

TILE_GAUSSIANS = 1 << 16
"""Gaussians in a tile, at most, unless it holds the coarsest level or a single chunk."""

ERROR_PIXELS = 16.0
"""Viewers refine where the error of a tile covers more pixels than this, by default; it is to be
where Gaussians are off by one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tile:
    """A tile: some consecutive chunks at one level, and the tiles that replace it."""

    node: StreamNode
    level: int
    chunks: range
    children: list["_Tile"] = field(default_factory=list)


def write_tiles(
    plan: StreamPlan,
    folder: str | os.PathLike[str],
    *,
    tile_gaussians: int = TILE_GAUSSIANS,
    overwrite: bool = False,
    listener: ProgressListener = silent,
) -> tuple[StreamLevel, ...]:
    """Write 3D Tiles.

    The root holds the coarsest level of the whole scene. Each tile is replaced by those of its
    parts at a finer level, down to the finest level of single chunks. Tiles have the axes of glTF,
    boxes those of 3D Tiles (z up). ``tileset.json`` is written at last.

    Args:
        plan: Levels and chunks.
        folder: Where to write; made if it is missing.
        tile_gaussians: Gaussians in a tile, at most; a chunk is never cut.
        overwrite: Whether files of an earlier stream may be replaced.
        listener: Called after each tile.

    Returns:
        What was written of each level, the finest first. A level may be in more than one depth of
        the tree; its tiles are counted once each.

    Raises:
        OutputExistsError: There is something that may not be replaced.
        OutputError: A file cannot be written.
        InvalidSceneError: No Gaussian of a tile is finite.

    Example:
        >>> import tempfile
        >>> import cvtgs
        >>> from cvtgs.streams import plan_stream
        >>> scene = cvtgs.synthetic.scene("object", 500)
        >>> levels = cvtgs.Simplifier(device="cpu").levels(scene, [0.5, 0.05])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     written = write_tiles(plan_stream(levels, chunk_gaussians=100), folder)
        ...     len(cvtgs.load(f"{folder}/0.glb")), written[0].gaussians
        (25, 250)
    """
    place = Path(folder)
    check_stream(place, "3dtiles", overwrite=overwrite)
    place.mkdir(exist_ok=True)
    root = _tiles(plan, tile_gaussians)
    tiles = list(_listed(root))
    names = {id(tile): f"{number}.glb" for number, tile in enumerate(tiles)}
    counts, files, sizes = ([0] * len(plan.levels) for _ in range(3))
    for number, tile in enumerate(tiles):
        scene = plan.levels[tile.level].scene
        rows = torch.cat([plan.chunks[chunk].rows[tile.level] for chunk in tile.chunks])
        part = change_axes(scene.select(rows.to(scene.device)), SCENE_AXES, AXES)
        path = place / names[id(tile)]
        with atomic_output(path, overwrite=True) as file:
            write_spz_glb(part, file)
        counts[tile.level] += len(rows)
        files[tile.level] += 1
        sizes[tile.level] += path.stat().st_size
        listener(ProgressEvent(stage="write", done=number + 1, total=len(tiles)))
    extensions = {"extensionsUsed": [SPLATS, SPZ], "extensionsRequired": [SPLATS, SPZ]}
    document = {
        "asset": {"version": "1.1", "generator": "cvtgs"},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": extensions},
        "geometricError": max(_error(plan, root), math.dist(root.node.box_min, root.node.box_max)),
        "root": {"refine": "REPLACE", **_entry(plan, root, names)},
    }
    with atomic_output(place / INDEX_NAMES["3dtiles"], overwrite=overwrite) as out:
        out.write(json.dumps(document, separators=(",", ":")).encode())
    return tuple(StreamLevel(*three) for three in zip(counts, files, sizes, strict=True))


def _tiles(plan: StreamPlan, most: int) -> _Tile:
    """Build the tree of tiles: below each, the next level that its parts have room for."""
    sums = [[0] for _ in plan.levels]
    for chunk in plan.chunks:
        for total, rows in zip(sums, chunk.rows, strict=True):
            total.append(total[-1] + len(rows))

    def level_of(chunks: range, above: int) -> int:
        """Return the finest level that fits into a tile; at least one finer at a single chunk."""
        fitting = [
            level
            for level in range(above)
            if sums[level][chunks.stop] - sums[level][chunks.start] <= most
        ]
        last = above - 1 if len(chunks) == 1 else above
        return min(fitting, default=last)

    def below(node: StreamNode, chunks: range, above: int) -> Iterator[_Tile]:
        """Return the tiles that replace those of a level above, within a node."""
        if above == 0:
            return
        level = level_of(chunks, above)
        if level < above:
            yield tile(node, chunks, level)
            return
        middle = chunks.start + _leaves(node.children[0])
        yield from below(node.children[0], range(chunks.start, middle), above)
        yield from below(node.children[1], range(middle, chunks.stop), above)

    def tile(node: StreamNode, chunks: range, level: int) -> _Tile:
        finer = list(below(node, chunks, level))
        return _Tile(node=node, level=level, chunks=chunks, children=finer)

    whole = range(len(plan.chunks))
    return tile(plan.root, whole, len(plan.levels) - 1)


def _leaves(node: StreamNode) -> int:
    return 1 if node.chunk is not None else sum(_leaves(child) for child in node.children)


def _listed(tile: _Tile) -> Iterator[_Tile]:
    yield tile
    for child in tile.children:
        yield from _listed(child)


def _error(plan: StreamPlan, tile: _Tile) -> float:
    """Return the geometric error of a tile; that of a finer one is never larger."""
    errors = [level.geometric_error for level in plan.levels[: tile.level + 1]]
    return ERROR_PIXELS * max(errors) if tile.children else 0.0


def _entry(plan: StreamPlan, tile: _Tile, names: dict[int, str]) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "boundingVolume": {"box": _box(tile.node.box_min, tile.node.box_max)},
        "geometricError": _error(plan, tile),
        "content": {"uri": names[id(tile)]},
    }
    if tile.children:
        entry["children"] = [_entry(plan, child, names) for child in tile.children]
    return entry


def _box(low: Corner, high: Corner) -> Sequence[float]:
    """Return a box of 3D Tiles, whose z is up: x left, y back and z up of the scene."""
    corners = [(-x, -z, -y) for x, y, z in (low, high)]
    middle = [(a + b) / 2 for a, b in zip(*corners, strict=True)]
    half = [abs(a - b) / 2 for a, b in zip(*corners, strict=True)]
    return [*middle, half[0], 0.0, 0.0, 0.0, half[1], 0.0, 0.0, 0.0, half[2]]
