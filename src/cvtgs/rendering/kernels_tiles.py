"""List the splats of each tile in compiled loops; the same lists as ``tiles.py``."""

import math

from cvtgs.rendering.arrays import Array, Ints
from cvtgs.rendering.compiled import parallel, prange, serial
from cvtgs.rendering.rules import MIN_ALPHA

SLACK = 1e-3
LOG_MIN_ALPHA = math.log(MIN_ALPHA)


@serial
def pixels(low: float, high: float, count: int) -> tuple[int, int]:
    """Return the first and the last of ``count`` pixels whose centres lie in an interval."""
    slack = SLACK + 1e-6 * (high - low)
    first = math.ceil(min(max(low - 0.5 - slack, 0.0), float(count)))
    last = math.floor(min(max(high - 0.5 + slack, -1.0), count - 1.0))
    return int(first), int(last)


@serial
def strip(
    splat: Array, reach: float, size: tuple[int, int], rows: tuple[int, int]
) -> tuple[int, int]:
    """Return the first and the last pixel column that a splat reaches within some pixel rows."""
    x, y = float(splat[0]), float(splat[1])
    steep, shear, flat = -2.0 * splat[2], float(splat[3]), -2.0 * splat[4]
    upper, lower = rows[0] + 0.5 - y, rows[1] + 0.5 - y
    tip = 0.0
    if reach > 0:
        tip = -shear / flat * math.sqrt(reach / (1 / steep + shear * shear / flat))
    high, low = min(max(tip, upper), lower), min(max(-tip, upper), lower)
    right = -shear * high + math.sqrt(max(0.0, reach - flat * high * high) / steep)
    left = -shear * low - math.sqrt(max(0.0, reach - flat * low * low) / steep)
    return pixels(x + left, x + right, size[0])


@serial
def tiles_of(splat: Array, size: tuple[int, int], side: int, out: Ints, start: int) -> int:
    """Count the tiles of a splat; write their numbers too, unless ``start`` is negative."""
    reach = max(0.0, 2.0 * (splat[5] - LOG_MIN_ALPHA))
    half = math.sqrt(reach / (-2.0 * splat[4]))
    top, bottom = pixels(splat[1] - half, splat[1] + half, size[1])
    across = (size[0] + side - 1) // side
    count = 0
    if bottom < top:
        return count
    for row in range(top // side, bottom // side + 1):
        rows = (max(top, row * side), min(bottom, row * side + side - 1))
        first, last = strip(splat, reach, size, rows)
        if last < first:
            continue
        for column in range(first // side, last // side + 1):
            if start >= 0:
                out[start + count] = row * across + column
            count += 1
    return count


@parallel
def count_tiles(packed: Array, size: tuple[int, int], side: int, counts: Ints) -> None:
    """Write how many tiles each splat touches."""
    for i in prange(len(packed)):
        counts[i] = tiles_of(packed[i], size, side, counts, -1)


@parallel
def name_tiles(packed: Array, size: tuple[int, int], side: int, starts: Ints, names: Ints) -> None:
    """Write the tiles that each splat touches."""
    for i in prange(len(packed)):
        tiles_of(packed[i], size, side, names, starts[i])


@serial
def sort_by_tile(names: Ints, splat_starts: Ints, tile_starts: Ints, lists: Ints) -> None:
    """Write the lists of the tiles by counting: place of the intersection, and its splat."""
    for name in names:
        tile_starts[name + 1] += 1
    for tile in range(len(tile_starts) - 1):
        tile_starts[tile + 1] += tile_starts[tile]
    free = tile_starts.copy()
    for splat in range(len(splat_starts) - 1):
        for place in range(splat_starts[splat], splat_starts[splat + 1]):
            at = free[names[place]]
            free[names[place]] += 1
            lists[at, 0] = place
            lists[at, 1] = splat
