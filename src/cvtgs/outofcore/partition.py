"""The k-d partition of space into blocks: planes that halve a measure, again and again."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KdPartition:
    """A k-d tree (Bentley 1975) whose leaves are blocks.

    Attributes:
        axes: ``(k,)`` the axis along which each node splits.
        thresholds: ``(k,)`` coordinate of each splitting plane; points below it go left.
        children: ``(k, 2)`` left and right child of each node; ``-1 - b`` is block b.
        count: Number of blocks; with one there is no node.
    """

    axes: Int[Tensor, "k"]
    thresholds: Float[Tensor, "k"]
    children: Int[Tensor, "k 2"]
    count: int

    def blocks_of(self, points: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
        """Return the block of every point."""
        if self.count == 1:
            return torch.zeros(len(points), dtype=torch.int64)
        nodes = torch.zeros(len(points), dtype=torch.int64)
        while bool((nodes >= 0).any()):
            inner = nodes.clamp_min(0)
            coordinates = points.gather(1, self.axes[inner][:, None])[:, 0]
            side = (coordinates >= self.thresholds[inner]).long()
            nodes = torch.where(nodes >= 0, self.children[inner, side], nodes)
        return -1 - nodes


def partition_space(
    points: Float[Tensor, "n 3"], measure: Float[Tensor, "n"], count: int
) -> KdPartition:
    """Split space into blocks of equal measure, each time across the axis of largest variance."""
    axes: list[int] = []
    thresholds: list[float] = []
    children: list[list[int]] = []
    leaves = 0

    def split(rows: Tensor, blocks: int) -> int:
        nonlocal leaves
        if blocks == 1:
            leaves += 1
            return -leaves
        node = len(axes)
        part, weights = points[rows], measure[rows]
        axis = _widest_axis(part, weights)
        threshold = _weighted_quantile(part[:, axis], weights, (blocks // 2) / blocks)
        axes.append(axis)
        thresholds.append(threshold)
        children.append([0, 0])
        left = part[:, axis] < threshold
        children[node][0] = split(rows[left], blocks // 2)
        children[node][1] = split(rows[~left], blocks - blocks // 2)
        return node

    split(torch.arange(len(points)), count)
    return KdPartition(
        axes=torch.tensor(axes, dtype=torch.int64),
        thresholds=torch.tensor(thresholds, dtype=torch.float64),
        children=torch.tensor(children, dtype=torch.int64).reshape(-1, 2),
        count=count,
    )


def _widest_axis(points: Tensor, weights: Tensor) -> int:
    if len(points) == 0:
        return 0
    shares = (weights / weights.sum().clamp_min(1e-300))[:, None]
    variance = (shares * (points - (shares * points).sum(dim=0)).square()).sum(dim=0)
    return int(variance.argmax())


def _weighted_quantile(coordinates: Tensor, weights: Tensor, share: float) -> float:
    """Return a coordinate below which this share of the weight lies."""
    if len(coordinates) == 0:
        return 0.0
    order = torch.sort(coordinates, stable=True).indices
    below = weights[order].cumsum(0)
    rank = int(torch.searchsorted(below, share * below[-1])) + 1
    ascending = coordinates[order]
    low, high = ascending[max(0, rank - 1)], ascending[min(rank, len(order) - 1)]
    middle = float((low + high) / 2)
    return middle if middle > float(low) else float(high)
