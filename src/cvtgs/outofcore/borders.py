"""What lies across a border: the nearest sites and cells, whichever block they belong to."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cvt import NearestSite, nearest_several

RUN = 1 << 9
"""Points that are compared with a block together, before each of them is."""


class Across(NamedTuple):
    """Another block.

    Attributes:
        block: Its number.
        bounds: ``(2, d)`` least and largest coordinates of what lies there.
        load: Gives the ``(m, d)`` positions of what lies there, at least one.
    """

    block: int
    bounds: Tensor
    load: Callable[[], Tensor]


def bounds_of(points: Float[Tensor, "n d"]) -> Float[Tensor, "2 d"]:
    """Return the box around some points."""
    return torch.stack([points.amin(dim=0), points.amax(dim=0)]).double()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reach:
    """Points, and how far from each of them something may be to matter.

    Attributes:
        points: ``(n, d)`` positions, best along a space-filling curve.
        squared: ``(n,)`` squared distance within which others matter.
        runs: ``(r, 2, d)`` boxes around runs of points.
        farthest: ``(r,)`` largest squared distance of each run.
    """

    points: Float[Tensor, "n d"]
    squared: Float[Tensor, "n"]
    runs: Float[Tensor, "r 2 d"]
    farthest: Float[Tensor, "r"]

    @classmethod
    def of(cls, points: Float[Tensor, "n d"], squared: Float[Tensor, "n"]) -> Self:
        """Look at some points."""
        lows = torch.stack([_of_runs(-column) for column in points.unbind(1)], dim=1)
        highs = torch.stack([_of_runs(column) for column in points.unbind(1)], dim=1)
        runs = torch.stack([-lows, highs], dim=1).double()
        return cls(points=points, squared=squared, runs=runs, farthest=_of_runs(squared))

    def rows(self, bounds: Float[Tensor, "2 d"]) -> Int[Tensor, "k"]:
        """Return the points to which something in a box may matter."""
        low, high = bounds
        gaps = torch.maximum(self.runs[:, 0] - high, low - self.runs[:, 1]).clamp_min(0.0)
        near = (gaps.square().sum(dim=1) < self.farthest).nonzero()[:, 0]
        rows = (near[:, None] * RUN + torch.arange(RUN)).flatten()
        rows = rows[rows < len(self.points)]
        places = self.points[rows].double()
        gaps = torch.maximum(places - high, low - places).clamp_min(0.0)
        return rows[gaps.square().sum(dim=1) < self.squared[rows]]


def _of_runs(values: Float[Tensor, "n"]) -> Float[Tensor, "r"]:
    """Return the largest value of every run."""
    missing = -len(values) % RUN
    padded = torch.cat([values, values[-1:].expand(missing)])
    largest: Tensor = padded.unflatten(0, (-1, RUN)).amax(dim=1)
    return largest


class Nearest(NamedTuple):
    """The nearest site of every point.

    Attributes:
        blocks: ``(n,)`` block that the site belongs to; -1 is the own one.
        labels: ``(n,)`` its number in that block.
        squared: ``(n,)`` squared distance to it, in float64.
    """

    blocks: Tensor
    labels: Tensor
    squared: Tensor


def nearest_anywhere(
    points: Float[Tensor, "n d"],
    sites: Float[Tensor, "m d"],
    others: Iterable[Across],
    *,
    nearest: NearestSite,
) -> Nearest:
    """Find the nearest site of every point among those of all blocks.

    Only points that are nearer to the box of another block than to their site are searched there.
    """
    if len(sites):
        labels, squared = nearest(points, sites)
    else:
        squared = torch.full_like(points[:, 0], torch.inf, dtype=torch.float64)
        labels = torch.full_like(squared, -1, dtype=torch.int64)
    blocks, reach = torch.full_like(labels, -1), Reach.of(points, squared)
    labels, squared = labels.clone(), squared.clone()
    for other in others:
        rows = reach.rows(other.bounds)
        if len(rows) == 0:
            continue
        found, distances = nearest(points[rows], other.load())
        closer = distances < squared[rows]
        rows = rows[closer]
        blocks[rows], labels[rows] = other.block, found[closer]
        squared[rows] = distances[closer]
    return Nearest(blocks, labels, squared)


def halo(
    centers: Float[Tensor, "m 3"], others: Iterable[Across], *, count: int, backend: str
) -> Int[Tensor, "h 2"]:
    """Find the cells of other blocks that may be among the nearest others of an own cell."""
    places = centers.double()
    if len(places) > count:
        _, distances = nearest_several(places, places, count + 1, backend=backend)
        squared = distances[:, -1].square()
    else:
        squared = torch.full_like(places[:, 0], torch.inf)
    reach, found = Reach.of(places, squared), [torch.zeros(0, 2, dtype=torch.int64)]
    for other in others:
        rows = reach.rows(other.bounds)
        if len(rows) == 0:
            continue
        cells, distances = nearest_several(places[rows], other.load(), count, backend=backend)
        near = torch.unique(cells[distances.square() <= squared[rows][:, None]])
        found.append(torch.stack([torch.full_like(near, other.block), near], dim=1))
    return torch.cat(found)
