"""Cut space into blocks: planes that halve what lies on their two sides, again and again."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cuts:
    """A k-d tree (Bentley 1975) whose leaves are blocks.

    Attributes:
        axes: ``(k,)`` the axis that each node cuts.
        places: ``(k,)`` where it cuts; what is below goes left.
        children: ``(k, 2)`` nodes on the left and on the right; ``-1 - b`` is block b.
        count: Number of blocks; with one there is no node.
    """

    axes: Int[Tensor, "k"]
    places: Float[Tensor, "k"]
    children: Int[Tensor, "k 2"]
    count: int

    def blocks_of(self, points: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
        """Find the block of every point."""
        if self.count == 1:
            return torch.zeros(len(points), dtype=torch.int64)
        nodes = torch.zeros(len(points), dtype=torch.int64)
        while bool((nodes >= 0).any()):
            here = nodes.clamp_min(0)
            heights = points.gather(1, self.axes[here][:, None])[:, 0]
            side = (heights >= self.places[here]).long()
            nodes = torch.where(nodes >= 0, self.children[here, side], nodes)
        return -1 - nodes


def cut_space(points: Float[Tensor, "n 3"], measure: Float[Tensor, "n"], count: int) -> Cuts:
    """Cut space into blocks of equal measure.

    Each cut is across the axis along which the points of the part are spread most.
    """
    axes: list[int] = []
    places: list[float] = []
    children: list[list[int]] = []
    leaves = 0

    def cut(rows: Tensor, blocks: int) -> int:
        nonlocal leaves
        if blocks == 1:
            leaves += 1
            return -leaves
        node = len(axes)
        part, weights = points[rows], measure[rows]
        axis = _widest(part, weights)
        place = _split(part[:, axis], weights, (blocks // 2) / blocks)
        axes.append(axis)
        places.append(place)
        children.append([0, 0])
        left = part[:, axis] < place
        children[node][0] = cut(rows[left], blocks // 2)
        children[node][1] = cut(rows[~left], blocks - blocks // 2)
        return node

    cut(torch.arange(len(points)), count)
    return Cuts(
        axes=torch.tensor(axes, dtype=torch.int64),
        places=torch.tensor(places, dtype=torch.float64),
        children=torch.tensor(children, dtype=torch.int64).reshape(-1, 2),
        count=count,
    )


def _widest(points: Tensor, weights: Tensor) -> int:
    if len(points) == 0:
        return 0
    shares = (weights / weights.sum().clamp_min(1e-300))[:, None]
    spread = (shares * (points - (shares * points).sum(dim=0)).square()).sum(dim=0)
    return int(spread.argmax())


def _split(heights: Tensor, weights: Tensor, share: float) -> float:
    """Find a height below which this share of the weight lies."""
    if len(heights) == 0:
        return 0.0
    order = torch.sort(heights, stable=True).indices
    below = weights[order].cumsum(0)
    rank = int(torch.searchsorted(below, share * below[-1])) + 1
    sorted_heights = heights[order]
    low, high = sorted_heights[max(0, rank - 1)], sorted_heights[min(rank, len(order) - 1)]
    middle = float((low + high) / 2)
    return middle if middle > float(low) else float(high)
