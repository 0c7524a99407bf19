"""From surfaces and textures to Gaussians shaped as training shapes them.

The shapes follow what trained scenes have in common: the longest axis about as long as the
spacing, the second a third of it, the third a twentieth; elongated along edges of the texture
and small where it is busy; a quarter nearly opaque, the rest of every opacity; larger ones hidden
behind the surface.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.scene import GaussianScene
from cvtgs.synthetic.chunks import Chunk, Draw, frames_of, gaussians
from cvtgs.synthetic.gloss import highlights, mirrored
from cvtgs.synthetic.surfaces import Surface, SurfacePoints
from cvtgs.synthetic.textures import Texture

_SUN = (0.52, -0.72, 0.46)
_SUN_COLOR = (1.0, 0.93, 0.8)
_SKY_COLOR = (0.55, 0.7, 1.0)
_BACKING_EVERY = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Finish:
    """How a surface is made of Gaussians.

    Attributes:
        overlap: Median length of the Gaussians, in spacings.
        faintness: How much fainter than usual; see :func:`opacities`.
        gloss: Brightness of the highlights.
        thickness: Deviation from the surface, in spacings.
        lit: Whether sun and sky light it; else it shines by itself.
    """

    overlap: float = 1.25
    faintness: float = 0.0
    gloss: float = 0.0
    thickness: float = 0.04
    lit: bool = True


def coated(surface: Surface, texture: Texture, finish: Finish) -> Draw:
    """Cover a surface with Gaussians."""

    def draw(chunk: Chunk) -> GaussianScene:
        at = surface(chunk.positions())
        spacing = (at.areas / chunk.total).sqrt()
        hidden = torch.arange(chunk.start, chunk.stop) % _BACKING_EVERY == _BACKING_EVERY - 1
        colors, frames, busy = _along_edges(at, texture, spacing, chunk)
        scales = _scales(spacing, busy, hidden, finish.overlap, chunk)
        depth = torch.where(hidden, 2.0 + chunk.uniforms(), finish.thickness * chunk.normals())
        average, rest = shine(at.normals, finish.gloss, chunk)
        cover = 1 / (1 + math.exp(finish.faintness - 3.0))
        shade = light(at.normals) if finish.lit else 1.0
        return gaussians(
            means=at.points - (depth * spacing)[:, None] * at.normals,
            frames=frames,
            scales=scales,
            opacities=torch.where(hidden, cover, opacities(chunk, finish.faintness)),
            colors=colors * shade + average + 0.02 * chunk.normals(3),
            rest=rest,
        )

    return draw


def opacities(chunk: Chunk, faintness: float) -> Float[Tensor, "n"]:
    """Draw opacities: some nearly opaque, the others anywhere."""
    opaque = chunk.uniforms() < 0.22 * math.exp(-0.5 * faintness)
    spread = 1.6 / (1 + 0.2 * faintness)
    others = spread * chunk.normals() - 0.1 - faintness
    return torch.sigmoid(torch.where(opaque, 4.5 + chunk.normals(), others))


def light(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return the light that falls on a surface: sun, and sky from above."""
    sun = (normals @ _toward_sun()).clamp_min(0.0)[:, None] * torch.tensor(_SUN_COLOR)
    sky = (0.5 - 0.5 * normals[:, 1:2]) * torch.tensor(_SKY_COLOR)
    return 0.24 + 0.72 * sun + 0.42 * sky


def shine(
    normals: Float[Tensor, "n 3"], gloss: float, chunk: Chunk
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n k 3"]]:
    """Mirror the sun and the sky, with the noise that trained coefficients have."""
    jitter = 0.015 + 0.02 * gloss
    rest = jitter * chunk.normals(chunk.rest_count, 3)
    if gloss == 0.0:
        return torch.zeros_like(normals), rest
    up = torch.tensor([0.0, -1.0, 0.0])
    sun = highlights(
        mirrored(_toward_sun(), normals),
        gloss * torch.tensor(_SUN_COLOR).expand_as(normals),
        chunk.rest_count,
    )
    sky = highlights(
        mirrored(up, normals),
        0.3 * gloss * torch.tensor(_SKY_COLOR).expand_as(normals),
        chunk.rest_count,
    )
    return sun[0] + sky[0], sun[1] + sky[1] + rest


def _toward_sun() -> Float[Tensor, "3"]:
    return torch.nn.functional.normalize(torch.tensor(_SUN), dim=0)


def _along_edges(
    at: SurfacePoints, texture: Texture, spacing: Float[Tensor, "n"], chunk: Chunk
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"], Float[Tensor, "n"]]:
    """Return colours, frames whose first axis follows edges, and how busy the texture is."""
    step = torch.eye(2)[:, None, :] * spacing[:, None]
    colors = texture(at.coords)
    slopes = torch.stack([texture(at.coords + step[k]) - colors for k in range(2)])
    steep = slopes.square().sum(2).sqrt() + 0.02 * chunk.uniforms(2).T
    steep = torch.where(spacing > at.rims.T, 1.0, steep)
    same_sign = (slopes[0] * slopes[1]).sum(1) >= 0
    across = torch.atan2(torch.where(same_sign, steep[1], -steep[1]), steep[0])
    angle = across + 0.5 * math.pi + 0.15 * chunk.normals()
    cos, sin = torch.cos(angle)[:, None], torch.sin(angle)[:, None]
    first = cos * at.tangents + sin * at.bitangents
    second = cos * at.bitangents - sin * at.tangents
    contrast = torch.linalg.vector_norm(steep, dim=0)
    return colors, frames_of(first, second), contrast / (contrast + 0.25)


def _scales(
    spacing: Float[Tensor, "n"],
    busy: Float[Tensor, "n"],
    hidden: Bool[Tensor, "n"],
    overlap: float,
    chunk: Chunk,
) -> Float[Tensor, "n 3"]:
    """Draw the lengths of the axes; the third is across the surface."""
    length = overlap * torch.exp(0.5 * chunk.normals() - 0.2 * busy)
    width = length * torch.exp(-(0.65 + 1.0 * busy) - 0.45 * chunk.normals().abs())
    depth = torch.minimum(chunk.lognormals(0.05, 1.0), 0.7 * width)
    seen = torch.stack([length, width, depth], dim=1)
    backing = torch.tensor([2.3, 1.7, 0.3]) * torch.exp(0.2 * chunk.normals(3))
    return spacing[:, None] * torch.where(hidden[:, None], backing, seen)
