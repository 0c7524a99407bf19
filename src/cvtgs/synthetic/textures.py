"""Textures, which map texture coordinates to colours, and a source of random textures."""

import colorsys
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.synthetic.surfaces import FACE_STEP

Color = tuple[float, float, float]  # red, green, blue in [0, 1]
# Function from texture coordinates to colours
Texture = Callable[[Float[Tensor, "n 2"]], Float[Tensor, "n 3"]]
# Function from texture coordinates to numbers in [0, 1]
Mask = Callable[[Float[Tensor, "n 2"]], Float[Tensor, "n"]]
_NOISE_TEXELS = 512
_FONT = {
    "C": "01110 10001 10000 10000 10000 10001 01110",
    "V": "10001 10001 10001 10001 01010 01010 00100",
    "T": "11111 00100 00100 00100 00100 00100 00100",
    "G": "01110 10001 10000 10111 10001 10001 01110",
    "S": "01111 10000 10000 01110 00001 00001 11110",
}


def plain(color: Color) -> Texture:
    """Return one colour everywhere."""
    rgb = torch.tensor(color, dtype=torch.float32)
    return lambda coords: rgb.expand(len(coords), 3)


def blend(low: Texture, high: Texture, mask: Mask) -> Texture:
    """Interpolate from ``low`` where the mask is 0 to ``high`` where it is 1."""
    return lambda coords: torch.lerp(low(coords), high(coords), mask(coords)[:, None])


def checker(low: Texture, high: Texture, size: float) -> Texture:
    """Alternate two textures in squares of this size."""
    return blend(low, high, lambda coords: torch.floor(coords / size).sum(1).remainder(2))


def stripes(low: Texture, high: Texture, frequency: Float[Tensor, "2"]) -> Texture:
    """Alternate two textures in stripes; ``frequency`` is in stripes per unit along each axis."""
    return blend(low, high, lambda coords: ((coords @ frequency).remainder(1.0) > 0.5).float())


