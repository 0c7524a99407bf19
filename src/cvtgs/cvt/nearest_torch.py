"""Nearest site with plain torch operations, on any device: exact, and never N x M."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cvt.coincident import distinct_rows
from cvtgs.math.frames import morton_order

POINT_BLOCK = 32
SITE_BLOCK = 16
FIRST_BLOCKS = 4
"""Blocks of sites that every block of points looks at before others are ruled out."""

MAX_ENTRIES = 1 << 23
"""Largest number of distances held at one time (64 MiB in float64)."""

UNKNOWN = torch.iinfo(torch.int64).max


def nearest_torch(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"]
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Find the nearest site of every point by comparing blocks that may be near one another.

    Points and sites are cut into blocks along a Morton curve. The few nearest blocks of sites
    give an upper bound for all points of a block; every other block whose bounding box is farther
    is skipped. Distances are sums of squared differences in float64, so the result equals brute
    force, and of equally near sites the first one is named. Memory beside input and result is
    ``3 * MAX_ENTRIES`` numbers.

    Args:
        points: Positions; consecutive points should be neighbours, or hardly a block is skipped.
        sites: Positions, at least one, on the same device.

    Returns:
        Labels and squared distances in float64.

    Example:
        >>> labels, squared = nearest_torch(torch.tensor([[0.9]]), torch.tensor([[0.0], [1.0]]))
        >>> labels.tolist()
        [1]
    """
    distinct = distinct_rows(sites)
    if distinct is not None:  # no box can rule out one of several coincident sites
        labels, squared = nearest_torch(points, sites[distinct])
        return distinct[labels], squared
    site_rows = _curve_order(sites)
    site_blocks, site_ids = (
        _blocks(sites[site_rows].double(), SITE_BLOCK),
        _blocks(site_rows, SITE_BLOCK),
    )
    boxes = site_blocks.amin(dim=1), site_blocks.amax(dim=1)
    point_blocks = _blocks(points, POINT_BLOCK)
    step = max(1, MAX_ENTRIES // (len(site_blocks) + POINT_BLOCK * SITE_BLOCK))
    parts = [
        _nearest_of_blocks(chunk.double(), site_blocks, site_ids, boxes)
        for chunk in point_blocks.split(step)
    ]
    labels = torch.cat([part[0] for part in parts]).flatten()[: len(points)]
    squared = torch.cat([part[1] for part in parts]).flatten()[: len(points)]
    return labels, squared


def _nearest_of_blocks(
    points: Float[Tensor, "b p d"],
    site_blocks: Float[Tensor, "c s d"],
    site_ids: Int[Tensor, "c s"],
    boxes: tuple[Float[Tensor, "c d"], Float[Tensor, "c d"]],
) -> tuple[Int[Tensor, "b p"], Float[Tensor, "b p"]]:
    gaps = _box_gaps((points.amin(dim=1), points.amax(dim=1)), boxes)
    first = gaps.topk(min(FIRST_BLOCKS, len(site_blocks)), dim=1, largest=False).indices
    squared, labels = _nearest_in_pairs(points, site_blocks[first[:, 0]], site_ids[first[:, 0]])
    for other in first[:, 1:].unbind(1):
        found, names = _nearest_in_pairs(points, site_blocks[other], site_ids[other])
        wins = (found < squared) | ((found == squared) & (names < labels))
        squared, labels = torch.where(wins, found, squared), torch.where(wins, names, labels)
    near = (gaps <= squared.amax(dim=1, keepdim=True)).scatter_(1, first, False)
    pairs = near.nonzero().split(max(1, MAX_ENTRIES // (POINT_BLOCK * SITE_BLOCK)))
    for block, other in (pair.unbind(1) for pair in pairs):
        found, names = _nearest_in_pairs(points[block], site_blocks[other], site_ids[other])
        best = squared.scatter_reduce(0, block[:, None].expand_as(found), found, "amin")
        labels = torch.where(squared == best, labels, UNKNOWN)
        names = torch.where(found == best[block], names, UNKNOWN)
        labels = labels.scatter_reduce(0, block[:, None].expand_as(names), names, "amin")
        squared = best
    return labels, squared


def _nearest_in_pairs(
    points: Float[Tensor, "k p d"], sites: Float[Tensor, "k s d"], ids: Int[Tensor, "k s"]
) -> tuple[Float[Tensor, "k p"], Int[Tensor, "k p"]]:
    """Compare every point of a block with every site of the block that it is paired with."""
    total = torch.zeros((), dtype=points.dtype, device=points.device)
    for axis in range(points.shape[2]):
        total = total + (points[:, :, None, axis] - sites[:, None, :, axis]).square()
    squared = total.amin(dim=2)
    is_best = total == squared[:, :, None]
    names = torch.where(is_best, ids[:, None, :], UNKNOWN).amin(dim=2)
    return squared, names


def _box_gaps(
    first: tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]],
    second: tuple[Float[Tensor, "c d"], Float[Tensor, "c d"]],
) -> Float[Tensor, "b c"]:
    """Return squared distances between bounding boxes, rounded down a little."""
    (low, high), (other_low, other_high) = first, second
    total = torch.zeros(len(low), len(other_low), dtype=low.dtype, device=low.device)
    for axis in range(low.shape[1]):
        above = other_low[None, :, axis] - high[:, None, axis]
        below = low[:, None, axis] - other_high[None, :, axis]
        total += torch.maximum(above, below).clamp_min_(0).square_()
    return total * (1 - 8 * torch.finfo(total.dtype).eps)


def _blocks(rows: Tensor, size: int) -> Tensor:
    """Cut rows into blocks of one size; the last block repeats the last row."""
    padding = math.ceil(len(rows) / size) * size - len(rows)
    padded = torch.cat([rows, rows[-1:].expand(padding, *rows.shape[1:])])
    return padded.reshape(-1, size, *rows.shape[1:])


def _curve_order(sites: Float[Tensor, "m d"]) -> Int[Tensor, "m"]:
    spatial = sites[:, :3]
    missing = 3 - spatial.shape[1]
    return morton_order(torch.nn.functional.pad(spatial, (0, missing)))
