"""Sort a file into blocks: the first pass scans it, the second writes the rows of every block."""

import json
import secrets
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cvtgs import analysis, cvt, filters, validity
from cvtgs.analysis.analyze import apparent_areas, frame_of, visibility_at
from cvtgs.analysis.effects import drop_mip_tag
from cvtgs.boxes import check_room, inside
from cvtgs.clock import StageClock
from cvtgs.config import TessellationConfig
from cvtgs.devices import one_thread
from cvtgs.errors import InvalidArgumentError, InvalidSceneError, RunError
from cvtgs.grouping import finer_count
from cvtgs.io.atomic import replace_file, write_error
from cvtgs.outofcore.images import write_views
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.rows import AREA, VISIBILITY, record_type
from cvtgs.outofcore.scan import (
    CHUNK,
    SceneScan,
    add_totals,
    faint_masses,
    in_cells,
    read_sample,
    scan_range,
    scan_scene,
)
from cvtgs.processes import Workers, with_progress
from cvtgs.scene import GaussianScene


class SortedFile(NamedTuple):
    """A file that one attempt to sort a range wrote: final and current name, bytes and CRC-32."""

    name: str
    attempt: str
    size: int
    checksum: int


class Attempt:
    """The files that one call writes for a range; no other call does, even after a lost worker."""

    def __init__(self, folder: str) -> None:
        self.files = dict[str, SortedFile]()  # by final name
        self._folder, self._token = Path(folder), secrets.token_hex(8)

    def append(self, name: str, content: bytes) -> None:
        """Append to the file with this final name."""
        new = SortedFile(name, f"attempt_{name}_{self._token}", 0, 0)
        file = self.files.get(name, new)
        path = self._folder / file.attempt
        try:
            with path.open("ab") as opened:
                opened.write(content)
        except OSError as error:
            raise write_error(path, error) from error
        size, checksum = file.size + len(content), zlib.crc32(content, file.checksum)
        self.files[name] = file._replace(size=size, checksum=checksum)


class SortedBlocks(NamedTuple):
    """The blocks after all rows are sorted into them."""

    rest: int  # Gaussians that all blocks keep together
    rows: list[int]  # Gaussians in each block
    cells: list[float]  # weight of each block, in cells; a Gaussian counts at most 1
    left_out_mass: float  # by the filter, squared scene units


def sort_into_blocks(
    job: Job, workers: Workers, clock: StageClock, *, keep_all: bool = False
) -> SortedBlocks:
    """Scan the file and sort its rows into blocks; ``keep_all`` turns the filter off."""
    ranges = job.ranges()
    with clock.stage("scan", len(ranges)) as advance:
        rest, scan = _scan(job, workers, ranges, advance)
    unfiltered = replace(scan, min_opacity=0.0, max_flyaway_mass=-1.0)
    with clock.stage("sort", len(ranges)) as advance:
        job.write_scan(unfiltered if keep_all else scan)
        found = _sort(job, rest, workers, ranges, advance)
        if sum(found.rows) < rest:  # the filter was too strict for so large a target
            job.write_scan(unfiltered)
            found = _sort(job, rest, workers, ranges, advance)
    return found


def _scan(
    job: Job, workers: Workers, ranges: Sequence[range], advance: Callable[[int], None]
) -> tuple[int, SceneScan]:
    """Return the number of Gaussians that all blocks keep, and the scan of the scene."""
    sample = read_sample(job.source, job.sample_rows)
    if len(sample) == 0:
        raise InvalidSceneError(f"{job.source.path}: found no valid Gaussian.")
    validity.warn_of_lost_digits(sample)
    frame = frame_of(sample.means, sample.opacities)
    scan_rows = partial(scan_range, job.source, frame, job.boxes)
    totals = add_totals(with_progress(workers(scan_rows, ranges), advance))
    valid, kept = totals.valid_count, totals.kept_count
    check_room(kept, target=job.target, total=valid)
    if kept == valid:
        raise InvalidArgumentError(
            f"all {kept:,} valid Gaussians are protected, so there is nothing to simplify."
        )
    rest = min(job.target, valid) - kept
    scan = scan_scene(
        sample,
        totals,
        boxes=job.boxes,
        target=max(1, rest),
        cell_count=finer_count(max(1, rest), valid - kept, job.config.allocation),
        blocks=job.blocks,
        config=job.config,
        frame=frame,
    )
    if job.config.uses_images:
        write_views(job, drop_mip_tag(sample, scan.plan), total=valid)
    return rest, scan


