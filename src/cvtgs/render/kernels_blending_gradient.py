"""The gradient of compositing, in compiled loops, front to back like compositing itself."""

import math

import numpy as np

from cvtgs.render.arrays import Array, Box, TileArrays
from cvtgs.render.compiled import parallel, prange, serial
from cvtgs.render.kernels_blending import LOG_MIN_ALPHA, box_of, span, tile_at
from cvtgs.render.rules import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE


@parallel
def composite_all_gradient(
    packed: Array,
    tiles: TileArrays,
    centers: Array,
    picture: Array,
    grad: Array,
    per_place: Array,
) -> None:
    """Write the gradient with respect to the packed splat of every intersection."""
    starts, lists, side = tiles
    height, width = picture.shape[:2]
    for step in prange(len(starts) - 1):
        tile = tile_at(step, len(starts) - 1)
        box = box_of(tile, side, (width, height))
        x0, x1, y0, y1 = box
        light = np.ones((side, side), picture.dtype)
        behind = np.zeros((side, side), picture.dtype)
        for y in range(y0, y1):
            for x in range(x0, x1):
                for channel in range(5):
                    behind[y - y0, x - x0] += picture[y, x, channel] * grad[y, x, channel]
        pending = (y1 - y0) * (x1 - x0)
        state = (light, behind)
        for entry in range(starts[tile], starts[tile + 1]):
            splat, out = packed[lists[entry, 1]], per_place[lists[entry, 0]]
            pending -= blend_gradient(splat, box, centers, grad[y0:y1, x0:x1], state, out)
            if pending == 0:
                break


@serial
def blend_gradient(
    splat: Array,
    box: Box,
    centers: Array,
    grad: Array,
    state: tuple[Array, Array],
    out: Array,
) -> int:
    """Write the gradient of one splat in a tile; give how many pixels it finished.

    ``state`` is the light that reaches each pixel, 0 where it is finished, and the gradient times
    everything that lies behind this splat.
    """
    finished = 0
    light, behind = state
    x0, x1, y0, y1 = box
    one, zero = centers.dtype.type(1), centers.dtype.type(0)
    least, most = centers.dtype.type(MIN_TRANSMITTANCE), centers.dtype.type(MAX_ALPHA)
    faintest = centers.dtype.type(MIN_ALPHA)
    square, shear, rest, log_opacity = splat[2], splat[3], splat[4], splat[5]
    red, green, blue, depth = splat[6], splat[7], splat[8], splat[9]
    g_x, g_y, g_square, g_shear, g_rest, g_log = zero, zero, zero, zero, zero, zero
    g_red, g_green, g_blue, g_depth = zero, zero, zero, zero
    half = math.sqrt(max(0.0, (LOG_MIN_ALPHA - log_opacity) / rest))
    top, bottom = span(splat[1] - half, splat[1] + half, y0, y1)
    for y in range(top, bottom):
        down = centers[y] - splat[1]
        middle = splat[0] - shear * down
        exponent = log_opacity + rest * down * down
        half = math.sqrt(max(0.0, (LOG_MIN_ALPHA - exponent) / square))
        first, end = span(middle - half, middle + half, x0, x1)
        zeroth, moment, second = zero, zero, zero
        for x in range(first, end):
            reaching = light[y - y0, x - x0]
            if reaching == zero:
                continue
            along = centers[x] - middle
            alpha = min(most, math.exp(exponent + square * along * along))
            if alpha < faintest:
                continue
            after = reaching * (one - alpha)
            if after < least:
                light[y - y0, x - x0] = zero
                finished += 1
                continue
            light[y - y0, x - x0] = after
            pixel = grad[y - y0, x - x0]
            weight = alpha * reaching
            worth = red * pixel[0] + green * pixel[1] + blue * pixel[2] + depth * pixel[3]
            remaining = behind[y - y0, x - x0] - weight * worth
            behind[y - y0, x - x0] = remaining
            g_red += weight * pixel[0]
            g_green += weight * pixel[1]
            g_blue += weight * pixel[2]
            g_depth += weight * pixel[3]
            if alpha < most:
                g = alpha * (reaching * worth - remaining / (one - alpha))
                zeroth += g
                moment += g * along
                second += g * along * along
        g_x -= 2 * square * moment
        g_y -= 2 * (square * shear * moment + rest * down * zeroth)
        g_square += second
        g_shear += 2 * square * moment * down
        g_rest += zeroth * down * down
        g_log += zeroth
    out[0], out[1], out[2], out[3], out[4], out[5] = g_x, g_y, g_square, g_shear, g_rest, g_log
    out[6], out[7], out[8], out[9] = g_red, g_green, g_blue, g_depth
    return finished
