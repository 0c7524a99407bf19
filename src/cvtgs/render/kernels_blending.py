"""Composite tiles in compiled loops, splat by splat over the pixels that it reaches."""

import math

import numpy as np
from numpy.typing import NDArray

from cvtgs.render.compiled import parallel, prange, serial
from cvtgs.render.rules import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

Array = NDArray[np.floating]
Ints = NDArray[np.integer]

SLACK = 1e-3
LOG_MIN_ALPHA = math.log(MIN_ALPHA)
STRIDE = 1009
"""Neighbouring tiles cost alike; strides by this prime give every thread some of each kind."""


@serial
def span(low: float, high: float, begin: int, end: int) -> tuple[int, int]:
    """Give the range of pixels from ``begin`` to ``end`` whose centres lie in an interval."""
    first = math.ceil(max(low - 0.5 - SLACK, float(begin)))
    last = math.floor(min(high - 0.5 + SLACK, end - 1.0))
    return int(first), int(last) + 1


@serial
def tile_at(step: int, count: int) -> int:
    """Give the tile of a step; all tiles come up once."""
    return step * STRIDE % count if count % STRIDE else step


@parallel
def composite_all(
    packed: Array, tile_starts: Ints, lists: Ints, side: int, centers: Array, picture: Array
) -> None:
    """Write red, green, blue and depth, times what they hide, and transmittance of each pixel."""
    height, width = picture.shape[:2]
    across = (width + side - 1) // side
    for step in prange(len(tile_starts) - 1):
        tile = tile_at(step, len(tile_starts) - 1)
        y0, x0 = tile // across * side, tile % across * side
        y1, x1 = min(y0 + side, height), min(x0 + side, width)
        is_open = np.ones((side, side), np.bool_)
        light = picture[y0:y1, x0:x1]
        for y in range(y1 - y0):
            for x in range(x1 - x0):
                for channel in range(4):
                    light[y, x, channel] = 0
                light[y, x, 4] = 1
        pending = (y1 - y0) * (x1 - x0)
        for entry in range(tile_starts[tile], tile_starts[tile + 1]):
            splat = packed[lists[entry, 1]]
            pending -= blend(splat, (x0, x1), (y0, y1), centers, light, is_open)
            if pending == 0:
                break


@serial
def blend(
    splat: Array,
    columns: tuple[int, int],
    rows: tuple[int, int],
    centers: Array,
    light: Array,
    is_open: NDArray[np.bool_],
) -> int:
    """Blend one splat into a tile; give how many pixels it finished."""
    finished = 0
    one, least = centers.dtype.type(1), centers.dtype.type(MIN_TRANSMITTANCE)
    faintest, most = centers.dtype.type(MIN_ALPHA), centers.dtype.type(MAX_ALPHA)
    square, shear, rest, log_opacity = splat[2], splat[3], splat[4], splat[5]
    half = math.sqrt(max(0.0, (LOG_MIN_ALPHA - log_opacity) / rest))
    top, bottom = span(splat[1] - half, splat[1] + half, rows[0], rows[1])
    for y in range(top, bottom):
        down = centers[y] - splat[1]
        middle = splat[0] - shear * down
        exponent = log_opacity + rest * down * down
        half = math.sqrt(max(0.0, (LOG_MIN_ALPHA - exponent) / square))
        first, end = span(middle - half, middle + half, columns[0], columns[1])
        for x in range(first, end):
            if not is_open[y - rows[0], x - columns[0]]:
                continue
            along = centers[x] - middle
            alpha = min(most, math.exp(exponent + square * along * along))
            if alpha < faintest:
                continue
            pixel = light[y - rows[0], x - columns[0]]
            after = pixel[4] * (one - alpha)
            if after < least:
                is_open[y - rows[0], x - columns[0]] = False
                finished += 1
                continue
            weight = alpha * pixel[4]
            for channel in range(4):
                pixel[channel] += weight * splat[6 + channel]
            pixel[4] = after
    return finished
