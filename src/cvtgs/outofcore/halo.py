"""The halo of a block: the nearest sites and cells of other blocks."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cvt import NearestSite
from cvtgs.cvt.nearest import nearest_several
from cvtgs.outofcore.job import Job, Step

RUN = 1 << 9  # number of consecutive balls whose common box is tested before the single balls


class OtherBlock(NamedTuple):
    """Positions in another block, at least one, and their bounding box."""

    number: int
    bounds: Float[Tensor, "2 d"]
    positions: Float[Tensor, "m d"]


def other_blocks(
    job: Job, step: Step, name: str, numbers: Iterable[int], iteration: int | None = None
) -> Iterator[OtherBlock]:
    """Map the positions that a step wrote for some blocks; ``name`` is that of the tensor."""
    for number in numbers:
        tensors = job.read(step, number, iteration)
        yield OtherBlock(number, tensors["bounds"], tensors[name])


def bounding_box(points: Float[Tensor, "n d"]) -> Float[Tensor, "2 d"]:
    """Return the minimum and the maximum coordinates of points."""
    return torch.stack([points.amin(dim=0), points.amax(dim=0)]).double()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Balls:
    """Balls around points; only positions inside a ball can be nearer than those already found."""

    centers: Float[Tensor, "n d"]  # ideally sorted along a space-filling curve
    squared: Float[Tensor, "n"]  # radii
    run_boxes: Float[Tensor, "r 2 d"]  # bounding boxes of runs of consecutive centres
    run_squared: Float[Tensor, "r"]  # largest squared radius of each run

    @classmethod
    def around(cls, centers: Float[Tensor, "n d"], squared: Float[Tensor, "n"]) -> Self:
        """Build the balls and the boxes of their runs."""
        lows = torch.stack([_run_maxima(-column) for column in centers.unbind(1)], dim=1)
        highs = torch.stack([_run_maxima(column) for column in centers.unbind(1)], dim=1)
        return cls(
            centers=centers,
            squared=squared,
            run_boxes=torch.stack([-lows, highs], dim=1).double(),
            run_squared=_run_maxima(squared),
        )

    def touching(self, box: Float[Tensor, "2 d"]) -> Int[Tensor, "k"]:
        """Return the rows of the balls that intersect a box."""
        low, high = box
        gaps = torch.maximum(self.run_boxes[:, 0] - high, low - self.run_boxes[:, 1])
        runs = (gaps.clamp_min(0.0).square().sum(dim=1) < self.run_squared).nonzero()[:, 0]
        rows = (runs[:, None] * RUN + torch.arange(RUN)).flatten()
        rows = rows[rows < len(self.centers)]
        centers = self.centers[rows].double()
        gaps = torch.maximum(centers - high, low - centers).clamp_min(0.0)
        return rows[gaps.square().sum(dim=1) < self.squared[rows]]


def _run_maxima(values: Float[Tensor, "n"]) -> Float[Tensor, "r"]:
    missing = -len(values) % RUN
    padded = torch.cat([values, values[-1:].expand(missing)])
    largest: Tensor = padded.unflatten(0, (-1, RUN)).amax(dim=1)
    return largest


class Assignment(NamedTuple):
    """The nearest site of every point."""

    blocks: Int[Tensor, "n"]  # its block; -1 is the own one
    labels: Int[Tensor, "n"]  # its number there
    squared: Float[Tensor, "n"]  # its squared distance, float64


def assign_points(
    points: Float[Tensor, "n d"],
    sites: Float[Tensor, "m d"],
    others: Iterable[OtherBlock],
    *,
    nearest: NearestSite,
) -> Assignment:
    """Find the nearest site of every point among the sites of all blocks."""
    if len(sites):
        labels, squared = nearest(points, sites)
    else:
        squared = torch.full_like(points[:, 0], torch.inf, dtype=torch.float64)
        labels = torch.full_like(squared, -1, dtype=torch.int64)
    blocks, balls = torch.full_like(labels, -1), Balls.around(points, squared)
    labels, squared = labels.clone(), squared.clone()
    for other in others:
        rows = balls.touching(other.bounds)
        if len(rows) == 0:
            continue
        remote, distances = nearest(points[rows], other.positions)
        closer = distances < squared[rows]
        rows = rows[closer]
        blocks[rows], labels[rows] = other.number, remote[closer]
        squared[rows] = distances[closer]
    return Assignment(blocks, labels, squared)


def number_remote(
    owners: Int[Tensor, "n"], labels: Int[Tensor, "n"], count: int
) -> tuple[Int[Tensor, "n"], Int[Tensor, "r 2"]]:
    """Number the remote sites of points after the own ones; also return their blocks and numbers.

    ``owners`` are the blocks of sites, -1 for the own one, and ``labels`` their numbers there.
    """
    away = (owners >= 0).nonzero()[:, 0]
    pairs = torch.stack([owners[away], labels[away]], dim=1)
    remote, numbers = torch.unique(pairs, dim=0, return_inverse=True)
    return labels.index_copy(0, away, count + numbers), remote


def halo_cells(
    centers: Float[Tensor, "m 3"], others: Iterable[OtherBlock], *, count: int
) -> Int[Tensor, "h 2"]:
    """Return block and number of remote cells that may be among an own cell's ``count`` nearest."""
    if count == 0:
        return torch.zeros(0, 2, dtype=torch.int64)
    centers = centers.double()
    if len(centers) > count:
        _, distances = nearest_several(centers, centers, count + 1)
        squared = distances[:, -1].square()
    else:
        squared = torch.full_like(centers[:, 0], torch.inf)
    balls, found = Balls.around(centers, squared), [torch.zeros(0, 2, dtype=torch.int64)]
    for other in others:
        rows = balls.touching(other.bounds)
        if len(rows) == 0:
            continue
        cells, distances = nearest_several(centers[rows], other.positions, count)
        near = torch.unique(cells[distances.square() <= squared[rows][:, None]])
        found.append(torch.stack([torch.full_like(near, other.number), near], dim=1))
    return torch.cat(found)
