"""Thin structures: rails, wires, branches, blades of grass and leaves."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.scene import GaussianScene
from cvtgs.synthetic.gaussians import (
    Chunk,
    Draw,
    diffuse_light,
    gaussians,
    rotations_from_axes,
    specular_colors,
)
from cvtgs.synthetic.textures import Texture

_MANY_BLADES = 12_000  # above this count blades are slimmer, so that the ground still shows


@dataclass(frozen=True, slots=True, kw_only=True)
class Strands:
    """Straight pieces of round rods: their ends and radii."""

    starts: Float[Tensor, "k 3"]
    ends: Float[Tensor, "k 3"]
    radii: Float[Tensor, "k"]


def joined(*strands: Strands) -> Strands:
    """Concatenate sets of strands."""
    return Strands(
        starts=torch.cat([s.starts for s in strands]),
        ends=torch.cat([s.ends for s in strands]),
        radii=torch.cat([s.radii for s in strands]),
    )


def railing(start: Float[Tensor, "3"], along: Float[Tensor, "3"], height: float) -> Strands:
    """Build posts every 0.15 units, and three rails along them."""
    up = torch.tensor([0.0, -height, 0.0])
    count = max(2, round(float(along.norm()) / 0.15))
    feet = start + torch.linspace(0, 1, count)[:, None] * along
    rails = torch.stack([start + up, start + 0.55 * up, start + 0.12 * up])
    strong = torch.arange(count) % 8 == 0
    return joined(
        Strands(starts=feet, ends=feet + up, radii=torch.where(strong, 0.022, 0.008)),
        Strands(starts=rails, ends=rails + along, radii=torch.tensor([0.022, 0.007, 0.014])),
    )


def wire(start: Float[Tensor, "3"], end: Float[Tensor, "3"], sag: float) -> Strands:
    """Build a wire between two points; it sags by ``sag`` units in the middle."""
    share = torch.linspace(0, 1, 33)[:, None]
    points = torch.lerp(start.expand(33, 3), end.expand(33, 3), share)
    points = points + 4 * sag * share * (1 - share) * torch.tensor([0.0, 1.0, 0.0])
    return Strands(starts=points[:-1], ends=points[1:], radii=torch.full((32,), 0.006))


def tree(
    foot: Float[Tensor, "3"], height: float, generator: torch.Generator
) -> tuple[Strands, Float[Tensor, "k 3"]]:
    """Grow a trunk and four levels of branches, four on each parent; return them and the tips."""
    starts, directions = foot[None, :], torch.tensor([[0.0, -1.0, 0.0]])
    length, radius = 0.38 * height, 0.028 * height
    levels = []
    for _ in range(5):
        bend = starts + 0.5 * length * directions
        wobble = 0.12 * length * torch.randn(bend.shape, generator=generator)
        middle, ends = bend + 0.4 * wobble, starts + length * directions + wobble
        levels += [
            Strands(starts=starts, ends=middle, radii=torch.full((len(starts),), radius)),
            Strands(starts=middle, ends=ends, radii=torch.full((len(starts),), 0.75 * radius)),
        ]
        starts = ends.repeat_interleave(4, dim=0)
        spread = torch.randn(starts.shape, generator=generator)
        directions = directions.repeat_interleave(4, dim=0) + 0.75 * spread
        directions = torch.nn.functional.normalize(directions + torch.tensor([0, -0.25, 0]), dim=1)
        length, radius = 0.62 * length, 0.52 * radius
    return joined(*levels), levels[-1].ends


def rods(strands: Strands, texture: Texture, specular: float) -> Draw:
    """Cover strands with Gaussians: needles where a strand is thinner than the spacing."""
    axes = strands.ends - strands.starts
    lengths = torch.linalg.vector_norm(axes, dim=1).clamp_min(1e-6)
    axes = axes / lengths[:, None]
    weights = lengths * strands.radii.sqrt()  # thin pieces get more than in proportion to area
    ends = (weights / weights.sum()).double().cumsum(0)

    def draw(chunk: Chunk) -> GaussianScene:
        square = chunk.square_points()
        target = square[:, 0].double()
        piece = torch.searchsorted(ends, target, right=True).clamp_max(len(ends) - 1)
        share = (1.0 - (ends[piece] - target) * weights.sum() / weights[piece]).float()
        share = share.clamp(0.02, 0.98)
        radius, length, axis = strands.radii[piece], lengths[piece], axes[piece]
        side = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])[(axis[:, 0].abs() > 0.7).long()]
        local = rotations_from_axes(axis, side)
        angle = 2 * math.pi * square[:, 1:]
        outward = torch.cos(angle) * local[:, :, 1] + torch.sin(angle) * local[:, :, 2]
        step = length * weights.sum() / (weights[piece] * chunk.total)
        spacing = (2 * math.pi * radius * step).sqrt()
        around = torch.minimum(0.5 * spacing, 0.55 * radius)
        along = torch.where(around < 0.5 * spacing, 1.5 * step, 1.4 * spacing)
        along = torch.minimum(along * chunk.lognormals(1.0, 0.35), 0.45 * length)
        thin = torch.minimum(0.6 * around, chunk.lognormals(0.3, 0.5) * around)
        along_coords = share * length + piece
        average, rest = specular_colors(outward, specular, chunk)
        colors = texture(torch.stack([angle[:, 0] * radius, along_coords], dim=1))
        return gaussians(
            means=strands.starts[piece]
            + (share * length)[:, None] * axis
            + (0.6 * radius)[:, None] * outward,
            rotations=rotations_from_axes(axis, torch.linalg.cross(outward, axis)),
            scales=torch.stack([along, around, thin], dim=1),
            opacities=chunk.opacities(-1.0),
            colors=colors * diffuse_light(outward) + average + 0.02 * chunk.normals(3),
            rest=rest,
        )

    return draw


def grass(roots: Float[Tensor, "k 3"], height: float, colors: tuple[Texture, Texture]) -> Draw:
    """Make blades of grass: one needle per blade, leaning in any direction."""

    def draw(chunk: Chunk) -> GaussianScene:
        tuft = (chunk.uniforms() * len(roots)).long()
        lean = 0.35 * chunk.normals(3) * torch.tensor([1.0, 0.0, 1.0])
        axis = torch.nn.functional.normalize(lean - torch.tensor([0.0, 1.0, 0.0]), dim=1)
        length = height * (0.4 + 0.8 * chunk.uniforms())
        spread = 0.22 * chunk.normals(3) * torch.tensor([1.0, 0.0, 1.0])
        means = roots[tuft] + spread + (0.5 * length)[:, None] * axis
        along = 0.27 * length
        slimness = math.sqrt(min(1.0, _MANY_BLADES / chunk.total))
        across = along * chunk.lognormals(0.07 * slimness, 0.3)
        side = chunk.directions()
        rotations = rotations_from_axes(axis, side)
        flat = means[:, [0, 2]]
        shade = torch.lerp(colors[0](flat), colors[1](flat), chunk.uniforms(1))
        return gaussians(
            means=means,
            rotations=rotations,
            scales=torch.stack([along, across, 0.15 * across], dim=1),
            opacities=chunk.opacities(-0.5),
            colors=shade * (0.8 + 0.2 * chunk.normals(1)),
            rest=specular_colors(side, 0.0, chunk)[1],
        )

    return draw


def leaves(tips: Float[Tensor, "k 3"], spread: float, texture: Texture) -> Draw:
    """Make leaves around the tips of branches; together they are nearly opaque."""

    def draw(chunk: Chunk) -> GaussianScene:
        tip = (chunk.uniforms() * len(tips)).long()
        offset = chunk.normals(3)
        means = tips[tip] + spread * offset
        size = spread * math.sqrt(1.6 * len(tips) / chunk.total)
        length = chunk.lognormals(size, 0.4).clamp_max(0.7 * spread)
        width = length * (0.35 + 0.4 * chunk.uniforms())
        rotations = chunk.rotations()
        facing = rotations[:, :, 2] * torch.where(rotations[:, 1:2, 2] > 0, -1.0, 1.0)
        outward = torch.nn.functional.normalize(facing + 0.5 * offset, dim=1)
        return gaussians(
            means=means,
            rotations=rotations,
            scales=torch.stack([length, width, 0.06 * width], dim=1),
            opacities=chunk.opacities(0.0),
            colors=texture(means[:, :2]) * diffuse_light(outward) * (1 + 0.15 * chunk.normals(1)),
            rest=specular_colors(outward, 0.0, chunk)[1],
        )

    return draw
