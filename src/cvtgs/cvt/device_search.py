"""Nearest sites on a CUDA device, in torch operations: dense distances of tiles of points.

Sites are split into the leaves of a k-d tree, and points into tiles, runs of points along the
leaves. A tile is compared with all sites of the leaves that may hold a nearest one, in one matrix
product. That is some 500 comparisons per point, whatever the number of sites, in few launches.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs.devices import chunk_length, full_precision, row_chunks
from cvtgs.math.segments import kth_smallest

FAN_BITS = 3  # levels of the tree that are descended at once: a box has eight children
FARTHEST = 1e37  # limit of coordinates in float32, in units
LEAF = 16  # largest number of sites in a leaf, unless more are wanted for each point
TILE = 32  # points per tile: larger ones make longer matrices, but compare points with more sites
TILES = 1 << 12  # tiles per chunk of the descent, at the chunk length of a CPU
PAIRS = 1 << 20  # of tiles and boxes, up to which levels of the tree are skipped
DISTANCES = 1 << 22  # distances per matrix product, at the chunk length of a CPU

CLOSE = 1e-5
"""Squared distances below this share of the squared reach of a tile are too close for float32,
which is off by at most some 3e-7 of it; they are computed again in float64."""

FEW = 1 / 16  # groups of any tiles may take this share of the longest: launches would cost more
EXACT_COST = 8  # memory of an exact distance, in units of that of a fast one, rounded up
SLACK = 1 + 1e-5  # bounds grow by this factor, against rounding of gaps between boxes
LEAST_GAP, LARGEST_GAP = 1e-18, 1e17  # limits in float32, in units of a common search radius


def box_corners(points: Float[Tensor, "k p d"]) -> Float[Tensor, "k two_d"]:
    """Return the smallest coordinates of groups of points, and the largest ones, negated.

    So both are rounded downwards, and a box around others has the smallest of both.
    """
    return torch.cat([points.amin(dim=1), -points.amax(dim=1)], dim=1)


def rounded_outwards(
    corners: Float[Tensor, "k two_d"], unit: Float[Tensor, ""]
) -> Float[Tensor, "k two_d"]:
    """Return the corners of boxes in float32 and in units, rounded downwards."""
    exact = (corners / unit).clamp_(-FARTHEST, FARTHEST)
    inner = exact.float()
    below = inner.nextafter(torch.full_like(inner[0], -torch.inf))
    return torch.where(inner > exact, below, inner)


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


def boxes_of(sites: Float[Tensor, "b s d"]) -> list[Float[Tensor, "k two_d"]]:
    """Return the boxes of the tree, level by level from few large ones to the leaves."""
    levels = [box_corners(sites)]
    while len(levels[0]) > 1 << FAN_BITS:
        levels.insert(0, levels[0].unflatten(0, (-1, 1 << FAN_BITS)).amin(dim=1))
    return levels


class Tiles(NamedTuple):
    """Runs of points that lie close together."""

    points: Float[Tensor, "t p d"]  # in the last tile, some occur twice
    bounds: Float[Tensor, "t"]  # squared distance within which every point has its nearest sites
    boxes: Float[Tensor, "t two_d"]  # around the points
    first: Int[Tensor, "t"]  # the first leaf that its points lie in
    last: Int[Tensor, "t"]  # the last one
    reach: Float[Tensor, "t"]  # distance from the middle within which all nearest sites lie


def nearest_in_tiles(
    points: Float[Tensor, "n d"], sites: Float[Tensor, "m d"], count: int = 1
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    """Find the nearest sites of every point, but for a percent or less, on the device of both.

    Distances are in float32, relative to the middle of the tile; in float64 if that is too coarse.
    """
    points, sites = points.double(), sites.double()
    found = torch.empty(len(points), count, dtype=torch.int64, device=points.device)
    squared = points.new_empty(len(points), count)
    if len(points) == 0:
        return found, squared
    leaves = split_sites(sites, max(LEAF, 4 * count))  # at least twice as many as wanted
    homes, order = torch.sort(home_leaves(points, leaves.splits), stable=True)
    boxes = boxes_of(leaves.sites)
    with full_precision():
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
    boxes: Sequence[Tensor],
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
    step = max(1, chunk_length(DISTANCES, points.device) // (8 * points.numel()))
    return torch.cat(
        [
            sites[columns].sub_(points[:, None]).square_().sum(2)
            for columns in rows.split(step, dim=1)
        ],
        dim=1,
    )


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
        nearest = squared.amin(1) if count == 1 else kth_smallest(squared, count)
        bounds[part] = nearest
    fill = torch.arange(-(-len(points) // size) * size, device=points.device)
    last = len(points) - 1  # the last tile is filled with its own points, backwards
    fill = torch.where(fill > last, 2 * last + 1 - fill, fill).clamp_min(0).view(-1, size)
    points, bounds = points[fill], bounds[fill].amax(dim=1)
    boxes, own = box_corners(points), homes[fill]
    sides = torch.add(*boxes.chunk(2, dim=1))  # negative
    reach = torch.linalg.vector_norm(sides, dim=1) + bounds.sqrt()
    return Tiles(
        points=points,
        bounds=bounds,
        boxes=boxes,
        first=own.amin(dim=1),
        last=own.amax(dim=1),
        reach=reach.where(reach > 0, 1.0),
    )


def _candidates(
    tiles: Tiles, levels: Sequence[Tensor]
) -> tuple[Int[Tensor, "p"], Int[Tensor, "t"], Int[Tensor, "t"]]:
    """Return lists of leaves that may hold a nearest site, and start and length of each tile's."""
    device = tiles.points.device
    unit = tiles.bounds.median().sqrt()
    unit = torch.where((unit > 0) & unit.isfinite(), unit, tiles.reach.median())
    while len(levels) > 1 and len(tiles.points) * len(levels[1]) <= PAIRS:
        levels = levels[1:]
    # In float32, which halves the memory to read, and rounded so that no pair is lost. Corners of
    # tiles are swapped, so that a sum with those of a box is the gaps on either side.
    axes = tiles.points.shape[2]
    corners = [tiles.boxes.roll(axes, dims=1), *levels]
    ours, *theirs = rounded_outwards(torch.cat(corners), unit).split(list(map(len, corners)))
    bounds = (tiles.bounds / unit.square() * SLACK).clamp(LEAST_GAP**2, 100 * LARGEST_GAP**2)
    bounds = bounds.where(tiles.bounds > 0, 0.0).float()
    tile, ends = torch.arange(len(ours), device=device), torch.stack([tiles.first, tiles.last])
    box, children = torch.zeros_like(tile), torch.arange(len(theirs[0]), device=device)
    for number, boxes in enumerate(theirs):
        if number == 1:
            children = torch.arange(1 << FAN_BITS, device=device)
        sides = boxes.view(-1, len(children), 2 * axes)[box].add_(ours[tile, None])
        gaps = torch.maximum(sides[:, :, :axes], sides[:, :, axes:])
        is_near = gaps.clamp_(0.0, LARGEST_GAP).square_().sum(2) < bounds[tile, None]
        box = torch.add(children, box[:, None], alpha=len(children))
        # A nearest site on the bound itself lies in the leaf of its point.
        first, last = (ends >> FAN_BITS * (len(theirs) - 1 - number))[:, tile, None]
        is_near |= box.clamp(first, last) == box
        parent, child = is_near.nonzero().unbind(1)
        tile, box = tile[parent], box[parent, child]
    edges = torch.searchsorted(tile, torch.arange(len(ours) + 1, device=device))
    return box, edges[:-1], edges.diff()


