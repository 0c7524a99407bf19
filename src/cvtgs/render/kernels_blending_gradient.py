"""The gradient of compositing, in compiled loops, front to back like compositing itself."""

import math

import numpy as np
from numpy.typing import NDArray

from cvtgs.render.compiled import parallel, prange, serial
from cvtgs.render.kernels_blending import LOG_MIN_ALPHA, span, tile_at
from cvtgs.render.rules import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

Array = NDArray[np.floating]
Ints = NDArray[np.integer]


@parallel
def composite_all_gradient(
    packed: Array,
    tile_starts: Ints,
    lists: Ints,
    side: int,
    centers: Array,
    picture: Array,
    grad: Array,
    per_place: Array,
) -> None:
    """Write the gradient with respect to the packed splat of every intersection."""
    height, width = picture.shape[:2]
    across = (width + side - 1) // side
    for step in prange(len(tile_starts) - 1):
        tile = tile_at(step, len(tile_starts) - 1)
        y0, x0 = tile // across * side, tile % across * side
        y1, x1 = min(y0 + side, height), min(x0 + side, width)
        light = np.ones((side, side), picture.dtype)
        behind = np.zeros((side, side), picture.dtype)
        for y in range(y0, y1):
            for x in range(x0, x1):
                for channel in range(5):
                    behind[y - y0, x - x0] += picture[y, x, channel] * grad[y, x, channel]
        pending = (y1 - y0) * (x1 - x0)
        for entry in range(tile_starts[tile], tile_starts[tile + 1]):
            pending -= blend_gradient(
                packed[lists[entry, 1]], (x0, x1), (y0, y1), centers,
                grad[y0:y1, x0:x1], light, behind, per_place[lists[entry, 0]],
            )  # fmt: skip
            if pending == 0:
                break


@serial
def blend_gradient(
    splat: Array,
    columns: tuple[int, int],
    rows: tuple[int, int],
    centers: Array,
    grad: Array,
    light: Array,
    behind: Array,
    out: Array,
) -> int:
    """Add the gradient of one splat in a tile to ``out``; give how many pixels it finished.

    ``light`` is what reaches each pixel, 0 where it is finished; ``behind`` is the gradient times
    everything that lies behind this splat.
    """
    finished = 0
    one, zero = centers.dtype.type(1), centers.dtype.type(0)
    least, most = centers.dtype.type(MIN_TRANSMITTANCE), centers.dtype.type(MAX_ALPHA)
    faintest = centers.dtype.type(MIN_ALPHA)
    square, shear, rest, log_opacity = splat[2], splat[3], splat[4], splat[5]
    red, green, blue, depth = splat[6], splat[7], splat[8], splat[9]
    g_x, g_y, g_square, g_shear, g_rest, g_log = zero, zero, zero, zero, zero, zero
    g_red, g_green, g_blue, g_depth = zero, zero, zero, zero
    two = one + one
    half = math.sqrt(max(0.0, (LOG_MIN_ALPHA - log_opacity) / rest))
    top, bottom = span(splat[1] - half, splat[1] + half, rows[0], rows[1])
    for y in range(top, bottom):
        down = centers[y] - splat[1]
        middle = splat[0] - shear * down
        exponent = log_opacity + rest * down * down
        half = math.sqrt(max(0.0, (LOG_MIN_ALPHA - exponent) / square))
        first, end = span(middle - half, middle + half, columns[0], columns[1])
        zeroth, moment, second = zero, zero, zero
        for x in range(first, end):
            reaching = light[y - rows[0], x - columns[0]]
            if reaching == zero:
                continue
            along = centers[x] - middle
            alpha = min(most, math.exp(exponent + square * along * along))
            if alpha < faintest:
                continue
            after = reaching * (one - alpha)
            if after < least:
                light[y - rows[0], x - columns[0]] = zero
                finished += 1
                continue
            light[y - rows[0], x - columns[0]] = after
            pixel = grad[y - rows[0], x - columns[0]]
            weight = alpha * reaching
            worth = red * pixel[0] + green * pixel[1] + blue * pixel[2] + depth * pixel[3]
            remaining = behind[y - rows[0], x - columns[0]] - weight * worth
            behind[y - rows[0], x - columns[0]] = remaining
            g_red += weight * pixel[0]
            g_green += weight * pixel[1]
            g_blue += weight * pixel[2]
            g_depth += weight * pixel[3]
            if alpha < most:
                g = alpha * (reaching * worth - remaining / (one - alpha))
                zeroth += g
                moment += g * along
                second += g * along * along
        g_x -= two * square * moment
        g_y -= two * (square * shear * moment + rest * down * zeroth)
        g_square += second
        g_shear += two * square * moment * down
        g_rest += zeroth * down * down
        g_log += zeroth
    out[0], out[1], out[2], out[3], out[4], out[5] = g_x, g_y, g_square, g_shear, g_rest, g_log
    out[6], out[7], out[8], out[9] = g_red, g_green, g_blue, g_depth
    return finished
