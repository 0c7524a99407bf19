"""Read the rows that were sorted into blocks, by block or by cell, and send some to others."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from cvtgs import analysis
from cvtgs.io import atomic_output
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.scan import CHUNK, SceneScan
from cvtgs.scene import GaussianScene

AREA, VISIBILITY, CELL = "cvtgs_apparent_area", "cvtgs_visibility", "cvtgs_cell"
"""Columns of block files in addition to those of the source."""

MAPPED_ROWS = 1 << 14  # number of rows that are mapped and released together


class BlockRows(NamedTuple):
    """Gaussians of a block, with the areas and the ambient visibility found by the sort."""

    scene: GaussianScene
    apparent_areas: Float[Tensor, "n"]
    visibility: Float[Tensor, "n"]


def record_type(job: Job, *, with_cell: bool = False) -> np.dtype[Any]:
    """Return the type of a row in the files of a job."""
    more = [(CELL, "<i4")] if with_cell else []
    return np.dtype([*job.source.dtype.descr, (AREA, "<f8"), (VISIBILITY, "<f4"), *more])


def read_rows(job: Job, block: int, *, is_slim: bool = False) -> BlockRows:
    """Read the rows of a block; slim ones have only the constant SH band and no extra columns."""
    counts = [count for _, count in _row_files(job, block)]
    return _assembled(job, _row_pieces(job, block), sum(counts), is_slim=is_slim)


def analysis_of(scan: SceneScan, rows: BlockRows) -> analysis.SceneAnalysis:
    """Return the analysis of the Gaussians of a block, based on the scan of the whole scene."""
    scene = rows.scene
    return analysis.SceneAnalysis(
        frame=scan.frame,
        farthest=float(scan.frame.distances(scene.means).amax()),
        opacities=scene.opacities,
        areas=scene.areas,
        apparent_areas=rows.apparent_areas,
        visibility=rows.visibility,
        plan=scan.plan,
    )


def read_members(job: Job, block: int) -> tuple[BlockRows, Tensor]:
    """Read the rows in the cells of a block, and the cell of each."""
    labels = job.read("labels", block)["labels"].long()
    stays = labels >= 0
    received = list(_received(job, block))
    cells = [torch.from_numpy(rows[CELL].astype(np.int64)) for rows in received]

    def pieces() -> Iterator[NDArray[Any]]:
        start = 0
        for rows in _row_pieces(job, block):
            yield rows[stays[start : start + len(rows)].numpy()]
            start += len(rows)
        yield from received

    count = int(stays.sum()) + sum(map(len, received))
    rows = _assembled(job, pieces(), count, is_slim=False)
    return rows, torch.cat([labels[stays], *cells])


def kept_rows(job: Job) -> Iterator[NDArray[Any]]:
    """Map the protected rows of every range, in pieces."""
    for rows in job.ranges():
        path = job.path("kept", rows.start)
        if path.exists():
            table = np.memmap(path, job.source.dtype, "r").view(np.ndarray)
            yield from (table[start : start + CHUNK] for start in range(0, len(table), CHUNK))


def send_rows(job: Job, block: int, owners: Tensor, labels: Tensor) -> Tensor:
    """Write the rows that belong to remote cells; return the number sent to each block."""
    kind, parts, start = record_type(job, with_cell=True), [], 0
    for rows in _row_pieces(job, block):
        part = slice(start, start + len(rows))
        leaves = (owners[part] >= 0).numpy()
        table = np.empty(int(leaves.sum()), kind)
        for name in rows.dtype.names or ():
            table[name] = rows[name][leaves]
        table[CELL] = labels[part].numpy()[leaves]
        parts.append(table)
        start += len(rows)
    remote = owners[owners >= 0]
    with atomic_output(job.path("sent", block), overwrite=True) as file:
        order = torch.sort(remote, stable=True).indices
        file.write(np.concatenate(parts)[order.numpy()].tobytes())
    return torch.bincount(remote, minlength=job.blocks)


def _received(job: Job, block: int) -> Iterator[NDArray[Any]]:
    """Return the rows that other blocks sent, in pieces."""
    kind = record_type(job, with_cell=True)
    for other in job.blocks_with_rows():
        if other == block:
            continue
        sent = job.read("labels", other)["sent"]
        start, count = int(sent[:block].sum()), int(sent[block])
        yield from _mapped(job.path("sent", other), kind, start, count)


def _row_pieces(job: Job, block: int) -> Iterator[NDArray[Any]]:
    """Return the rows that were sorted into a block, in pieces."""
    for path, count in _row_files(job, block):
        yield from _mapped(path, record_type(job), 0, count)


def _row_files(job: Job, block: int) -> list[tuple[Path, int]]:
    size = record_type(job).itemsize
    paths = [job.path("rows", block, rows.start) for rows in job.ranges()]
    return [(path, path.stat().st_size // size) for path in paths if path.exists()]


def _mapped(path: Path, kind: np.dtype[Any], start: int, count: int) -> Iterator[NDArray[Any]]:
    for first in range(start, start + count, MAPPED_ROWS):
        shape = (min(MAPPED_ROWS, start + count - first),)
        yield np.memmap(path, kind, "r", first * kind.itemsize, shape).view(np.ndarray)


def _assembled(job: Job, pieces: Iterator[NDArray[Any]], count: int, *, is_slim: bool) -> BlockRows:
    """Build a scene from pieces, and copy their areas and visibility."""
    areas, visibility = torch.empty(count).double(), torch.empty(count).double()

    def copied() -> Iterator[NDArray[Any]]:
        start = 0
        for rows in pieces:
            part = slice(start, start + len(rows))
            areas[part] = torch.from_numpy(rows[AREA].copy())
            visibility[part] = torch.from_numpy(rows[VISIBILITY].copy())
            start += len(rows)
            yield rows

    scene = job.source.assemble(copied(), count, is_slim=is_slim)
    return BlockRows(scene, areas, visibility)
