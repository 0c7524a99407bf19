"""The blending weights of one image, stored per tile and splat at 5 bytes each, compiled."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.math.parameters import MIN_ALPHA
from cvtgs.rendering.backends import check_colors, check_image
from cvtgs.rendering.compiled import (
    Array,
    Ints,
    PixelBox,
    SplatArrays,
    TileArrays,
    parallel,
    prange,
    serial,
)
from cvtgs.rendering.kernels_tiles import box_of, columns_of, rows_of, tile_at
from cvtgs.rendering.projection import MAX_ALPHA, MIN_TRANSMITTANCE


class WeightArrays(NamedTuple):
    """Weights ``alpha * T`` of the splats of each tile, in the order of the tiles' lists."""

    starts: Ints  # (p + 1,) start of each intersection's weights
    counts: Ints  # (p,) number of weights of each intersection
    pixels: NDArray[np.uint8]  # index of the weight's pixel within its tile
    values: NDArray[np.float32]


@parallel
def count_pixels(
    packed: Array, tiles: TileArrays, size: tuple[int, int], centers: Array, counts: Ints
) -> None:
    """Write an upper bound of the number of pixels that each intersection reaches."""
    starts, lists, side = tiles
    for step in prange(len(starts) - 1):
        tile = tile_at(step, len(starts) - 1)
        box = box_of(tile, side, size)
        for entry in range(starts[tile], starts[tile + 1]):
            splat = packed[lists[entry, 1]]
            top, bottom, _ = rows_of(splat, box)
            count = 0
            for y in range(top, bottom):
                first, end, _, _ = columns_of(splat, box, centers[y] - splat[1])
                count += max(0, end - first)
            counts[entry] = count


@parallel
def write_weights(
    packed: Array, tiles: TileArrays, size: tuple[int, int], centers: Array, weights: WeightArrays
) -> None:
    """Blend without colours; write the weight of every splat in every pixel."""
    starts, lists, side = tiles
    begins, counts, pixels, values = weights
    for step in prange(len(starts) - 1):
        tile = tile_at(step, len(starts) - 1)
        box = box_of(tile, side, size)
        through = np.ones(side * side, centers.dtype)
        pending = (box[1] - box[0]) * (box[3] - box[2])
        for entry in range(starts[tile], starts[tile + 1]):
            counts[entry] = 0
            if pending == 0:
                continue
            begin = begins[entry]
            counts[entry], finished = blend_weights(
                packed[lists[entry, 1]],
                box,
                centers,
                through,
                (pixels[begin:], values[begin:]),
                side,
            )
            pending -= finished


@serial
def blend_weights(
    splat: Array,
    box: PixelBox,
    centers: Array,
    through: Array,
    out: tuple[NDArray[np.uint8], NDArray[np.float32]],
    side: int,
) -> tuple[int, int]:
    """Blend one splat into a tile; return the number of weights and of pixels that it finished.

    ``through`` is the transmittance of each pixel, negative where the pixel is finished.
    """
    found, finished = 0, 0
    one, least = centers.dtype.type(1), centers.dtype.type(MIN_TRANSMITTANCE)
    faintest, most = centers.dtype.type(MIN_ALPHA), centers.dtype.type(MAX_ALPHA)
    pixels, values = out
    top, bottom, _ = rows_of(splat, box)
    for y in range(top, bottom):
        first, end, middle, exponent = columns_of(splat, box, centers[y] - splat[1])
        for x in range(first, end):
            pixel = (y - box[2]) * side + x - box[0]
            before = through[pixel]
            if before < 0:
                continue
            along = centers[x] - middle
            alpha = min(most, math.exp(exponent + splat[2] * along * along))
            if alpha < faintest:
                continue
            after = before * (one - alpha)
            if after < least:
                through[pixel] = -one
                finished += 1
                continue
            through[pixel] = after
            pixels[found] = pixel
            values[found] = alpha * before
            found += 1
    return found, finished


@parallel
def sum_powers(tiles: TileArrays, weights: WeightArrays, sums: Array) -> None:
    """Write the sums of weights and of squared weights of every intersection, in splat order."""
    starts, lists, _ = tiles
    for tile in prange(len(starts) - 1):
        for entry in range(starts[tile], starts[tile + 1]):
            begin, first, second = weights.starts[entry], 0.0, 0.0
            for k in range(begin, begin + weights.counts[entry]):
                value = weights.values[k]
                first += value
                second += value * value
            sums[lists[entry, 0], 0] = first
            sums[lists[entry, 0], 1] = second


@serial
def paint_tile(
    tiles: TileArrays, tile: int, weights: WeightArrays, colors: Array, canvas: Array
) -> None:
    """Add the weighted colours of a tile's splats to its canvas."""
    starts, lists, _ = tiles
    for entry in range(starts[tile], starts[tile + 1]):
        splat, begin = lists[entry, 1], weights.starts[entry]
        red, green, blue = colors[splat, 0], colors[splat, 1], colors[splat, 2]
        for k in range(begin, begin + weights.counts[entry]):
            pixel, value = weights.pixels[k], weights.values[k]
            canvas[pixel, 0] += value * red
            canvas[pixel, 1] += value * green
            canvas[pixel, 2] += value * blue


