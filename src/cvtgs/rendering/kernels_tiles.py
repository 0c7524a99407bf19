"""Compiled loops that list the splats of each tile, and the pixels of tiles and splats.

The lists are those of ``torch_backend``.
"""

import math

import numpy as np

from cvtgs.math.parameters import MIN_ALPHA
from cvtgs.rendering.compiled import Array, Bools, Ints, PixelBox, parallel, prange, serial

SLACK = 1e-3
LOG_MIN_ALPHA = math.log(MIN_ALPHA)
# Prime step between tiles. Neighbouring tiles cost alike, so this balances the threads.
STRIDE = 1009


@serial
def pixel_range(low: float, high: float, count: int) -> tuple[int, int]:
    """Return the first and last of ``count`` pixels whose centres lie in an interval."""
    slack = SLACK + 1e-6 * (high - low)
    first = math.ceil(min(max(low - 0.5 - slack, 0.0), float(count)))
    last = math.floor(min(max(high - 0.5 + slack, -1.0), count - 1.0))
    return int(first), int(last)


@serial
def strip(
    splat: Array, reach: float, size: tuple[int, int], rows: tuple[int, int]
) -> tuple[int, int]:
    """Return the first and last pixel column that a splat reaches within a range of rows."""
    x, y = float(splat[0]), float(splat[1])
    steep, shear, flat = -2.0 * splat[2], float(splat[3]), -2.0 * splat[4]
    upper, lower = rows[0] + 0.5 - y, rows[1] + 0.5 - y
    tip = 0.0
    if reach > 0:
        tip = -shear / flat * math.sqrt(reach / (1 / steep + shear * shear / flat))
    high, low = min(max(tip, upper), lower), min(max(-tip, upper), lower)
    right = -shear * high + math.sqrt(max(0.0, reach - flat * high * high) / steep)
    left = -shear * low - math.sqrt(max(0.0, reach - flat * low * low) / steep)
    return pixel_range(x + left, x + right, size[0])


@serial
def tiles_of(
    splat: Array, size: tuple[int, int], side: int, out: Ints, start: int, most: int
) -> int:
    """Count the tiles of a splat, and write the indices of the first ``most`` of them."""
    reach = max(0.0, 2.0 * (splat[5] - LOG_MIN_ALPHA))
    half = math.sqrt(reach / (-2.0 * splat[4]))
    top, bottom = pixel_range(splat[1] - half, splat[1] + half, size[1])
    across = (size[0] + side - 1) // side
    count = 0
    if bottom < top:
        return count
    for row in range(top // side, bottom // side + 1):
        rows = (max(top, row * side), min(bottom, row * side + side - 1))
        first, last = strip(splat, reach, size, rows)
        if last < first:
            continue
        here = last // side - first // side + 1
        for number in range(min(here, most - count)):
            out[start + count + number] = row * across + first // side + number
        count += here
    return count


@parallel
def count_tiles(packed: Array, size: tuple[int, int], side: int, counts: Ints, first: Ints) -> None:
    """Write the number of tiles that each splat touches, and the index of the first."""
    for i in prange(len(packed)):
        counts[i] = tiles_of(packed[i], size, side, first, i, 1)


@parallel
def write_tiles(
    packed: Array, size: tuple[int, int], side: int, starts: Ints, first: Ints, tile_ids: Ints
) -> None:
    """Write the indices of the tiles that each splat touches; most splats touch only the first."""
    for i in prange(len(packed)):
        count = starts[i + 1] - starts[i]
        if count == 1:
            tile_ids[starts[i]] = first[i]
        elif count > 1:
            tiles_of(packed[i], size, side, tile_ids, starts[i], count)


@serial
def sort_by_tile(
    tile_ids: Ints, splat_starts: Ints, is_open: Bools, tile_starts: Ints, lists: Ints
) -> None:
    """Write the lists of open tiles by counting sort: index in splat order, and splat."""
    for tile_id in tile_ids:
        if is_open[tile_id]:
            tile_starts[tile_id + 1] += 1
    for tile in range(len(tile_starts) - 1):
        tile_starts[tile + 1] += tile_starts[tile]
    free = tile_starts.copy()
    for splat in range(len(splat_starts) - 1):
        for place in range(splat_starts[splat], splat_starts[splat + 1]):
            if not is_open[tile_ids[place]]:
                continue
            at = free[tile_ids[place]]
            free[tile_ids[place]] += 1
            lists[at, 0] = place
            lists[at, 1] = splat


@serial
def span(low: float, high: float, begin: int, end: int) -> tuple[int, int]:
    """Return the half-open range of pixels in [begin, end) whose centres lie in an interval."""
    first = math.ceil(max(low - 0.5 - SLACK, float(begin)))
    last = math.floor(min(high - 0.5 + SLACK, end - 1.0))
    # A negative end would count from the end of an array.
    return int(first), max(int(first), int(last) + 1)


@serial
def rows_of(splat: Array, box: PixelBox) -> tuple[int, int, float]:
    """Return the rows of a tile that a splat reaches, and the exponent of alpha at its edge."""
    zero, lowest = splat.dtype.type(0), splat.dtype.type(LOG_MIN_ALPHA)  # float64 is slower
    room = min(zero, lowest - splat[5])
    half = math.sqrt(room / splat[4])
    top, bottom = span(splat[1] - half, splat[1] + half, box[2], box[3])
    return top, bottom, room


@serial
def columns_of(splat: Array, box: PixelBox, down: float) -> tuple[int, int, float, float]:
    """Return the columns that a splat reaches in a row, and the x and log alpha of its peak."""
    zero, lowest = splat.dtype.type(0), splat.dtype.type(LOG_MIN_ALPHA)
    middle = splat[0] - splat[3] * down
    exponent = splat[5] + splat[4] * down * down
    half = math.sqrt(max(zero, (lowest - exponent) / splat[2]))
    first, end = span(middle - half, middle + half, box[0], box[1])
    return first, end, middle, exponent


@serial
def tile_at(step: int, count: int) -> int:
    """Return the tile of a step; each tile occurs once."""
    number = np.int64(step)  # numba counts parallel loops in uint64, which % turns into floats
    return int(number * STRIDE % count if count % STRIDE else number)


@serial
def box_of(tile: int, side: int, size: tuple[int, int]) -> PixelBox:
    """Return the pixels of a tile, cropped to the image."""
    across = (size[0] + side - 1) // side
    x, y = tile % across * side, tile // across * side
    return x, min(x + side, size[0]), y, min(y + side, size[1])
