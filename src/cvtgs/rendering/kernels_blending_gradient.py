"""The gradient of compositing, in compiled loops, front to back like compositing itself."""

import math

import numpy as np

from cvtgs.rendering.arrays import Array, Box, TileArrays
from cvtgs.rendering.compiled import parallel, prange, serial
from cvtgs.rendering.kernels_blending import LOG_MIN_ALPHA, box_of, span, tile_at
from cvtgs.rendering.rules import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE


@parallel
def composite_all_gradient(
    packed: Array,
    tiles: TileArrays,
    centers: Array,
    image: Array,
    grad: Array,
    per_place: Array,
) -> None:
    """Write the gradient with respect to the packed splat of every intersection."""
    starts, lists, side = tiles
    height, width = image.shape[:2]
    for step in prange(len(starts) - 1):
        tile = tile_at(step, len(starts) - 1)
        box = box_of(tile, side, (width, height))
        x0, x1, y0, y1 = box
        light = np.ones((side, side), image.dtype)
        behind = np.zeros((side, side), image.dtype)
        for y in range(y0, y1):
            for x in range(x0, x1):
                for channel in range(5):
                    behind[y - y0, x - x0] += image[y, x, channel] * grad[y, x, channel]
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
    everything that lies behind this splat. ``out`` is 0 before.
    """
    finished = 0
    light, behind = state
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
            light[y - y0, first - x0 :],
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
    """Add the gradients by colour and depth; give pixels finished, and the exponent's moments."""
    finished = 0
    one, zero = ways.dtype.type(1), ways.dtype.type(0)
    least, most = ways.dtype.type(MIN_TRANSMITTANCE), ways.dtype.type(MAX_ALPHA)
    faintest = ways.dtype.type(MIN_ALPHA)
    light, behind, grad = row
    zeroth, moment, second = zero, zero, zero
    for x in range(len(ways)):
        reaching = light[x]
        if reaching == zero:
            continue
        along = ways[x]
        alpha = min(most, math.exp(exponent + splat[2] * along * along))
        if alpha < faintest:
            continue
        after = reaching * (one - alpha)
        if after < least:
            light[x] = zero
            finished += 1
            continue
        light[x] = after
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
