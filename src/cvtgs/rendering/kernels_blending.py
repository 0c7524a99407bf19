"""Compiled loops that composite the splats of each tile, forward and backward.

Compositing visits the pixels that each splat reaches, splat by splat; its gradient also runs front
to back. Where surfaces are opaque, most splats are behind finished pixels, so a bit for each pixel
that is not finished lets them be skipped.
"""

import math

import numpy as np

from cvtgs.math.parameters import MIN_ALPHA
from cvtgs.rendering.compiled import Array, Ints, PixelBox, TileArrays, parallel, prange, serial
from cvtgs.rendering.kernels_tiles import box_of, columns_of, rows_of, span, tile_at
from cvtgs.rendering.projection import MAX_ALPHA, MIN_TRANSMITTANCE

WIDEST = 1e9  # half widths of splats beyond this, in pixels, count as this
BATCH = 64  # splats of a tile that are copied together; reads of scattered rows then overlap


@serial
def copy_splats(packed: Array, lists: Ints, first: int, end: int, batch: Array) -> None:
    """Copy the splats of some intersections of a tile to the start of ``batch``."""
    for entry in range(first, end):
        for number in range(packed.shape[1]):
            batch[entry - first, number] = packed[lists[entry, 1], number]


@serial
def reached_columns(splat: Array, room: float, box: PixelBox) -> int:
    """Return a bit for every column where the exponent is at most ``-room`` below the peak."""
    square = room / splat[2] + room * splat[3] * splat[3] / splat[4]
    half = 1.00001 * math.sqrt(square) if square < WIDEST**2 else WIDEST  # also if it is NaN
    first, end = span(splat[0] - half, splat[0] + half, box[0], box[1])
    if end <= first:
        return 0
    return int((np.int64(1) << (end - box[0])) - (np.int64(1) << (first - box[0])))


@parallel
def composite_all(
    packed: Array, tiles: TileArrays, centers: Array, image: Array, open_rows: Ints, weights: Array
) -> None:
    """Blend splats into ``image``: red, green, blue, depth, and the transmittance left.

    A bit of ``open_rows`` is 0 where the pixel is finished. Unless ``weights`` is empty, write the
    sum of ``alpha * T`` of every intersection of a splat and a tile, in splat order.
    """
    starts, lists, side = tiles
    height, width = image.shape[:2]
    for step in prange(len(starts) - 1):
        tile = tile_at(step, len(starts) - 1)
        box = box_of(tile, side, (width, height))
        state = (image[box[2] : box[3], box[0] : box[1]], open_rows[tile])
        blend_list(packed, lists[starts[tile] : starts[tile + 1]], box, centers, state, weights)


@serial
def blend_list(
    packed: Array,
    lists: Ints,
    box: PixelBox,
    centers: Array,
    state: tuple[Array, Ints],
    weights: Array,
) -> None:
    """Blend the splats of a tile until all of its pixels are finished."""
    batch = np.empty((BATCH, packed.shape[1]), packed.dtype)
    for start in range(0, len(lists), BATCH):
        end = min(start + BATCH, len(lists))
        copy_splats(packed, lists, start, end, batch)
        for entry in range(start, end):
            finished, total = blend(batch[entry - start], box, centers, state)
            if len(weights):
                weights[lists[entry, 0]] = total
            if finished and not state[1].any():
                return


@serial
def blend(
    splat: Array, box: PixelBox, centers: Array, state: tuple[Array, Ints]
) -> tuple[int, float]:
    """Blend a splat into a tile; return the number of pixels finished, and its summed weight."""
    (layers, open_rows), finished, total = state, 0, 0.0
    x0, y0 = box[0], box[2]
    one, least = centers.dtype.type(1), centers.dtype.type(MIN_TRANSMITTANCE)
    faintest, most = centers.dtype.type(MIN_ALPHA), centers.dtype.type(MAX_ALPHA)
    top, bottom, room = rows_of(splat, box)
    columns = reached_columns(splat, room, box)
    for y in range(top, bottom):
        is_open = open_rows[y - y0]
        if is_open & columns == 0:
            continue
        first, end, middle, exponent = columns_of(splat, box, centers[y] - splat[1])
        for x in range(first, end):
            if (is_open >> (x - x0)) & 1 == 0:
                continue
            along = centers[x] - middle
            alpha = min(most, math.exp(exponent + splat[2] * along * along))
            if alpha < faintest:
                continue
            pixel = layers[y - y0, x - x0]
            after = pixel[4] * (one - alpha)
            if after < least:
                open_rows[y - y0] &= ~(np.int64(1) << (x - x0))
                finished += 1
                continue
            weight = alpha * pixel[4]
            for channel in range(4):
                pixel[channel] += weight * splat[6 + channel]
            pixel[4] = after
            total += weight
    return finished, total


