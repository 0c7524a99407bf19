"""Nearest sites on a CUDA device, in torch operations: dense distances of tiles of points.

Sites are split into the leaves of a k-d tree, and points into tiles, runs of points along the
leaves. A tile is compared with all sites of the leaves that may hold a nearest one, in one matrix
product. That is some hundred comparisons per point, whatever the number of sites, in few launches.
"""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs.cvt.leaves import FAN_BITS, Boxes, Leaves, boxes_of, home_leaves, split_sites
from cvtgs.devices import chunk_length, row_chunks

LEAF = 16  # largest number of sites in a leaf, unless more are wanted for each point

TILE = 32
"""Points per tile. Larger tiles make longer matrices, but compare each point with more sites."""

TILES = 1 << 12  # tiles per chunk of the descent, at the chunk length of a CPU
DISTANCES = 1 << 22  # distances per matrix product, at the chunk length of a CPU

CLOSE = 1e-5
"""Squared distances below this share of the squared reach of a tile are too close for float32,
which is off by at most some 3e-7 of it; they are computed again in float64."""

EXACT_COST = 8  # memory of an exact distance, in units of that of a fast one, rounded up
SLACK = 1 + 1e-5  # bounds grow by this factor, against rounding of gaps between boxes

LEAST_GAP, LARGEST_GAP = 1e-18, 1e17
"""Limits of gaps in float32, in units of a common search radius."""


class Tiles(NamedTuple):
    """Runs of points that lie close together."""

    points: Float[Tensor, "t p d"]  # in the last tile, some occur twice
    bounds: Float[Tensor, "t"]  # squared distance within which every point has its nearest sites
    boxes: Boxes  # around the points
    first: Int[Tensor, "t"]  # the first leaf that its points lie in
    last: Int[Tensor, "t"]  # the last one
    reach: Float[Tensor, "t"]  # distance from the middle within which all nearest sites lie


class Candidates(NamedTuple):
    """Lists of leaves that may hold a nearest site, one after the other."""

    leaves: Int[Tensor, "p"]  # the leaves of all lists
    starts: Int[Tensor, "t"]  # where the list of each tile starts
    numbers: Int[Tensor, "t"]  # its length, at least 1


