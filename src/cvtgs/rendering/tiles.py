"""Which splats touch which square tiles of an image, without a loop over splats."""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from cvtgs.math import segments
from cvtgs.rendering.projection import Splats, half_sizes, reach_of

_SLACK = 1e-3
"""Pixels by which boxes are widened, so that rounding leaves nothing out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TileLists:
    """The splats of each tile, front to back.

    Attributes:
        splats: ``(p,)`` splat of each intersection; by tile, then by depth.
        starts: ``(t + 1,)`` where each tile's list starts; tiles run along the rows.
        ranks: ``(p,)`` place of each intersection if they were by splat, then by tile.
        splat_starts: ``(m + 1,)`` where each splat's intersections start in that other order.
        side: Pixels along a tile's edge.
        across: Tiles per row.
    """

    splats: Int[Tensor, "p"]
    starts: Int[Tensor, "t_plus_1"]
    ranks: Int[Tensor, "p"]
    splat_starts: Int[Tensor, "m_plus_1"]
    side: int
    across: int


@torch.no_grad()
def intersect(splats: Splats, size: tuple[int, int], side: int) -> TileLists:
    """List the tiles that hold a pixel on which a splat's alpha reaches 1/255.

    The test is exact up to rounding, which only ever adds tiles: each splat is cut into the rows
    of tiles that it crosses, and the ellipse's extent within each row gives the tiles.

    Memory: about 60 bytes per intersection and 100 per splat.
    """
    width, height = size
    across, down = -(-width // side), -(-height // side)
    splat, row, first, last = _strips(splats, size, side)
    counts = (last - first + 1).clamp_min(0)
    strip, place = _expand(counts)
    tiles = (row[strip] * across + first[strip] + place).to(torch.int32)
    owner = splat[strip]
    sorted_tiles, ranks = torch.sort(tiles, stable=True)
    per_tile = torch.bincount(sorted_tiles, minlength=across * down)
    per_splat = torch.bincount(owner, minlength=len(splats.rows))
    return TileLists(
        splats=owner[ranks],
        starts=torch.nn.functional.pad(per_tile.cumsum(0), (1, 0)),
        ranks=ranks,
        splat_starts=torch.nn.functional.pad(per_splat.cumsum(0), (1, 0)),
        side=side,
        across=across,
    )


def _strips(
    splats: Splats, size: tuple[int, int], side: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cut splats into rows of tiles; give splat, row, first and last column of tiles of each."""
    width, height = size
    reach = reach_of(splats.opacities)
    half_height = half_sizes(splats.ellipses, reach)[1]
    y = splats.centers[:, 1]
    top, bottom = _pixels(y - half_height, y + half_height, height)
    first, last = top // side, bottom // side
    splat, place = _expand(torch.where(bottom >= top, last - first + 1, 0))
    row = first[splat] + place
    y = y[splat]
    upper = torch.maximum(row * side, top[splat]) + 0.5 - y
    lower = torch.minimum(row * side + side - 1, bottom[splat]) + 0.5 - y
    left, right = _extent(splats.ellipses[splat], reach[splat], upper, lower)
    x = splats.centers[:, 0][splat]
    begin, end = _pixels(x + left, x + right, width)
    return splat, row, begin // side, torch.where(end >= begin, end // side, -1)


def _extent(ellipses: Tensor, reach: Tensor, upper: Tensor, lower: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far ellipses go left and right between two heights, all relative to the centre.

    The right edge is a concave function of the height: it is largest at the ellipse's rightmost
    point, or at the end that is nearest to it.
    """
    steep, shear, flat = ellipses.unbind(1)
    half_width = half_sizes(ellipses, reach)[0]
    tip = -shear / flat * reach / half_width.clamp_min(torch.finfo(reach.dtype).tiny)

    def edge(at: Tensor, side: int) -> Tensor:
        height = torch.minimum(torch.maximum(at, upper), lower)
        inside = (reach - flat * height * height).clamp_min(0)
        return -shear * height + side * (inside / steep).sqrt()

    return edge(-tip, -1), edge(tip, 1)


def _pixels(low: Tensor, high: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the first and the last of ``count`` pixels whose centres lie in an interval."""
    slack = _SLACK + 1e-6 * (high - low)
    first = (low - 0.5 - slack).ceil().clamp(0, count)
    last = (high - 0.5 + slack).floor().clamp(-1, count - 1)
    return first.to(torch.int64), last.to(torch.int64)


def _expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Repeat row numbers ``counts`` times; give them, and the number of each repetition."""
    starts = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    rows = segments.segment_ids(starts)
    return rows, torch.arange(len(rows), device=rows.device) - starts[rows]
