"""Composite tiles in compiled loops, splat by splat over the pixels that it reaches."""

import math

import numpy as np
from numpy.typing import NDArray

from cvtgs.rendering.arrays import Array, Box, TileArrays
from cvtgs.rendering.compiled import parallel, prange, serial
from cvtgs.rendering.rules import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

SLACK = 1e-3
LOG_MIN_ALPHA = math.log(MIN_ALPHA)
STRIDE = 1009
"""Neighbouring tiles cost alike; strides by this prime give every thread some of each kind."""


@serial
def span(low: float, high: float, begin: int, end: int) -> tuple[int, int]:
    """Return the range of pixels from ``begin`` to ``end`` whose centres lie in an interval."""
    first = math.ceil(max(low - 0.5 - SLACK, float(begin)))
    last = math.floor(min(high - 0.5 + SLACK, end - 1.0))
    return int(first), int(last) + 1


@serial
def tile_at(step: int, count: int) -> int:
    """Return the tile of a step; all tiles come up once."""
    number = np.int64(step)  # numba's parallel loops count in uint64, which % turns into floats
    return int(number * STRIDE % count if count % STRIDE else number)


@serial
def box_of(tile: int, side: int, size: tuple[int, int]) -> Box:
    """Return the pixels of a tile."""
    across = (size[0] + side - 1) // side
    x, y = tile % across * side, tile // across * side
    return x, min(x + side, size[0]), y, min(y + side, size[1])


@parallel
def composite_all(
    packed: Array, tiles: TileArrays, centers: Array, image: Array, painted: Array
) -> None:
    """Write red, green, blue and depth, times what they hide, and transmittance of each pixel.

    Where ``painted`` is not empty, it gets the pixels that every intersection of a splat and a
    tile paints, by its place.
    """
    starts, lists, side = tiles
    height, width = image.shape[:2]
    for step in prange(len(starts) - 1):
        tile = tile_at(step, len(starts) - 1)
        box = box_of(tile, side, (width, height))
        x0, x1, y0, y1 = box
        is_open = np.ones((side, side), np.bool_)
        light = image[y0:y1, x0:x1]
        for y in range(y1 - y0):
            for x in range(x1 - x0):
                for channel in range(4):
                    light[y, x, channel] = 0
                light[y, x, 4] = 1
        pending = (y1 - y0) * (x1 - x0)
        for entry in range(starts[tile], starts[tile + 1]):
            splat = packed[lists[entry, 1]]
            finished, pixels = blend(splat, box, centers, light, is_open)
            pending -= finished
            if len(painted):
                painted[lists[entry, 0]] = pixels
            if pending == 0:
                break


@serial
def blend(
    splat: Array,
    box: Box,
    centers: Array,
    light: Array,
    is_open: NDArray[np.bool_],
) -> tuple[int, float]:
    """Blend one splat into a tile; give how many pixels it finished, and how many it painted."""
    finished, painted = 0, 0.0
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
            pixel = light[y - y0, x - x0]
            after = pixel[4] * (one - alpha)
            if after < least:
                is_open[y - y0, x - x0] = False
                finished += 1
                continue
            weight = alpha * pixel[4]
            for channel in range(4):
                pixel[channel] += weight * splat[6 + channel]
            pixel[4] = after
            painted += weight
    return finished, painted
