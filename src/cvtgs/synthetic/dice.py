"""Dice: the chances of a layout, such as places, sizes, colours and textures."""

import colorsys
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.synthetic import textures
from cvtgs.synthetic.textures import Color, Mask, Texture


@dataclass(frozen=True, slots=True, kw_only=True)
class Dice:
    """A generator with the draws that layouts need.

    Attributes:
        generator: Where the random numbers come from; every draw moves it on.
        tile: Noise that all cloudy textures share.
    """

    generator: torch.Generator
    tile: Float[Tensor, "k k"]

    @classmethod
    def of(cls, generator: torch.Generator) -> "Dice":
        """Make dice of a generator."""
        return cls(generator=generator, tile=textures.cloud_tile(generator))

    def between(self, low: float, high: float) -> float:
        """Draw a uniform number."""
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def order(self, count: int) -> list[int]:
        """Shuffle the numbers below ``count``."""
        return [int(k) for k in torch.randperm(count, generator=self.generator)]

    def hue(self, saturation: float, value: float) -> Color:
        """Draw a colour of any hue, with about this saturation and value."""
        return colorsys.hsv_to_rgb(
            self.between(0, 1),
            min(1.0, saturation * self.between(0.7, 1.3)),
            min(1.0, value * self.between(0.85, 1.15)),
        )

    def near(self, color: Color) -> Color:
        """Vary a colour a little."""
        shift = self.between(-0.06, 0.06)
        moved = [c + shift + self.between(-0.04, 0.04) for c in color]
        red, green, blue = (min(1.0, max(0.0, value)) for value in moved)
        return red, green, blue

    def clouds(self, low: Color, high: Color, size: float) -> Texture:
        """Mix two colours by noise that repeats after ``size``."""
        return textures.blend(textures.plain(low), textures.plain(high), self.noise(size, 0.25))

    def noise(self, size: float, contrast: float) -> Mask:
        """Make a mask of noise that repeats after ``size``."""
        shift = torch.rand(2, generator=self.generator)
        return textures.noise(self.tile, size=size, contrast=contrast, shift=shift)

    def stone(self, color: Color, size: float) -> Texture:
        """Make a spotted stone of about this colour."""
        red, green, blue = color
        return self.clouds((0.7 * red, 0.7 * green, 0.68 * blue), self.near(color), size)

    def pattern(self, size: float, which: int | None = None) -> Texture:
        """Make one of the textures, in random colours, with details of this size."""
        dark, bright = self.hue(0.6, 0.4), self.hue(0.35, 0.9)
        rough = self.stone(bright, 12 * size)
        step = torch.tensor([self.between(-1, 1), self.between(0.3, 1)]) / size
        choices = [
            textures.checker(textures.plain(dark), rough, size),
            textures.bricks(rough, textures.plain(dark), 0.7 * size),
            textures.stripes(textures.plain(dark), rough, step),
            textures.letters(textures.plain(bright), textures.plain(dark), 2 * size),
            self.clouds(dark, bright, 8 * size),
        ]
        drawn = self.order(len(choices))[0]
        return choices[(drawn if which is None else which) % len(choices)]

    def spots(self, count: int, ring: tuple[float, float]) -> list[tuple[float, float]]:
        """Spread places in a ring around the origin, no two in the same sector."""
        turn = self.between(0, 1)
        angles = [(k + turn + self.between(-0.18, 0.18)) / count for k in range(count)]
        polar = torch.tensor([(6.2831853 * angle, self.between(*ring)) for angle in angles])
        x, z = polar[:, 1] * polar[:, 0].cos(), polar[:, 1] * polar[:, 0].sin()
        return list(zip(x.tolist(), z.tolist(), strict=True))
