"""Sort rows of the source into files of blocks, and read them back by block or by cell."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvtgs import analysis, cvt, filters, validity
from cvtgs.boxes import inside
from cvtgs.config import TessellationConfig
from cvtgs.devices import one_thread
from cvtgs.io import atomic_output
from cvtgs.io.tensors import map_tensors
from cvtgs.outofcore.attempts import Attempt, SortedFile
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.scan import CHUNK, RowRange, SceneScan
from cvtgs.scene import GaussianScene

AREA, VISIBILITY, CELL = "cvtgs_apparent_area", "cvtgs_visibility", "cvtgs_cell"
"""Columns of block files in addition to those of the source."""

MAPPED_ROWS = 1 << 14
"""Number of rows that are mapped and released together."""


class BlockRows(NamedTuple):
    """Gaussians of a block.

    Attributes:
        scene: The Gaussians.
        apparent_areas: ``(n,)`` areas as they count in images: smaller if distant or enclosed.
        visibility: ``(n,)`` ambient visibility, 0 to 1.
    """

    scene: GaussianScene
    apparent_areas: Tensor
    visibility: Tensor


class SortedCounts(NamedTuple):
    """The contribution of a range of the source to every block.

    Attributes:
        rows: Number of Gaussians per block.
        cells: Weight per chunk of rows and block, in cells; a Gaussian counts at most 1.
        left_out: Mass that the filter leaves out, one entry per chunk that loses any.
        files: Files of the rows.
    """

    rows: list[int]
    cells: list[list[float]]
    left_out: list[float]
    files: tuple[SortedFile, ...]


@one_thread()
def sort_range(job: Job, rows: RowRange) -> SortedCounts:
    """Write the rows of a range into one file per block, to which no other call writes."""
    scan, attempt = job.read_scan(), Attempt(job.folder)
    row_counts = torch.zeros(job.blocks, dtype=torch.int64)
    cell_counts, left_out = [], []
    for start in range(rows.start, rows.stop, CHUNK):
        records = job.source.read(start, min(start + CHUNK, rows.stop))
        scene = job.source.scene(records)
        valid = validity.valid_rows(scene)
        protected = valid & inside(job.boxes, scene.means) if job.boxes else ~valid & valid
        if bool(protected.any()):
            kept = _kept_rows(records, scene, protected)
            attempt.append(job.kept_path(rows.number).name, kept)
        free = (valid & ~protected).nonzero()[:, 0]
        chosen, areas, visibility = _filtered(scan, job.config.cvt, scene, free)
        if len(chosen) < len(free):
            masses = scene.masses
            left_out.append(float(masses[free].sum() - masses[chosen].sum()))
        weights = cvt.gaussian_weights(scene.opacities[chosen], areas, scan.area_power)
        weights = weights.clamp_min(scan.min_weight)
        per_cell = scan.cell_weight
        cells = (weights / per_cell).clamp_max(1.0) if per_cell > 0 else torch.ones_like(weights)
        blocks = scan.partition.blocks_of(scan.frame.contract(scene.means[chosen]))
        added = torch.bincount(blocks, minlength=job.blocks)
        row_counts += added
        cell_counts.append(torch.bincount(blocks, cells, minlength=job.blocks).tolist())
        order = torch.sort(blocks, stable=True).indices
        table = np.empty(len(order), record_type(job))
        numbers = chosen[order].numpy()
        for name in records.dtype.names or ():
            table[name] = records[name][numbers]
        table[AREA], table[VISIBILITY] = areas[order].numpy(), visibility[order].numpy()
        ends = added.cumsum(0).tolist()
        for block, (end, count) in enumerate(zip(ends, added.tolist(), strict=True)):
            if count:
                name = job.rows_path(block, rows.number).name
                attempt.append(name, table[end - count : end].tobytes())
    return SortedCounts(row_counts.tolist(), cell_counts, left_out, attempt.files())


def _filtered(
    scan: SceneScan, config: TessellationConfig, scene: GaussianScene, rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the rows that pass the filter, their apparent areas and their visibility."""
    means, opacities = scene.means[rows], scene.opacities[rows]
    areas = scene.select(rows).areas
    visibility = analysis.visibility_at(scan.visibility, means, scan.frame)
    distances = scan.frame.distances(means)
    apparent = analysis.apparent_areas(areas, distances, visibility, config=config)
    stays = opacities >= scan.min_opacity
    if scan.max_flyaway_mass >= 0.0:
        far = distances > filters.FLYAWAY_RADII
        masses = areas * opacities * analysis.perspective_falloff(distances)
        stays &= ~(far & (masses <= scan.max_flyaway_mass))
    return rows[stays], apparent[stays], visibility[stays]


def _kept_rows(records: NDArray[Any], scene: GaussianScene, protected: Tensor) -> bytes:
    """Return the protected rows, with finite opacities."""
    kept = records[protected.numpy()]
    logits = validity.with_finite_opacities(scene.select(protected)).logit_opacities
    kept["opacity"] = logits.numpy()
    return bytes(kept.tobytes())


def record_type(job: Job, *, with_cell: bool = False) -> np.dtype[Any]:
    """Return the type of a row in the files of a job."""
    more = [(CELL, "<i4")] if with_cell else []
    return np.dtype([*job.source.names, (AREA, "<f8"), (VISIBILITY, "<f4"), *more])


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
    labels = map_tensors(job.labels_path(block))[0]["labels"].long()
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
        path = job.kept_path(rows.number)
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
    with atomic_output(job.sent_path(block), overwrite=True) as file:
        order = torch.sort(remote, stable=True).indices
        file.write(np.concatenate(parts)[order.numpy()].tobytes())
    return torch.bincount(remote, minlength=job.blocks)


def _received(job: Job, block: int) -> Iterator[NDArray[Any]]:
    """Return the rows that other blocks sent, in pieces."""
    kind = record_type(job, with_cell=True)
    for other in job.blocks_with_rows():
        if other == block:
            continue
        sent = map_tensors(job.labels_path(other))[0]["sent"]
        start, count = int(sent[:block].sum()), int(sent[block])
        yield from _mapped(job.sent_path(other), kind, start, count)


def _row_pieces(job: Job, block: int) -> Iterator[NDArray[Any]]:
    """Return the rows that were sorted into a block, in pieces."""
    for path, count in _row_files(job, block):
        yield from _mapped(path, record_type(job), 0, count)


def _row_files(job: Job, block: int) -> list[tuple[Path, int]]:
    size = record_type(job).itemsize
    paths = [job.rows_path(block, rows.number) for rows in job.ranges()]
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