@parallel
def light_of_gradient(image: Array, grad: Array, behind: Array) -> None:
    """Write the gradient times the layers of each pixel."""
    for y in prange(image.shape[0]):
        for x in range(image.shape[1]):
            behind[y, x] = 0
            for channel in range(5):
                behind[y, x] += image[y, x, channel] * grad[y, x, channel]


@parallel
def composite_all_gradient(
    packed: Array,
    tiles: TileArrays,
    centers: Array,
    grad: Array,
    state: tuple[Array, Array, Ints],
    per_intersection: Array,
) -> None:
    """Write the gradient by the packed splat of every intersection, in splat order.

    ``state``: transmittance in front (0 where finished), gradient times light behind, open rows.
    """
    starts, lists, side = tiles
    transmittance, behind, open_rows = state
    height, width = grad.shape[:2]
    for step in prange(len(starts) - 1):
        tile = tile_at(step, len(starts) - 1)
        box = box_of(tile, side, (width, height))
        x0, x1, y0, y1 = box
        reaching, light = transmittance[y0:y1, x0:x1].copy(), behind[y0:y1, x0:x1].copy()
        blend_list_gradient(
            packed,
            lists[starts[tile] : starts[tile + 1]],
            (box, centers),
            grad[y0:y1, x0:x1],
            (reaching, light, open_rows[tile]),
            per_intersection,
        )
        transmittance[y0:y1, x0:x1] = reaching
        behind[y0:y1, x0:x1] = light


@serial
def blend_list_gradient(
    packed: Array,
    lists: Ints,
    pixels: tuple[PixelBox, Array],
    grad: Array,
    state: tuple[Array, Array, Ints],
    per_intersection: Array,
) -> None:
    """Write the gradients of the splats of a tile until all of its pixels are finished."""
    box, centers = pixels
    batch = np.empty((BATCH, packed.shape[1]), packed.dtype)
    for start in range(0, len(lists), BATCH):
        end = min(start + BATCH, len(lists))
        copy_splats(packed, lists, start, end, batch)
        for entry in range(start, end):
            out = per_intersection[lists[entry, 0]]
            finished = blend_gradient(batch[entry - start], box, centers, grad, state, out)
            if finished and not state[2].any():
                return


@serial
def blend_gradient(
    splat: Array,
    box: PixelBox,
    centers: Array,
    grad: Array,
    state: tuple[Array, Array, Ints],
    out: Array,
) -> int:
    """Write the gradient of one splat in a tile; return the number of pixels it finished.

    ``state`` is that of `composite_all_gradient` in this tile; ``out`` must be 0 on entry.
    """
    finished = 0
    transmittance, behind, open_rows = state
    x0, y0 = box[0], box[2]
    square, shear, rest = splat[2], splat[3], splat[4]
    top, bottom, room = rows_of(splat, box)
    columns = reached_columns(splat, room, box)
    for y in range(top, bottom):
        if open_rows[y - y0] & columns == 0:
            continue
        down = centers[y] - splat[1]
        first, end, middle, exponent = columns_of(splat, box, down)
        row = (
            transmittance[y - y0, first - x0 :],
            behind[y - y0, first - x0 :],
            grad[y - y0, first - x0 :],
        )
        done, zeroth, moment, second = blend_row_gradient(
            splat, exponent, centers[first:end] - middle, row, out
        )
        if done:
            finished += done
            for x in range(first, end):
                if transmittance[y - y0, x - x0] == 0:
                    open_rows[y - y0] &= ~(np.int64(1) << (x - x0))
        out[0] -= 2 * square * moment
        out[1] -= 2 * (square * shear * moment + rest * down * zeroth)
        out[2] += second
        out[3] += 2 * square * moment * down
        out[4] += zeroth * down * down
        out[5] += zeroth
    return finished


@serial
def blend_row_gradient(
    splat: Array, exponent: float, ways: Array, row: tuple[Array, Array, Array], out: Array
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
