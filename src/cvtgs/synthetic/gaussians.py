"""Cover surfaces with Gaussians shaped like trained ones; make haze and floaters.

The shapes follow common properties of trained scenes. The longest axis is about as long as the
spacing, the second a third and the third a twentieth of it. Gaussians are elongated along texture
edges and small where the texture is detailed. A quarter is nearly opaque, the rest have any
opacity. Larger ones are hidden behind the surface.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cvtgs.math import parameters
from cvtgs.math.spherical_harmonics import SH_C0, degree_of, rest_basis
from cvtgs.scene import GaussianScene
from cvtgs.synthetic.surfaces import Surface, SurfacePoints
from cvtgs.synthetic.textures import Color, Texture

_OPACITY_RANGE = (0.006, 0.9995)
_PLASTIC_NUMBER = 1.32471795724474602596
_JITTER = 0.7
_SUN_COLOR = (1.0, 0.93, 0.8)
_SKY_COLOR = (0.55, 0.7, 1.0)
_BACKING_EVERY = 12
_HAZE_OPACITY = 0.022
_MANY_FLOATERS = 1000  # above this count floaters shrink, so that they hide no more of the scene
_BANDS = (1.0, 0.9, 0.72, 0.5)  # weight of each SH band of a highlight; falling, to avoid ringing


@dataclass(frozen=True, slots=True, kw_only=True)
class Chunk:
    """Rows ``start`` to ``stop`` of a part of a scene, and their random numbers."""

    start: int
    stop: int
    total: int  # Gaussians of the whole part, which sets their spacing
    rest_count: int  # view-dependent SH coefficients per channel
    shift: Float[Tensor, "2"]  # of the part's low-discrepancy sequence
    generator: torch.Generator

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.stop - self.start

    def uniforms(self, *shape: int) -> Tensor:
        """Draw uniform numbers in [0, 1), ``(rows, *shape)``."""
        return torch.rand(len(self), *shape, generator=self.generator)

    def normals(self, *shape: int) -> Tensor:
        """Draw standard normal numbers, ``(rows, *shape)``."""
        return torch.randn(len(self), *shape, generator=self.generator)

    def lognormals(self, median: float, spread: float) -> Float[Tensor, "n"]:
        """Draw log-normal numbers; ``spread`` is the standard deviation of their logarithms."""
        return median * torch.exp(spread * self.normals())

    def square_points(self) -> Float[Tensor, "n 2"]:
        """Return evenly spread, jittered points of the unit square (R2 sequence, Roberts 2018)."""
        rows = torch.arange(self.start, self.stop, dtype=torch.float64)
        steps = torch.tensor([1 / _PLASTIC_NUMBER, 1 / _PLASTIC_NUMBER**2], dtype=torch.float64)
        jitter = (self.uniforms(2) - 0.5) * (_JITTER / math.sqrt(self.total))
        # Rounding to float32 may give 1.0, which is outside.
        return ((rows[:, None] * steps + self.shift + jitter) % 1.0).float().clamp_max(1 - 1e-7)

    def directions(self) -> Float[Tensor, "n 3"]:
        """Draw unit vectors, uniform over the sphere."""
        return torch.nn.functional.normalize(self.normals(3), dim=1)

    def rotations(self) -> Float[Tensor, "n 3 3"]:
        """Draw rotation matrices."""
        return rotations_from_axes(self.directions(), self.directions())

    def opacities(self, faintness: float) -> Float[Tensor, "n"]:
        """Draw opacities: some nearly 1, the others of any value."""
        opaque = self.uniforms() < 0.22 * math.exp(-0.5 * faintness)
        spread = 1.6 / (1 + 0.2 * faintness)
        others = spread * self.normals() - 0.1 - faintness
        return torch.sigmoid(torch.where(opaque, 4.5 + self.normals(), others))


Draw = Callable[[Chunk], GaussianScene]  # function that makes the Gaussians of one chunk of a part


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """Parameters of the Gaussians that cover a surface."""

    overlap: float = 1.25  # median length of the Gaussians, in spacings
    faintness: float = 0.0  # lowers opacities; see :meth:`Chunk.opacities`
    specular: float = 0.0  # brightness of the highlights
    thickness: float = 0.04  # standard deviation of the distance from the surface, in spacings
    lit: bool = True  # by sun and sky; if not, the colours are those of the texture


def rotations_from_axes(
    first: Float[Tensor, "n 3"], second: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3 3"]:
    """Build rotations whose first column is ``first`` and whose second is near ``second``."""
    third = torch.nn.functional.normalize(torch.linalg.cross(first, second), dim=1)
    return torch.stack([first, torch.linalg.cross(third, first), third], dim=2)


def gaussians(
    *,
    means: Float[Tensor, "n 3"],
    rotations: Float[Tensor, "n 3 3"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    colors: Float[Tensor, "n 3"],
    rest: Float[Tensor, "n k 3"],
) -> GaussianScene:
    """Build a scene from activated values."""
    return GaussianScene(
        means=means,
        quats=parameters.matrices_to_quats(rotations),
        log_scales=parameters.positive_log(scales),
        logit_opacities=parameters.logit_from_opacity(opacities.clamp(*_OPACITY_RANGE)),
        sh0=((colors.clamp(0.0, 1.0) - 0.5) / SH_C0)[:, None, :],
        shN=rest,
    )


def cover_surface(surface: Surface, texture: Texture, material: Material) -> Draw:
    """Cover a surface with Gaussians."""

    def draw(chunk: Chunk) -> GaussianScene:
        at = surface(chunk.square_points())
        spacing = (at.areas / chunk.total).sqrt()
        hidden = torch.arange(chunk.start, chunk.stop) % _BACKING_EVERY == _BACKING_EVERY - 1
        colors, rotations, detail = _along_edges(at, texture, spacing, chunk)
        scales = _scales(spacing, detail, hidden, material.overlap, chunk)
        depth = torch.where(hidden, 2.0 + chunk.uniforms(), material.thickness * chunk.normals())
        average, rest = specular_colors(at.normals, material.specular, chunk)
        backing_opacity = 1 / (1 + math.exp(material.faintness - 3.0))
        shade = diffuse_light(at.normals) if material.lit else 1.0
        return gaussians(
            means=at.points - (depth * spacing)[:, None] * at.normals,
            rotations=rotations,
            scales=scales,
            opacities=torch.where(hidden, backing_opacity, chunk.opacities(material.faintness)),
            colors=colors * shade + average + 0.02 * chunk.normals(3),
            rest=rest,
        )

    return draw


def _along_edges(
    at: SurfacePoints, texture: Texture, spacing: Float[Tensor, "n"], chunk: Chunk
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"], Float[Tensor, "n"]]:
    """Return colours, rotations whose first axis follows edges, and the detail of the texture."""
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
    return colors, rotations_from_axes(first, second), contrast / (contrast + 0.25)


def _scales(
    spacing: Float[Tensor, "n"],
    detail: Float[Tensor, "n"],
    hidden: Bool[Tensor, "n"],
    overlap: float,
    chunk: Chunk,
) -> Float[Tensor, "n 3"]:
    """Draw the lengths of the axes; the third is across the surface."""
    length = overlap * torch.exp(0.5 * chunk.normals() - 0.2 * detail)
    width = length * torch.exp(-(0.65 + 1.0 * detail) - 0.45 * chunk.normals().abs())
    depth = torch.minimum(chunk.lognormals(0.05, 1.0), 0.7 * width)
    visible = torch.stack([length, width, depth], dim=1)
    backing = torch.tensor([2.3, 1.7, 0.3]) * torch.exp(0.2 * chunk.normals(3))
    return spacing[:, None] * torch.where(hidden[:, None], backing, visible)


def diffuse_light(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return the irradiance of a surface from the sun, and from the sky above."""
    sun = (normals @ _toward_sun()).clamp_min(0.0)[:, None] * torch.tensor(_SUN_COLOR)
    sky = (0.5 - 0.5 * normals[:, 1:2]) * torch.tensor(_SKY_COLOR)
    return 0.24 + 0.72 * sun + 0.42 * sky