def _sort(
    job: Job,
    rest: int,
    workers: Workers,
    ranges: Sequence[range],
    advance: Callable[[int], None],
) -> SortedBlocks:
    rows, cells, files = [0] * job.blocks, [0.0] * job.blocks, list[SortedFile]()
    left_out_mass = 0.0
    for part in with_progress(workers(partial(sort_range, job), ranges), advance):
        rows = [a + b for a, b in zip(rows, part.rows, strict=True)]
        for chunk in part.cells:  # in order: the same bits for any division into ranges
            cells = [a + b for a, b in zip(cells, chunk, strict=True)]
        for mass in part.left_out:
            left_out_mass += mass
        files += part.files
    _adopt(job, files)
    return SortedBlocks(rest, rows, cells, left_out_mass)


class SortedCounts(NamedTuple):
    """The contribution of a range of the source to every block; see :class:`SortedBlocks`."""

    rows: list[int]
    cells: list[list[float]]  # of each chunk of rows
    left_out: list[float]  # likewise
    files: list[SortedFile]


@one_thread()
def sort_range(job: Job, rows: range) -> SortedCounts:
    """Write the rows of a range into one file per block, to which no other call writes."""
    scan, config, attempt = job.read_scan(), job.config.cvt, Attempt(job.folder)
    row_counts = torch.zeros(job.blocks, dtype=torch.int64)
    cell_counts, left_out = [], []
    for start in range(rows.start, rows.stop, CHUNK):
        records = job.source.read(start, min(start + CHUNK, rows.stop))
        scene = job.source.scene(records)
        valid = validity.valid_rows(scene)
        protected = valid & inside(job.boxes, scene.means)
        if bool(protected.any()):
            kept, some = records[protected.numpy()], scene.select(protected)
            kept["opacity"] = validity.with_finite_opacities(some).logit_opacities.numpy()
            attempt.append(job.path("kept", rows.start).name, kept.tobytes())
        free = (valid & ~protected).nonzero()[:, 0]
        chosen, areas, visibility = _filtered(scan, config, scene, free)
        if len(chosen) < len(free):
            masses = scene.masses
            left_out.append(float(masses[free].sum() - masses[chosen].sum()))
        weights = cvt.gaussian_weights(scene.opacities[chosen], areas, area_power=config.area_power)
        weights = weights.clamp_min(scan.mean_weight * config.weight_floor)
        cells = in_cells(weights, scan.cell_weight)
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
                name = job.path("rows", block, rows.start).name
                attempt.append(name, table[end - count : end].tobytes())
    return SortedCounts(row_counts.tolist(), cell_counts, left_out, [*attempt.files.values()])


def _filtered(
    scan: SceneScan, config: TessellationConfig, scene: GaussianScene, rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the rows that pass the filter, their apparent areas and their visibility."""
    means, opacities = scene.means[rows], scene.opacities[rows]
    areas = scene.select(rows).areas
    visibility = visibility_at(scan.visibility, means, scan.frame)
    distances = scan.frame.distances(means)
    apparent = apparent_areas(areas, distances, visibility, config=config)
    stays = faint_masses(opacities, apparent, scan.min_opacity) >= scan.min_faint_mass
    if scan.max_flyaway_mass >= 0.0:
        far = distances > filters.FLYAWAY_RADII
        masses = areas * opacities * analysis.perspective_falloff(distances)
        stays &= ~(far & (masses <= scan.max_flyaway_mass))
    return rows[stays], apparent[stays], visibility[stays]


def _adopt(job: Job, files: Sequence[SortedFile]) -> None:
    """Give the files of finished attempts their final names, and remove other attempts."""
    for path in job.path("").glob("rows_*"):
        path.unlink()  # from an earlier sort with another filter
    for file in files:
        path = job.path(file.attempt)
        found = f"{path.stat().st_size} bytes" if path.exists() else "no file"
        if found != f"{file.size} bytes":
            raise RunError(
                f"{path}: must have the {file.size} bytes that were written, found {found}; "
                "every worker must see the output folder under the same path; check the disk, too."
            )
        replace_file(path, job.path(file.name))
    for path in job.path("").glob("attempt_*"):
        path.unlink(missing_ok=True)
    facts = {file.name: (file.size, file.checksum) for file in files}
    job.write_file("sorted.json", json.dumps(facts).encode())
