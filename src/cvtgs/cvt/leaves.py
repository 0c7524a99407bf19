"""A balanced k-d tree of sites in torch operations: leaves, boxes, and the leaf of a point."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

FAN_BITS = 3  # levels of the tree that are descended at once: a box has eight children
FARTHEST = 1e37  # limit of coordinates in float32, in units


class Boxes(NamedTuple):
    """Boxes with axes along the coordinates.

    Their largest coordinates are stored with the opposite sign, so that both are rounded downwards,
    and a box around others has the smallest of both.
    """

    corners: Float[Tensor, "k two_d"]  # smallest coordinates, and the largest ones, negated

    @property
    def low(self) -> Float[Tensor, "k d"]:
        """The smallest coordinates."""
        return self.corners[:, : self.corners.shape[1] // 2]

    @property
    def high(self) -> Float[Tensor, "k d"]:
        """The largest coordinates."""
        return -self.corners[:, self.corners.shape[1] // 2 :]

    @classmethod
    def around(cls, points: Float[Tensor, "k p d"]) -> "Boxes":
        """Return the boxes around groups of points."""
        return cls(torch.cat([points.amin(dim=1), -points.amax(dim=1)], dim=1))

    def enlarged(self, unit: Float[Tensor, ""]) -> "Boxes":
        """Return boxes in float32 and in units, rounded outwards."""
        exact = (self.corners / unit).clamp_(-FARTHEST, FARTHEST)
        inner = exact.float()
        below = inner.nextafter(torch.full_like(inner[0], -torch.inf))
        return Boxes(torch.where(inner > exact, below, inner))


class Leaves(NamedTuple):
    """Sites in the leaves of a balanced k-d tree, all of equal size."""

    sites: Float[Tensor, "b s d"]  # to fill the leaves, some sites occur twice
    rows: Int[Tensor, "b s"]
    is_filling: Bool[Tensor, "b s"]  # whether a site occurs in another place as well
    # Axis and position of the split of every box, level by level from the root.
    splits: list[tuple[Int[Tensor, "k"], Float[Tensor, "k"]]]


def split_sites(sites: Float[Tensor, "m d"], most: int) -> Leaves:
    """Split sites at the medians of the longest axes into leaves of at most ``most`` sites."""
    count, device = len(sites), sites.device
    height = max(0, math.ceil(math.log2(count / most)))
    size = math.ceil(count / 2**height)
    filling = size * 2**height - count
    rows = torch.arange(count, device=device)
    rows = torch.cat([rows, torch.arange(filling, device=device) * count // max(1, filling)])
    places, positions, splits = torch.arange(len(rows), device=device), sites[rows], []
    for level in range(height):
        parts = positions.view(2**level, -1, sites.shape[1])
        least, largest = torch.aminmax(parts, dim=1)
        axis = (largest - least).argmax(dim=1)
        keys = parts.gather(2, axis[:, None, None].expand(-1, parts.shape[1], 1))[:, :, 0]
        keys, ranks = torch.sort(keys, dim=1, stable=True)
        half = keys.shape[1] // 2
        splits.append((axis, keys[:, half - 1 : half + 1].mean(dim=1)))
        places = places.view(2**level, -1).gather(1, ranks).flatten()
        positions = parts.gather(1, ranks[:, :, None].expand_as(parts)).flatten(0, 1)
    return Leaves(
        sites=positions.view(2**height, size, -1),
        rows=rows[places].view(-1, size),
        is_filling=(places >= count).view(-1, size),
        splits=splits,
    )


def home_leaves(
    points: Float[Tensor, "n d"], splits: list[tuple[Int[Tensor, "k"], Float[Tensor, "k"]]]
) -> Int[Tensor, "n"]:
    """Return the leaf that each point lies in."""
    boxes = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    for axis, place in splits:
        values = points.gather(1, axis[boxes][:, None])[:, 0]
        boxes = torch.add(values > place[boxes], boxes, alpha=2)
    return boxes


def boxes_of(sites: Float[Tensor, "b s d"]) -> list[Boxes]:
    """Return the boxes of the tree, level by level from few large ones to the leaves."""
    levels = [Boxes.around(sites)]
    while len(levels[0].corners) > 1 << FAN_BITS:
        levels.insert(0, Boxes(levels[0].corners.unflatten(0, (-1, 1 << FAN_BITS)).amin(dim=1)))
    return levels
