"""Textures: the colour of a surface at its texture coordinates."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.synthetic.surfaces import FACE_STEP

Color = tuple[float, float, float]
"""Red, green, blue in [0, 1]."""

Texture = Callable[[Float[Tensor, "n 2"]], Float[Tensor, "n 3"]]
"""Gives the colours at texture coordinates."""

Mask = Callable[[Float[Tensor, "n 2"]], Float[Tensor, "n"]]
"""Gives numbers in [0, 1] at texture coordinates."""

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
    """Show ``low`` where the mask is 0, ``high`` where it is 1, and mix in between."""
    return lambda coords: torch.lerp(low(coords), high(coords), mask(coords)[:, None])


def checker(low: Texture, high: Texture, size: float) -> Texture:
    """Alternate two textures in squares of this size."""
    return blend(low, high, lambda coords: torch.floor(coords / size).sum(1).remainder(2))


def stripes(low: Texture, high: Texture, step: Float[Tensor, "2"]) -> Texture:
    """Alternate two textures in stripes; ``step`` is the wave vector, waves per unit."""
    return blend(low, high, lambda coords: ((coords @ step).remainder(1.0) > 0.5).float())


def bricks(brick: Texture, mortar: Texture, size: float) -> Texture:
    """Lay bricks of this height and 2.4 times that length, each of its own brightness."""

    def colors(coords: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        row = torch.floor(coords[:, 1] / size)
        along = coords[:, 0] / (2.4 * size) + 0.5 * row.remainder(2)
        column = torch.floor(along)
        joint = ((along - column) < 0.04) | ((coords[:, 1] / size - row) < 0.1)
        shade = 0.75 + 0.5 * scatter(torch.stack([row, column], dim=1))
        return torch.where(joint[:, None], mortar(coords), brick(coords) * shade[:, None])

    return colors


def letters(paper: Texture, ink: Texture, size: float) -> Texture:
    """Write CVTGS again and again; ``size`` is the width of one letter."""
    rows = [[[float(bit) for bit in line] for line in _FONT[c].split()] for c in "CVTGS"]
    glyphs = torch.nn.functional.pad(torch.tensor(rows), (1, 0, 2, 0))  # (5, 9, 6)

    def inked(coords: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        texel = torch.floor(coords * (6.0 / size)).long()
        column = texel[:, 0].remainder(30)
        return glyphs[column // 6, texel[:, 1].remainder(9), column.remainder(6)]

    return blend(paper, ink, inked)


def patches(colors: Float[Tensor, "k 3"]) -> Texture:
    """Return every box of :func:`surfaces.boxes` its own colour."""

    def lookup(coords: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        face = torch.floor(coords[:, 0] / FACE_STEP).long()
        return colors[(face // 6).clamp(0, len(colors) - 1)]

    return lookup


def cloud_tile(generator: torch.Generator) -> Float[Tensor, "k k"]:
    """Make cloudy noise that repeats, by its spectrum.

    Amplitudes fall as the power 1.5 of the frequency, as in clouds and stone.
    """
    n = _NOISE_TEXELS
    wave = torch.fft.fftfreq(n) * n
    fall = (wave[:, None] ** 2 + wave[None, :] ** 2).sqrt().clamp_min(1.0) ** 1.5
    spectrum = torch.fft.fft2(torch.randn(n, n, generator=generator)) / fall
    tile: Tensor = torch.fft.ifft2(spectrum).real
    return (tile - tile.mean()) / tile.std()


def noise(
    tile: Float[Tensor, "k k"], *, size: float, contrast: float, shift: Float[Tensor, "2"]
) -> Mask:
    """Make a mask of cloudy noise that repeats after ``size``."""
    n = len(tile)
    table = (0.5 + contrast * tile).clamp(0.0, 1.0).reshape(-1).contiguous()

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


def shadows(lit: Texture, centers: Float[Tensor, "k 2"], radius: float) -> Texture:
    """Darken a texture around some points, softly."""

    def colors(coords: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        distance = torch.cdist(coords, centers).amin(1)
        shade = torch.sigmoid((radius - distance) / (0.15 * radius))
        return lit(coords) * (1 - 0.55 * shade[:, None])

    return colors


def scatter(cells: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
    """Return a number in [0, 1) to each integer cell that looks random."""
    mixed = cells @ torch.tensor([12.9898, 78.233])
    return (torch.sin(mixed.remainder(2 * math.pi)) * 4375.85).remainder(1.0)