def _nearest_of_tiles(
    tiles: Tiles, leaves: Leaves, boxes: Sequence[Tensor], count: int, *, is_exact: bool
) -> Int[Tensor, "n k"]:
    """Return places in the leaves of the nearest sites of all points of the tiles, leaf by leaf."""
    near, starts, numbers = _candidates(tiles, boxes)
    (_, side, _), (_, size) = tiles.points.shape, leaves.rows.shape
    device = tiles.points.device
    longest = chunk_length(DISTANCES, device) // (side * size * (EXACT_COST if is_exact else 1))
    negative, order = torch.sort(-numbers, stable=True)
    groups = _alike(negative.tolist(), longest)
    ranks = torch.arange(groups[0][1], device=device)
    lists = torch.nn.functional.pad(near, (0, len(ranks)))  # for ranks beyond the end
    starts, numbers = starts[order, None], numbers[order, None]
    points, reach = tiles.points[order], tiles.reach[order, None, None]
    if not is_exact:
        middles = 0.5 * points.amin(1, keepdim=True) + 0.5 * points.amax(1, keepdim=True)
        points = points.sub_(middles).div_(reach).float().mul_(-2.0)
        points = torch.nn.functional.pad(points, (0, 1), value=1.0)
    places = torch.empty(*points.shape[:2], count, dtype=torch.int64, device=device)
    for group, most in groups:
        choice = lists[starts[group] + ranks[:most]]
        is_padding = ranks[:most] >= numbers[group]
        none = (leaves.is_filling[choice] | is_padding[:, :, None]).flatten(1)
        sites = leaves.sites[choice].flatten(1, 2)
        if is_exact:  # of single points
            distances = sites.sub_(points[group]).square_().sum(2).masked_fill_(none, torch.inf)
            distances = distances[:, None]
        else:
            sites = sites.sub_(middles[group]).div_(reach[group])
            distances = _fast_distances(points[group], sites, none)
        if count == 1:
            torch.argmin(distances, dim=2, keepdim=True, out=places[group])
        else:
            places[group] = distances.topk(count, dim=2, largest=False).indices
    rows = lists[(places // size).add_(starts[:, :, None])].mul_(size).add_(places.remainder_(size))
    return places.index_copy_(0, order, rows).view(-1, count)


def _alike(negative: Sequence[int], longest: int) -> list[tuple[slice, int]]:
    """Group entries whose numbers differ by at most a factor of two, or that are few together.

    Numbers descend, with a minus; their sum in a group of several, padded, is at most ``longest``.
    """
    groups, done = list[tuple[slice, int]](), 0
    while done < len(negative):
        most = -negative[done]
        alike = bisect_left(negative, -(most // 2), done) - done
        few = min(int(FEW * longest) // most, len(negative) - done)
        step = max(1, min(max(alike, few), longest // most))
        groups.append((slice(done, done + step), most))  # and the largest number
        done += step
    return groups


def _fast_distances(
    factors: Float[Tensor, "g q d_plus_1"],
    sites: Float[Tensor, "g c d"],
    none: Bool[Tensor, "g c"],
) -> Float[Tensor, "g q c"]:
    """Return squared distances less those of the points to the middle; infinite without a site.

    Sites are relative to the middle, in units of the reach; factors are -2 times the points, and 1.
    """
    sites = sites.clamp_(-4.0, 4.0).float()  # no site beyond the reach comes within it
    norms = sites.square().sum(2).masked_fill_(none, torch.inf)
    # |s|^2 - 2 p s as one product of longer vectors: adding the norms would read all once more.
    return torch.bmm(factors, torch.cat([sites, norms[:, :, None]], dim=2).mT)