def specular_colors(
    normals: Float[Tensor, "n 3"], strength: float, chunk: Chunk
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n k 3"]]:
    """Return the mean colour and the noisy SH coefficients of reflections of sun and sky."""
    rest = (0.015 + 0.02 * strength) * chunk.normals(chunk.rest_count, 3)
    if strength == 0.0:
        return torch.zeros_like(normals), rest
    (sun, sun_rest), (sky, sky_rest) = (
        highlights(
            reflected(toward_light, normals),
            brightness * torch.tensor(color).expand_as(normals),
            chunk.rest_count,
        )
        for toward_light, brightness, color in (
            (_toward_sun(), strength, _SUN_COLOR),
            (torch.tensor([0.0, -1.0, 0.0]), 0.3 * strength, _SKY_COLOR),
        )
    )
    return sun + sky, sun_rest + sky_rest + rest


def highlights(
    directions: Float[Tensor, "n 3"], peaks: Float[Tensor, "n 3"], rest_count: int
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n k 3"]]:
    """Project round highlights, of given colours at their peaks, onto spherical harmonics.

    A lobe around direction ``d`` has coefficients ``w_l Y_lm(d)`` (Funk-Hecke theorem).
    """
    degree = degree_of(rest_count)
    if degree == 0:
        return 0.15 * peaks, torch.zeros(len(directions), 0, 3)
    weights = [_BANDS[band] for band in range(degree + 1) for _ in range(2 * band + 1)]
    peak = sum(weights) / (4 * math.pi)
    rest = rest_basis(directions, degree) * (torch.tensor(weights[1:]) / peak)
    return peaks / (4 * math.pi * peak), rest[:, :, None] * peaks[:, None, :]


def reflected(
    toward_light: Float[Tensor, "3"], normals: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Return the viewing directions in which a surface reflects a light."""
    return toward_light - 2 * (normals @ toward_light)[:, None] * normals


def _toward_sun() -> Float[Tensor, "3"]:
    return torch.nn.functional.normalize(torch.tensor([0.52, -0.72, 0.46]), dim=0)


def haze(
    center: Float[Tensor, "3"], extent: Float[Tensor, "3"], depth: float, color: Color
) -> Draw:
    """Fill a soft ellipsoid with faint Gaussians, as dense at every count."""
    rgb = torch.tensor(color, dtype=torch.float32)
    shadow = 2 * math.pi * float(extent.prod()) ** (2 / 3)

    def draw(chunk: Chunk) -> GaussianScene:
        size = math.sqrt(depth * shadow / (2 * math.pi * chunk.total * _HAZE_OPACITY))
        size = min(size, 0.5 * float(extent.min()))
        scales = size * torch.exp(0.5 * chunk.normals(3) - 0.25)
        return gaussians(
            means=center + extent * chunk.normals(3),
            rotations=chunk.rotations(),
            scales=scales,
            opacities=chunk.lognormals(_HAZE_OPACITY, 0.5).clamp_max(0.09),
            colors=rgb + 0.04 * chunk.normals(1) + 0.02 * chunk.normals(3),
            rest=0.03 * chunk.normals(chunk.rest_count, 3),
        )

    return draw


def floaters(center: Float[Tensor, "3"], radius: float) -> Draw:
    """Scatter stray Gaussians of any size and colour, most of them faint."""

    def draw(chunk: Chunk) -> GaussianScene:
        distance = radius * (0.4 + 2.6 * chunk.uniforms().square())
        offset = distance[:, None] * chunk.directions() * torch.tensor([1.0, 0.35, 1.0])
        lift = torch.tensor([0.0, -0.3 * radius, 0.0])
        size = 0.012 * radius * math.sqrt(min(1.0, _MANY_FLOATERS / chunk.total))
        longest = chunk.lognormals(size, 0.8)
        widths, depths = 0.2 + 0.7 * chunk.uniforms(), 0.02 + 0.4 * chunk.uniforms()
        shape = torch.stack([torch.ones(len(chunk)), widths, depths], dim=1)
        return gaussians(
            means=center + lift + offset,
            rotations=chunk.rotations(),
            scales=longest[:, None] * shape,
            opacities=0.02 + 0.5 * chunk.uniforms() ** 3,
            colors=0.55 + 0.15 * chunk.normals(1) + 0.05 * chunk.normals(3),
            rest=0.05 * chunk.normals(chunk.rest_count, 3),
        )

    return draw
