"""Write a streamed SOG: ``lod-meta.json`` of version 1 and the SOGs that it names."""

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from cvtgs.boxes import Corner
from cvtgs.checks import checked
from cvtgs.counts import checked_whole
from cvtgs.devices import on_host
from cvtgs.edit import concatenate
from cvtgs.io import load, save
from cvtgs.io.atomic import make_folder, write_atomically
from cvtgs.io.limits import FORMAT_LIMITS, dropped_within
from cvtgs.io.sog import encode_sog
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.scene import GaussianScene
from cvtgs.streams.files import StreamLevel, StreamPart, join_levels, join_trees, write_stream
from cvtgs.streams.plan import StreamNode, StreamPlan, environment_level

FILE_GAUSSIANS = 1 << 18  # maximum number of Gaussians in a file, unless a single chunk has more

ENVIRONMENT = "environment"  # name of its folder


class _Unit(NamedTuple):
    """A SOG, which holds consecutive chunks of a level."""

    name: str
    level: int
    chunks: range
    rows: Int[Tensor, "n"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SogFormat:
    """Streamed SOG, as PlayCanvas' engine and SuperSplat's viewer load it."""

    file_gaussians: int = FILE_GAUSSIANS  # the most in a SOG; a chunk is never split
    kind: str = "sog"

    def write_part(
        self, plan: StreamPlan, folder: Path, *, part: int, listener: ProgressListener
    ) -> StreamPart:
        """Write the chunks of a level consecutively, so that nearby chunks share a file."""
        units = list(_units(plan, part, self.file_gaussians))
        files, sizes = ([0] * len(plan.levels) for _ in range(2))
        dropped = Counter[str]()
        for number, unit in enumerate(units):
            scene = plan.levels[unit.level].scene
            part_of = scene.select(unit.rows.to(scene.device))
            files[unit.level] += 1
            sizes[unit.level] += _write_sog(part_of, folder / unit.name)
            dropped.update(dropped_within(part_of, FORMAT_LIMITS[".sog"]))
            listener(ProgressEvent(stage="write", done=number + 1, total=len(units)))
        far = tuple(map(len, plan.far))
        environments = {
            level: f".environment_{part}_{level}.ply"
            for level in range(environment_level(far), len(far))
            if far[level]
        }
        for level, name in environments.items():
            save(plan.far_scene(level), folder / name, overwrite=True)
        return StreamPart(
            levels=tuple(map(StreamLevel, plan.counts, files, sizes)),
            chunks=len(plan.chunks),
            names=tuple(f"{unit.name}/meta.json" for unit in units),
            tree=_tree(plan, units),
            box_min=plan.root.box_min,
            box_max=plan.root.box_max,
            dropped=dropped,
            far=far,
            environments=environments,
        )

    def index(self, parts: Sequence[StreamPart], folder: Path) -> dict[str, Any]:
        """Return the content of ``lod-meta.json``, and write the environment of all parts."""
        counts = [level.gaussians for level in join_levels(parts)]
        firsts = accumulate((len(part.names) for part in parts), initial=0)
        leaves = [_shifted(part.tree, first) for part, first in zip(parts, firsts, strict=False)]
        scenes = [load(folder / name, trust_sizes=True) for name in _far_files(parts)]
        more = {}
        if scenes:
            _write_sog(concatenate(scenes), folder / ENVIRONMENT)
            more = {"environment": f"{ENVIRONMENT}/meta.json"}
        return {
            "version": 1,
            "asset": {"generator": "cvtgs"},
            **more,
            "count": sum(counts),
            "counts": counts,
            "lodLevels": len(counts),
            "lodErrors": False,
            "filenames": [name for part in parts for name in part.names],
            "tree": join_trees(parts, leaves, _node),
        }


@on_host()
@checked
def write_sog_stream(
    plan: StreamPlan,
    folder: str | os.PathLike[str],
    *,
    file_gaussians: int = FILE_GAUSSIANS,
    overwrite: bool = False,
    listener: ProgressListener = silent,
) -> tuple[StreamLevel, ...]:
    """Write a streamed SOG, as PlayCanvas' engine and SuperSplat's viewer load it.

    Chunks of a level are consecutive in SOGs of bounded size, so that nearby chunks share a file.
    All files are written, or none.

    Args:
        plan: Levels and chunks.
        folder: Folder to write to; created if it is missing.
        file_gaussians: Maximum number of Gaussians in a SOG; a chunk is never split.
        overwrite: Whether files of an earlier stream may be replaced.
        listener: Called after each SOG.

    Returns:
        The written counts of each level, the finest first.

    Raises:
        OutputExistsError: The folder holds files that may not be replaced.
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
    form = SogFormat(file_gaussians=checked_whole(file_gaussians, "file_gaussians"))
    return write_stream(form, plan, folder, overwrite=overwrite, listener=listener)


def _far_files(parts: Sequence[StreamPart]) -> list[str]:
    """Return the files with the environment, at the finest level that fits for all parts."""
    with_far = [part for part in parts if part.far]
    counts = [sum(level) for level in zip(*(part.far for part in with_far), strict=True)]
    level = environment_level(counts)
    return [part.environments[level] for part in with_far if part.far[level]]


def _write_sog(scene: GaussianScene, folder: Path) -> int:
    """Write an unbundled SOG; return its size in bytes."""
    make_folder(folder)
    total = 0
    for name, content in encode_sog(scene).files():
        write_atomically(folder / name, content, overwrite=True)
        total += len(content)
    return total


def _units(plan: StreamPlan, part: int, most: int) -> Iterator[_Unit]:
    """Return the SOGs of all levels, the coarsest level first."""
    for level in reversed(range(len(plan.levels))):
        counts = [len(chunk.rows[level]) for chunk in plan.chunks]
        for number, chunks in enumerate(_packed(counts, most)):
            rows = torch.cat([plan.chunks[chunk].rows[level] for chunk in chunks])
            if len(rows):
                yield _Unit(f"{level}_{part}_{number}", level, chunks, rows)


def _packed(counts: Sequence[int], most: int) -> Iterator[range]:
    """Return ranges of chunks with at most ``most`` Gaussians, or with a single larger chunk."""
    start = total = 0
    for chunk, count in enumerate(counts):
        if total and total + count > most:
            yield range(start, chunk)
            start, total = chunk, 0
        total += count
    yield range(start, len(counts))


def _tree(plan: StreamPlan, units: Sequence[_Unit]) -> dict[str, Any]:
    """Return the tree of the chunks of a part, with file numbers from 0."""
    places: list[dict[str, Any]] = [{} for _ in plan.chunks]
    for number, unit in enumerate(units):
        offset = 0
        for chunk in unit.chunks:
            count = len(plan.chunks[chunk].rows[unit.level])
            if count:
                place = {"file": number, "offset": offset, "count": count}
                places[chunk][str(unit.level)] = place
            offset += count

    def node(one: StreamNode) -> dict[str, Any]:
        if one.chunk is None:
            return _node(one.box_min, one.box_max, [node(child) for child in one.children])
        lods = dict(sorted(places[one.chunk].items()))
        return {"bound": _bound(one.box_min, one.box_max), "lods": lods}

    return node(plan.root)


def _node(low: Corner, high: Corner, children: list[dict[str, Any]]) -> dict[str, Any]:
    return {"bound": _bound(low, high), "children": children}


def _bound(low: Corner, high: Corner) -> dict[str, Any]:
    return {"min": list(low), "max": list(high)}


def _shifted(node: dict[str, Any], before: int) -> dict[str, Any]:
    """Return the tree with ``before`` added to its file numbers."""
    if "children" in node:
        return {**node, "children": [_shifted(child, before) for child in node["children"]]}
    lods = node["lods"].items()
    return {
        **node,
        "lods": {level: {**place, "file": place["file"] + before} for level, place in lods},
    }