@serial
def collect_tile(
    tiles: TileArrays, tile: int, weights: WeightArrays, canvas: Array, sums: Array
) -> None:
    """Write each intersection's sum of weights times pixels of a tile, in splat order."""
    starts, lists, _ = tiles
    for entry in range(starts[tile], starts[tile + 1]):
        place, begin = lists[entry, 0], weights.starts[entry]
        red = green = blue = np.float32(0)
        for k in range(begin, begin + weights.counts[entry]):
            pixel, value = weights.pixels[k], weights.values[k]
            red += value * canvas[pixel, 0]
            green += value * canvas[pixel, 1]
            blue += value * canvas[pixel, 2]
        sums[place, 0], sums[place, 1], sums[place, 2] = red, green, blue


@parallel
def paint_all(tiles: TileArrays, weights: WeightArrays, colors: Array, image: Array) -> None:
    """Write the image for these colours of the splats."""
    side = tiles.side
    height, width = image.shape[:2]
    for tile in prange(len(tiles.starts) - 1):
        x0, x1, y0, y1 = box_of(tile, side, (width, height))
        canvas = np.zeros((side * side, 3), np.float32)
        paint_tile(tiles, tile, weights, colors, canvas)
        for y in range(y0, y1):
            for x in range(x0, x1):
                for channel in range(3):
                    image[y, x, channel] = canvas[(y - y0) * side + x - x0, channel]


@parallel
def collect_all(tiles: TileArrays, weights: WeightArrays, image: Array, sums: Array) -> None:
    """Write each intersection's sum of weights times pixels, in splat order."""
    side = tiles.side
    height, width = image.shape[:2]
    for tile in prange(len(tiles.starts) - 1):
        x0, x1, y0, y1 = box_of(tile, side, (width, height))
        canvas = np.zeros((side * side, 3), np.float32)
        for y in range(y0, y1):
            for x in range(x0, x1):
                for channel in range(3):
                    canvas[(y - y0) * side + x - x0, channel] = image[y, x, channel]
        collect_tile(tiles, tile, weights, canvas, sums)


@parallel
def normal_all(tiles: TileArrays, weights: WeightArrays, colors: Array, sums: Array) -> None:
    """Paint colours and collect the image tile by tile, in one pass."""
    for tile in prange(len(tiles.starts) - 1):
        canvas = np.zeros((tiles.side * tiles.side, 3), np.float32)
        paint_tile(tiles, tile, weights, colors, canvas)
        collect_tile(tiles, tile, weights, canvas, sums)


@parallel
def sum_places(starts: Ints, rows: Ints, per_place: Array, out: Array) -> None:
    """Sum over the intersections of each splat; write the sum to the row of its Gaussian."""
    for splat in prange(len(rows)):
        for column in range(per_place.shape[1]):
            total = 0.0
            for place in range(starts[splat], starts[splat + 1]):
                total += per_place[place, column]
            out[rows[splat], column] = total


class TileWeights:
    """The weights of one image: 5 bytes per splat and pixel reached, 20 per splat and tile."""

    def __init__(
        self, splats: SplatArrays, tiles: TileArrays, size: tuple[int, int], *, count: int
    ) -> None:
        packed = splats.packed
        self._rows, self._splat_starts, self._tiles = splats.rows, splats.starts, tiles
        self._size, self._count = size, count
        entries = len(tiles.lists)
        centers = (np.arange(max(size)) + 0.5).astype(packed.dtype)
        counts = np.zeros(entries, np.int64)
        count_pixels(packed, tiles, size, centers, counts)
        starts = np.zeros(entries + 1, np.int64)
        np.cumsum(counts, out=starts[1:])
        pixels, values = np.empty(starts[-1], np.uint8), np.empty(starts[-1], np.float32)
        self._weights = WeightArrays(starts, counts, pixels, values)
        write_weights(packed, tiles, size, centers, self._weights)

    def paint(self, colors: Float[Tensor, "n 3"]) -> Float[Tensor, "h w 3"]:
        """Return the image for these colours of the Gaussians."""
        image = np.empty((self._size[1], self._size[0], 3), np.float32)
        paint_all(self._tiles, self._weights, self._of_splats(colors), image)
        return torch.from_numpy(image).to(colors.dtype)

    def collect(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Return, for every Gaussian, the sum of the pixels times its weights."""
        check_image(image, self._size)
        sums = np.empty((len(self._tiles.lists), 3), np.float32)
        pixels = image.detach().contiguous().numpy().astype(np.float32, copy=False)
        collect_all(self._tiles, self._weights, pixels, sums)
        return self._of_gaussians(sums).to(image.dtype)

    def normal(self, colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return ``collect(paint(colors))``."""
        sums = np.empty((len(self._tiles.lists), 3), np.float32)
        normal_all(self._tiles, self._weights, self._of_splats(colors), sums)
        return self._of_gaussians(sums).to(colors.dtype)

    def powers(self) -> Float[Tensor, "n 2"]:
        """Return, for every Gaussian, the sum of its weights and of their squares."""
        sums = np.empty((len(self._tiles.lists), 2), np.float32)
        sum_powers(self._tiles, self._weights, sums)
        return self._of_gaussians(sums)

    def _of_splats(self, colors: Tensor) -> NDArray[np.float32]:
        check_colors(colors, self._count)
        return colors.detach().numpy()[self._rows].astype(np.float32, copy=False)

    def _of_gaussians(self, sums: NDArray[np.float32]) -> Tensor:
        out = np.zeros((self._count, sums.shape[1]), np.float32)
        sum_places(self._splat_starts, self._rows, sums, out)
        return torch.from_numpy(out)