def nearest_in_tiles(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"], count: int = 1
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    """Find the nearest sites of every point, on the device of both.

    Sites are chosen by distances in float32, relative to the middle of the tile, and by distances
    in float64 where those are too coarse. Where two sites are equally near but for a percent or
    less, either may be found.
    """
    points, sites = points.double(), sites.double()
    found = torch.empty(len(points), count, dtype=torch.int64, device=points.device)
    squared = points.new_empty(len(points), count)
    if len(points) == 0:
        return found, squared
    leaves = split_sites(sites, max(LEAF, 4 * count))  # at least twice as many as wanted
    homes, order = torch.sort(home_leaves(points, leaves.splits), stable=True)
    boxes = boxes_of(leaves.sites)
    with _full_float32():
        for part in row_chunks(len(points), TILES * TILE, points.device):
            rows, own = order[part], homes[part]
            found[rows], squared[rows] = _nearest_of_part(points[rows], own, leaves, boxes, count)
    if count > 1:
        squared, ranks = torch.sort(squared, dim=1, stable=True)
        found = found.gather(1, ranks)
    return found, squared


def _nearest_of_part(
    points: Float[Tensor, "n d"],
    homes: Int[Tensor, "n"],
    leaves: Leaves,
    boxes: Sequence[Boxes],
    count: int,
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    """Search for points that are sorted by the leaves they lie in; nearest sites in any order."""
    tiles = tiles_of(points, homes, leaves, count, size=TILE)
    near = _nearest_of_tiles(tiles, leaves, boxes, count, is_exact=False)[: len(points)]
    limits = (CLOSE * tiles.reach.square()).repeat_interleave(TILE)[: len(points), None]
    sites = leaves.sites.flatten(0, 1)
    squared = _squared(points, sites, near)
    unsure = ((squared > 0) & (squared < limits)).any(dim=1).nonzero()[:, 0]
    if len(unsure):
        singles = tiles_of(points[unsure], homes[unsure], leaves, count, size=1)
        near[unsure] = _nearest_of_tiles(singles, leaves, boxes, count, is_exact=True)
        squared[unsure] = _squared(points[unsure], sites, near[unsure])
    return leaves.rows.flatten()[near], squared


def _squared(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"], rows: Int[Tensor, "n k"]
) -> Float[Tensor, "n k"]:
    """Return the squared distances of points to some sites each."""
    return torch.stack([(points - sites[column]).square().sum(1) for column in rows.T], dim=1)


def tiles_of(
    points: Float[Tensor, "n d"], homes: Int[Tensor, "n"], leaves: Leaves, count: int, *, size: int
) -> Tiles:
    """Cut points, sorted by the leaf they lie in, into tiles of one size; bound their search."""
    bounds = torch.empty(len(points), dtype=points.dtype, device=points.device)
    step = max(1, chunk_length(DISTANCES, points.device) // (4 * leaves.sites[0].numel()))
    for start in range(0, len(points), step):
        part = slice(start, start + step)
        own = homes[part]
        squared = (leaves.sites[own] - points[part, None]).square().sum(2)
        squared = squared.masked_fill(leaves.is_filling[own], torch.inf)
        nearest = squared.amin(1) if count == 1 else squared.kthvalue(count, dim=1).values
        bounds[part] = nearest
    fill = torch.arange(-(-len(points) // size) * size, device=points.device)
    last = len(points) - 1  # the last tile is filled with its own points, backwards
    fill = torch.where(fill > last, 2 * last + 1 - fill, fill).clamp_min(0).view(-1, size)
    points, bounds = points[fill], bounds[fill].amax(dim=1)
    boxes = Boxes.around(points)
    reach = torch.linalg.vector_norm(boxes.high - boxes.low, dim=1) + bounds.sqrt()
    return Tiles(
        points=points,
        bounds=bounds,
        boxes=boxes,
        first=homes[fill].amin(dim=1),
        last=homes[fill].amax(dim=1),
        reach=reach.where(reach > 0, 1.0),
    )


def _candidates(tiles: Tiles, levels: Sequence[Boxes]) -> Candidates:
    """Return the leaves that may hold a nearest site of each tile.

    Boxes are compared in float32, which halves the memory to read, and so that no pair is lost.
    """
    device = tiles.points.device
    unit = tiles.bounds.median().sqrt()
    unit = torch.where((unit > 0) & unit.isfinite(), unit, tiles.reach.median())
    ours, theirs = tiles.boxes.enlarged(unit), [boxes.enlarged(unit) for boxes in levels]
    bounds = (tiles.bounds / unit.square() * SLACK).clamp(LEAST_GAP**2, 100 * LARGEST_GAP**2)
    bounds = bounds.where(tiles.bounds > 0, 0.0).float()
    tile = torch.arange(len(bounds), device=device).repeat_interleave(len(theirs[0].low))
    box = torch.arange(len(theirs[0].low), device=device).repeat(len(bounds))
    for number, boxes in enumerate(theirs):
        if number:
            children = torch.arange(1 << FAN_BITS, device=device)
            tile = tile.repeat_interleave(1 << FAN_BITS)
            box = ((box[:, None] << FAN_BITS) + children).flatten()
        gaps = torch.maximum(boxes.low[box] - ours.high[tile], ours.low[tile] - boxes.high[box])
        is_near = gaps.clamp_(0.0, LARGEST_GAP).square_().sum(1) < bounds[tile]
        # A nearest site on the bound itself lies in the leaf of its point.
        shift = FAN_BITS * (len(levels) - 1 - number)
        is_near |= (tiles.first[tile] >> shift <= box) & (box <= tiles.last[tile] >> shift)
        kept = is_near.nonzero()[:, 0]
        tile, box = tile[kept], box[kept]
    numbers = torch.bincount(tile, minlength=len(bounds))
    return Candidates(box, numbers.cumsum(0) - numbers, numbers)


def _nearest_of_tiles(
    tiles: Tiles, leaves: Leaves, boxes: Sequence[Boxes], count: int, *, is_exact: bool
) -> Int[Tensor, "n k"]:
    """Return places in the leaves of the nearest sites of all points of the tiles, leaf by leaf."""
    candidates = _candidates(tiles, boxes)
    (_, side, _), (_, size) = tiles.points.shape, leaves.rows.shape
    device, ranks_of = tiles.points.device, torch.arange(size, device=tiles.points.device)
    found = torch.empty(*tiles.points.shape[:2], count, dtype=torch.int64, device=device)
    longest = chunk_length(DISTANCES, device) // (side * size * (EXACT_COST if is_exact else 1))
    for group, most in _alike(candidates.numbers, longest):
        first, numbers = (values[group, None] for values in candidates[1:])
        ranks = torch.arange(most, device=device)
        is_padding = ranks >= numbers
        choice = candidates.leaves[torch.where(is_padding, first, first + ranks)]
        none = (leaves.is_filling[choice] | is_padding[:, :, None]).flatten(1)
        points, sites = tiles.points[group], leaves.sites[choice].flatten(1, 2)
        if is_exact:
            distances = _exact_distances(points, sites).masked_fill_(none[:, None], torch.inf)
        else:
            distances = _fast_distances(points, sites, none, tiles.reach[group, None, None])
        if count == 1:
            places = distances.argmin(dim=2, keepdim=True)
        else:
            places = distances.topk(count, dim=2, largest=False).indices
        rows = (choice[:, :, None] * size + ranks_of).flatten(1)
        found[group] = rows.gather(1, places.flatten(1)).view(places.shape)
    return found.view(-1, count)


def _alike(numbers: Int[Tensor, "g"], longest: int) -> Iterator[tuple[Int[Tensor, "h"], int]]:
    """Group entries whose numbers differ by at most a factor of two; yield the largest number too.

    ``longest`` is the largest sum of numbers in a group of several.
    """
    ascending, order = torch.sort(-numbers, stable=True)
    negative: list[int] = ascending.tolist()
    done = 0
    while done < len(negative):
        most = -negative[done]
        alike = bisect_left(negative, -(most // 2), done) - done
        step = max(1, min(alike, longest // most))
        yield order[done : done + step], most
        done += step


def _fast_distances(
    points: Float[Tensor, "g q d"],
    sites: Float[Tensor, "g c d"],
    none: Bool[Tensor, "g c"],
    reach: Float[Tensor, "g 1 1"],
) -> Float[Tensor, "g q c"]:
    """Return squared distances less those of the points to the middle, in float32.

    They are in units of the reach, and infinite where there is no site. Sites beyond the reach come
    closer, but not within it.
    """
    middle = 0.5 * points.amin(1, keepdim=True) + 0.5 * points.amax(1, keepdim=True)
    sites = ((sites - middle) / reach).clamp_(-4.0, 4.0).float()
    points = ((points - middle) / reach).float()
    norms = sites.square().sum(2).masked_fill_(none, torch.inf)
    # |s|^2 - 2 p s as one product of longer vectors: adding the norms would read all once more.
    points = torch.nn.functional.pad(points.mul_(-2.0), (0, 1), value=1.0)
    return torch.bmm(points, torch.cat([sites, norms[:, :, None]], dim=2).mT)


def _exact_distances(
    points: Float[Tensor, "g q d"], sites: Float[Tensor, "g c d"]
) -> Float[Tensor, "g q c"]:
    """Return squared distances in float64."""
    total = points.new_zeros(*points.shape[:2], sites.shape[1])
    for own, other in zip(points.unbind(2), sites.unbind(2), strict=True):
        total += (own[:, :, None] - other[:, None]).square_()
    return total


@contextmanager
def _full_float32() -> Iterator[None]:
    """Multiply matrices in float32, even if the program allows fewer bits (TF32)."""
    before = torch.get_float32_matmul_precision()
    if before == "highest":
        yield
        return
    torch.set_float32_matmul_precision("highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
