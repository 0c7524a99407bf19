"""Compiled loops that list the splats of each tile and composite them, forward and backward.

The lists are those of ``torch_backend``. Compositing visits the pixels that each splat reaches,
splat by splat; its gradient also runs front to back.
"""

import math

import numpy as np
from numpy.typing import NDArray

from cvtgs.rendering.compiled import Array, Ints, PixelBox, TileArrays, parallel, prange, serial
from cvtgs.rendering.projection import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

SLACK = 1e-3
LOG_MIN_ALPHA = math.log(MIN_ALPHA)
STRIDE = 1009
"""Prime step between tiles. Neighbouring tiles cost alike, so this balances the threads."""


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
def tiles_of(splat: Array, size: tuple[int, int], side: int, out: Ints, start: int) -> int:
    """Count the tiles of a splat; also write their indices unless ``start`` is negative."""
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
        for column in range(first // side, last // side + 1):
            if start >= 0:
                out[start + count] = row * across + column
            count += 1
    return count


@parallel
def count_tiles(packed: Array, size: tuple[int, int], side: int, counts: Ints) -> None:
    """Write the number of tiles that each splat touches."""
    for i in prange(len(packed)):
        counts[i] = tiles_of(packed[i], size, side, counts, -1)


@parallel
def write_tiles(
    packed: Array, size: tuple[int, int], side: int, starts: Ints, tile_ids: Ints
) -> None:
    """Write the indices of the tiles that each splat touches."""
    for i in prange(len(packed)):
        tiles_of(packed[i], size, side, tile_ids, starts[i])


@serial
def sort_by_tile(tile_ids: Ints, splat_starts: Ints, tile_starts: Ints, lists: Ints) -> None:
    """Write the tiles' lists by counting sort: index in splat order, and splat."""
    for tile_id in tile_ids:
        tile_starts[tile_id + 1] += 1
    for tile in range(len(tile_starts) - 1):
        tile_starts[tile + 1] += tile_starts[tile]
    free = tile_starts.copy()
    for splat in range(len(splat_starts) - 1):
        for place in range(splat_starts[splat], splat_starts[splat + 1]):
            at = free[tile_ids[place]]
            free[tile_ids[place]] += 1
            lists[at, 0] = place
            lists[at, 1] = splat


@serial
def span(low: float, high: float, begin: int, end: int) -> tuple[int, int]:
    """Return the half-open range of pixels in [begin, end) whose centres lie in an interval."""
    first = math.ceil(max(low - 0.5 - SLACK, float(begin)))
    last = math.floor(min(high - 0.5 + SLACK, end - 1.0))
    return int(first), int(last) + 1


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


@parallel
def composite_all(
    packed: Array, tiles: TileArrays, centers: Array, image: Array, weights: Array
) -> None:
    """Write weighted sums of red, green, blue and depth, and the transmittance, of each pixel.

    If ``weights`` is not empty, also write the sum of ``alpha * T`` over the pixels of every
    intersection of a splat and a tile, in splat order.
    """
    starts, lists, side = tiles
    height, width = image.shape[:2]
    for step in prange(len(starts) - 1):
        tile = tile_at(step, len(starts) - 1)
        box = box_of(tile, side, (width, height))
        x0, x1, y0, y1 = box
        is_open = np.ones((side, side), np.bool_)
        layers = image[y0:y1, x0:x1]
        for y in range(y1 - y0):
            for x in range(x1 - x0):
                for channel in range(4):
                    layers[y, x, channel] = 0
                layers[y, x, 4] = 1
        pending = (y1 - y0) * (x1 - x0)
        for entry in range(starts[tile], starts[tile + 1]):
            splat = packed[lists[entry, 1]]
            finished, total = blend(splat, box, centers, layers, is_open)
            pending -= finished
            if len(weights):
                weights[lists[entry, 0]] = total
            if pending == 0:
                break


@serial
def blend(
    splat: Array,
    box: PixelBox,
    centers: Array,
    layers: Array,
    is_open: NDArray[np.bool_],
) -> tuple[int, float]:
    """Blend one splat into a tile; return the number of pixels finished, and its summed weight."""
    finished, total = 0, 0.0
    x0, x1, y0, y1 = box
    one, least = centers.dtype.type(1), centers.dtype.type(MIN_TRANSMITTANCE)
    faintest, most = centers.dtype.type(MIN_ALPHA), centers.dtype.type(MAX_ALPHA)
    square, shear, rest, log_opacity = splat[2], splat[3], splat[4], splat[5]
    half = math.sqrt(max(0.0, (LOG_MIN_ALPHA - log_opacity) / rest))
    top, bottom = span(splat[1] - half, splat[1] + half, y0, y1)
    for y in range(top, bottom):
        down = centers[y] - splat[1]
        middle = splat[0] - shear * down
        exponent = log_opacity + rest * down * down
        half = math.sqrt(max(0.0, (LOG_MIN_ALPHA - exponent) / square))
        first, end = span(middle - half, middle + half, x0, x1)
        for x in range(first, end):
            if not is_open[y - y0, x - x0]:
                continue
            along = centers[x] - middle
            alpha = min(most, math.exp(exponent + square * along * along))
            if alpha < faintest:
                continue
            pixel = layers[y - y0, x - x0]
            after = pixel[4] * (one - alpha)
            if after < least:
                is_open[y - y0, x - x0] = False
                finished += 1
                continue
            weight = alpha * pixel[4]
            for channel in range(4):
                pixel[channel] += weight * splat[6 + channel]
            pixel[4] = after
            total += weight
    return finished, total


@parallel
def composite_all_gradient(
    packed: Array,
    tiles: TileArrays,
    centers: Array,
    image: Array,
    grad: Array,
    per_intersection: Array,
) -> None:
    """Write the gradient by the packed splat of every intersection, in splat order."""
    starts, lists, side = tiles
    height, width = image.shape[:2]
    for step in prange(len(starts) - 1):
        tile = tile_at(step, len(starts) - 1)
        box = box_of(tile, side, (width, height))
        x0, x1, y0, y1 = box
        transmittance = np.ones((side, side), image.dtype)
        behind = np.zeros((side, side), image.dtype)
        for y in range(y0, y1):
            for x in range(x0, x1):
                for channel in range(5):
                    behind[y - y0, x - x0] += image[y, x, channel] * grad[y, x, channel]
        pending = (y1 - y0) * (x1 - x0)
        state = (transmittance, behind)
        for entry in range(starts[tile], starts[tile + 1]):
            splat, out = packed[lists[entry, 1]], per_intersection[lists[entry, 0]]
            pending -= blend_gradient(splat, box, centers, grad[y0:y1, x0:x1], state, out)
            if pending == 0:
                break


@serial
def blend_gradient(
    splat: Array,
    box: PixelBox,
    centers: Array,
    grad: Array,
    state: tuple[Array, Array],
    out: Array,
) -> int:
    """Write the gradient of one splat in a tile; return the number of pixels it finished.

    ``state`` holds for each pixel the transmittance in front of this splat (0 where finished), and
    the gradient times all light from this splat and behind it. ``out`` must be 0 on entry.
    """
    finished = 0
    transmittance, behind = state
    x0, x1, y0, y1 = box
    square, shear, rest, log_opacity = splat[2], splat[3], splat[4], splat[5]
    half = math.sqrt(max(0.0, (LOG_MIN_ALPHA - log_opacity) / rest))
    top, bottom = span(splat[1] - half, splat[1] + half, y0, y1)
    for y in range(top, bottom):
        down = centers[y] - splat[1]
        middle = splat[0] - shear * down
        exponent = log_opacity + rest * down * down
        half = math.sqrt(max(0.0, (LOG_MIN_ALPHA - exponent) / square))
        first, end = span(middle - half, middle + half, x0, x1)
        row = (
            transmittance[y - y0, first - x0 :],
            behind[y - y0, first - x0 :],
            grad[y - y0, first - x0 :],
        )
        done, zeroth, moment, second = blend_row_gradient(
            splat, exponent, centers[first:end] - middle, row, out
        )
        finished += done
        out[0] -= 2 * square * moment
        out[1] -= 2 * (square * shear * moment + rest * down * zeroth)
        out[2] += second
        out[3] += 2 * square * moment * down
        out[4] += zeroth * down * down
        out[5] += zeroth
    return finished


@serial
def blend_row_gradient(
    splat: Array,
    exponent: float,
    ways: Array,
    row: tuple[Array, Array, Array],
    out: Array,
) -> tuple[int, float, float, float]:
    """Add gradients by colour and depth; return pixels finished and moments for the exponent."""
    finished = 0
    one, zero = ways.dtype.type(1), ways.dtype.type(0)
    least, most = ways.dtype.type(MIN_TRANSMITTANCE), ways.dtype.type(MAX_ALPHA)
    faintest = ways.dtype.type(MIN_ALPHA)
    transmittance, behind, grad = row
    zeroth, moment, second = zero, zero, zero
    for x in range(len(ways)):
        reaching = transmittance[x]
        if reaching == zero:
            continue
        along = ways[x]
        alpha = min(most, math.exp(exponent + splat[2] * along * along))
        if alpha < faintest:
            continue
        after = reaching * (one - alpha)
        if after < least:
            transmittance[x] = zero
            finished += 1
            continue
        transmittance[x] = after
        weight, worth = alpha * reaching, zero
        for channel in range(4):
            worth += splat[6 + channel] * grad[x, channel]
            out[6 + channel] += weight * grad[x, channel]
        behind[x] -= weight * worth
        if alpha < most:
            g = alpha * (reaching * worth - behind[x] / (one - alpha))
            zeroth += g
            moment += g * along
            second += g * along * along
    return finished, zeroth, moment, second
