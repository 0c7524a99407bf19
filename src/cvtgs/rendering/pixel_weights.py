"""The blending weights of one image as a sparse matrix of torch tensors."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.math import segments


class PixelWeights:
    """The blending weights of one image; see :class:`cvtgs.rendering.BlendingWeights`.

    Memory: 40 bytes per pair of splat and reached pixel, and as much again for a product.
    """

    def __init__(
        self,
        pixels: Int[Tensor, "k"],
        rows: Int[Tensor, "k"],
        weights: Float[Tensor, "k"],
        *,
        size: tuple[int, int],
        count: int,
    ) -> None:
        self._size = size
        by_pixel, self._pixel_starts = segments.sort_by_label(pixels, size[0] * size[1])
        self._row_of, self._weight_of = rows[by_pixel], weights[by_pixel]
        by_row, self._row_starts = segments.sort_by_label(rows, count)
        self._pixels, self._weights = pixels[by_row], weights[by_row]

    def paint(self, colors: Float[Tensor, "n 3"]) -> Float[Tensor, "h w 3"]:
        """Return the image for these colours of the Gaussians."""
        image = segments.segment_sum_of(colors, self._row_of, self._pixel_starts, self._weight_of)
        return image.reshape(self._size[1], self._size[0], 3)

    def collect(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "n 3"]:
        """Return, for every Gaussian, the sum of the pixels times its weights."""
        flat = image.reshape(-1, 3)
        return segments.segment_sum_of(flat, self._pixels, self._row_starts, self._weights)

    def normal(self, colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return ``collect(paint(colors))``."""
        return self.collect(self.paint(colors))

    def powers(self) -> Float[Tensor, "n 2"]:
        """Return, for every Gaussian, the sum of its weights and of their squares."""
        both = torch.stack([self._weights, self._weights.square()], dim=1)
        return segments.segment_sum(both, self._row_starts)
