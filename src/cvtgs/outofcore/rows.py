"""The rows of a block: as they were cut, and as the cells of the block want them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.io.ply import assemble
from cvtgs.io.tensors import map_tensors
from cvtgs.outofcore.job import Job
from cvtgs.scene import GaussianScene

SEEN, LIGHT, CELL = "cvtgs_seen", "cvtgs_light", "cvtgs_cell"
"""Columns of block files beyond those of the source: area as seen, light, and cell."""

CHUNK = 1 << 14
"""Rows that are mapped together, and let go again."""


class Rows(NamedTuple):
    """Gaussians of a block.

    Attributes:
        scene: The Gaussians.
        seen: ``(n,)`` their areas as they look in images.
        light: ``(n,)`` how freely each can be seen, 0 to 1.
    """

    scene: GaussianScene
    seen: Tensor
    light: Tensor


def record_type(job: Job, *, with_cell: bool = False) -> np.dtype[Any]:
    """Return the type of a row in the files of a job."""
    more = [(CELL, "<i4")] if with_cell else []
    return np.dtype([*job.source.names, (SEEN, "<f8"), (LIGHT, "<f4"), *more])


def read_rows(job: Job, block: int, *, is_slim: bool = False) -> Rows:
    """Read the rows that were cut into a block."""
    counts = [count for _, count in _cut_files(job, block)]
    return _assembled(job, cut_pieces(job, block), sum(counts), is_slim=is_slim)


def read_members(job: Job, block: int) -> tuple[Rows, Tensor]:
    """Read the rows that make up the cells of a block."""
    labels = map_tensors(job.labels_path(block))[0]["labels"].long()
    stays = labels >= 0
    arrived = list(_arrivals(job, block))
    came = [torch.from_numpy(rows[CELL].astype(np.int64)) for rows in arrived]

    def pieces() -> Iterator[NDArray[Any]]:
        start = 0
        for rows in cut_pieces(job, block):
            yield rows[stays[start : start + len(rows)].numpy()]
            start += len(rows)
        yield from arrived

    count = int(stays.sum()) + sum(map(len, arrived))
    rows = _assembled(job, pieces(), count, is_slim=False)
    return rows, torch.cat([labels[stays], *came])


def cut_pieces(job: Job, block: int) -> Iterator[NDArray[Any]]:
    """Return the rows that were cut into a block piece by piece."""
    for path, count in _cut_files(job, block):
        yield from _mapped(path, record_type(job), 0, count)


def _cut_files(job: Job, block: int) -> list[tuple[Path, int]]:
    size = record_type(job).itemsize
    paths = [job.rows_path(block, number) for number, _, _ in job.ranges()]
    return [(path, path.stat().st_size // size) for path in paths if path.exists()]


def _arrivals(job: Job, block: int) -> Iterator[NDArray[Any]]:
    """Return the rows that other blocks have sent."""
    kind = record_type(job, with_cell=True)
    for other in job.filled():
        if other == block:
            continue
        sent = map_tensors(job.labels_path(other))[0]["sent"]
        start, count = int(sent[:block].sum()), int(sent[block])
        yield from _mapped(job.sent_path(other), kind, start, count)


def _assembled(job: Job, pieces: Iterator[NDArray[Any]], count: int, *, is_slim: bool) -> Rows:
    seen, light = torch.empty(count).double(), torch.empty(count).double()
    done = 0

    def noted() -> Iterator[NDArray[Any]]:
        nonlocal done
        for rows in pieces:
            seen[done : done + len(rows)] = torch.from_numpy(rows[SEEN].copy())
            light[done : done + len(rows)] = torch.from_numpy(rows[LIGHT].copy())
            done += len(rows)
            yield rows

    scene = assemble(
        noted(),
        count=count,
        layout=job.source.layout,
        comments=job.source.comments,
        sh_degree=0 if is_slim else None,
        with_extras=not is_slim,
    )
    return Rows(scene, seen, light)


def _mapped(path: Path, kind: np.dtype[Any], start: int, count: int) -> Iterator[NDArray[Any]]:
    for first in range(start, start + count, CHUNK):
        shape = (min(CHUNK, start + count - first),)
        yield np.memmap(path, kind, "r", first * kind.itemsize, shape).view(np.ndarray)