def bricks(brick: Texture, mortar: Texture, size: float) -> Texture:
    """Lay bricks of this height and 2.4 times that length, each with its own brightness."""

    def colors(coords: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        row = torch.floor(coords[:, 1] / size)
        along = coords[:, 0] / (2.4 * size) + 0.5 * row.remainder(2)
        column = torch.floor(along)
        joint = ((along - column) < 0.04) | ((coords[:, 1] / size - row) < 0.1)
        # A hash of the brick, in integers, so that it is the same on every processor.
        mixed = row.long() * 7919 + column.long() * 104_729 + 31_337
        hashed = (mixed * mixed).remainder(65_521) / 65_521
        return torch.where(
            joint[:, None], mortar(coords), brick(coords) * (0.75 + 0.5 * hashed)[:, None]
        )

    return colors


def letters(paper: Texture, ink: Texture, size: float) -> Texture:
    """Print CVTGS repeatedly; ``size`` is the width of one letter."""
    rows = [[[float(bit) for bit in line] for line in _FONT[c].split()] for c in "CVTGS"]
    glyphs = torch.nn.functional.pad(torch.tensor(rows), (1, 0, 2, 0))  # (5, 9, 6)

    def inked(coords: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        texel = torch.floor(coords * (6.0 / size)).long()
        column = texel[:, 0].remainder(30)
        return glyphs[column // 6, texel[:, 1].remainder(9), column.remainder(6)]

    return blend(paper, ink, inked)


def color_per_box(colors: Float[Tensor, "k 3"]) -> Texture:
    """Return one colour for each box of :func:`surfaces.boxes`."""

    def lookup(coords: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        face = torch.floor(coords[:, 0] / FACE_STEP).long()
        return colors[(face // 6).clamp(0, len(colors) - 1)]

    return lookup


def round_shadows(lit: Texture, centers: Float[Tensor, "k 2"], radius: float) -> Texture:
    """Darken a texture softly around the given points."""

    def colors(coords: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        distance = torch.cdist(coords, centers).amin(1)
        shade = torch.sigmoid((radius - distance) / (0.15 * radius))
        return lit(coords) * (1 - 0.55 * shade[:, None])

    return colors


def noise_tile(generator: torch.Generator) -> Float[Tensor, "k k"]:
    """Draw periodic noise whose amplitudes fall with the frequency to the power 1.5."""
    n = _NOISE_TEXELS
    wave = torch.fft.fftfreq(n) * n
    fall = (wave[:, None] ** 2 + wave[None, :] ** 2).sqrt().clamp_min(1.0) ** 1.5
    spectrum = torch.fft.fft2(torch.randn(n, n, generator=generator)) / fall
    tile: Tensor = torch.fft.ifft2(spectrum).real
    return (tile - tile.mean()) / tile.std()


@dataclass(frozen=True, slots=True, kw_only=True)
class Random:
    """Random numbers, colours and textures of a layout; every method draws."""

    generator: torch.Generator
    tile: Float[Tensor, "k k"]  # periodic noise that all noisy textures share

    def uniform(self, low: float, high: float) -> float:
        """Draw a uniform number."""
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def permutation(self, count: int) -> list[int]:
        """Return a random permutation of 0 to ``count - 1``."""
        return [int(k) for k in torch.randperm(count, generator=self.generator)]

    def ring_positions(self, count: int, ring: tuple[float, float]) -> list[tuple[float, float]]:
        """Draw positions in a ring around the origin, one in each of ``count`` sectors."""
        turn = self.uniform(0, 1)
        angles = [(k + turn + self.uniform(-0.18, 0.18)) / count for k in range(count)]
        polar = torch.tensor([(6.2831853 * angle, self.uniform(*ring)) for angle in angles])
        x, z = polar[:, 1] * polar[:, 0].cos(), polar[:, 1] * polar[:, 0].sin()
        return list(zip(x.tolist(), z.tolist(), strict=True))

    def color(self, saturation: float, value: float) -> Color:
        """Draw a colour of any hue, with about this saturation and value."""
        return colorsys.hsv_to_rgb(
            self.uniform(0, 1),
            min(1.0, saturation * self.uniform(0.7, 1.3)),
            min(1.0, value * self.uniform(0.85, 1.15)),
        )

    def similar(self, color: Color) -> Color:
        """Draw a colour close to another one."""
        shift = self.uniform(-0.06, 0.06)
        moved = [c + shift + self.uniform(-0.04, 0.04) for c in color]
        red, green, blue = (min(1.0, max(0.0, value)) for value in moved)
        return red, green, blue

    def noise(self, size: float, contrast: float) -> Mask:
        """Make a noise mask with period ``size``."""
        shift = torch.rand(2, generator=self.generator)
        n = len(self.tile)
        table = (0.5 + contrast * self.tile).clamp(0.0, 1.0).reshape(-1).contiguous()

        def mask(coords: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
            texel = (coords / size + shift) * n
            low = torch.floor(texel)
            share = texel - low
            x, y = low.long().remainder(n).unbind(1)
            right, below = (x + 1).remainder(n), (y + 1).remainder(n) * n
            top = torch.lerp(table[y * n + x], table[y * n + right], share[:, 0])
            bottom = torch.lerp(table[below + x], table[below + right], share[:, 0])
            return torch.lerp(top, bottom, share[:, 1])

        return mask

    def clouds(self, low: Color, high: Color, size: float) -> Texture:
        """Mix two colours by noise with period ``size``."""
        return blend(plain(low), plain(high), self.noise(size, 0.25))

    def stone(self, color: Color, size: float) -> Texture:
        """Make a texture of spotted stone of about this colour."""
        red, green, blue = color
        return self.clouds((0.7 * red, 0.7 * green, 0.68 * blue), self.similar(color), size)

    def pattern(self, size: float, which: int | None = None) -> Texture:
        """Make one of five textures, in random colours, with details of this size."""
        dark, bright = self.color(0.6, 0.4), self.color(0.35, 0.9)
        rough = self.stone(bright, 12 * size)
        frequency = torch.tensor([self.uniform(-1, 1), self.uniform(0.3, 1)]) / size
        choices = [
            checker(plain(dark), rough, size),
            bricks(rough, plain(dark), 0.7 * size),
            stripes(plain(dark), rough, frequency),
            letters(plain(bright), plain(dark), 2 * size),
            self.clouds(dark, bright, 8 * size),
        ]
        drawn = self.permutation(len(choices))[0]
        return choices[(drawn if which is None else which) % len(choices)]

    def poster(self, size: float) -> Texture:
        """Print letters or stripes of this size."""
        paper, ink = plain(self.color(0.1, 0.95)), plain(self.color(0.8, 0.45))
        if self.uniform(0, 1) < 0.6:
            return letters(paper, ink, size)
        return stripes(paper, ink, torch.tensor([0.7, 0.7]) / size)

    def masonry(self) -> Texture:
        """Lay bricks in random colours."""
        stone = self.stone(self.similar((0.66, 0.42, 0.33)), 1.3)
        return bricks(stone, plain(self.similar((0.72, 0.7, 0.66))), self.uniform(0.2, 0.28))

    def paving(self) -> Texture:
        """Lay slabs or tiles of stone."""
        stone = self.stone(self.similar((0.7, 0.66, 0.58)), 2.0)
        if self.uniform(0, 1) < 0.6:
            return bricks(stone, plain((0.3, 0.28, 0.25)), self.uniform(0.4, 0.55))
        dark = self.stone(self.similar((0.45, 0.36, 0.32)), 2.0)
        return checker(stone, dark, self.uniform(0.5, 0.8))

    def meadow(self) -> Texture:
        """Mix greens and browns."""
        dark, bright = self.similar((0.2, 0.3, 0.1)), self.similar((0.45, 0.5, 0.22))
        green = self.clouds(dark, bright, 5.0)
        return blend(green, plain(self.similar((0.45, 0.38, 0.24))), self.noise(17.0, 0.3))
