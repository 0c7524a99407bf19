"""Parametric surfaces: from points of the unit square to points, frames and areas.

Up is -y. Every surface stands at the origin; :func:`placed` moves it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

FACE_STEP = 32.0
"""Texture coordinates of one quad lie this far from those of the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfacePoints:
    """Points of a surface.

    Attributes:
        points: ``(n, 3)`` positions.
        normals: ``(n, 3)`` unit normals of the side that is seen.
        tangents: ``(n, 3)`` unit directions of the first texture coordinate.
        bitangents: ``(n, 3)`` unit directions of the second one.
        coords: ``(n, 2)`` texture coordinates, scene units.
        areas: ``(n,)`` area of the whole surface if all of it were as sparse as here.
        rims: ``(n, 2)`` distance to the border along each texture coordinate.
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    tangents: Float[Tensor, "n 3"]
    bitangents: Float[Tensor, "n 3"]
    coords: Float[Tensor, "n 2"]
    areas: Float[Tensor, "n"]
    rims: Float[Tensor, "n 2"]


_FACES = (
    ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((1.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
)  # corner of the unit cube, and what is right and down for who looks at the face

Surface = Callable[[Float[Tensor, "n 2"]], SurfacePoints]
"""Takes points of the unit square to points of the surface."""

Heights = Callable[[Float[Tensor, "n 2"]], Float[Tensor, "n"]]
"""Height of the ground at x, z."""


def placed(surface: Surface, offset: Float[Tensor, "3"], rotation: Float[Tensor, "3 3"]) -> Surface:
    """Move a surface."""

    def sample(square: Float[Tensor, "n 2"]) -> SurfacePoints:
        at = surface(square)
        return replace(
            at,
            points=at.points @ rotation.T + offset,
            normals=at.normals @ rotation.T,
            tangents=at.tangents @ rotation.T,
            bitangents=at.bitangents @ rotation.T,
        )

    return sample


def quads(corners: Float[Tensor, "k 3"], sides: Float[Tensor, "k 2 3"]) -> Surface:
    """Make parallelograms; their normals are ``sides[:, 1] x sides[:, 0]``.

    Seen from where the normal points, texture coordinates go right and down if the sides do.
    """
    crosses = torch.linalg.cross(sides[:, 1], sides[:, 0])
    areas = torch.linalg.vector_norm(crosses, dim=1)
    ends = areas.double().cumsum(0)
    lengths = torch.linalg.vector_norm(sides, dim=2)
    directions = sides / lengths[:, :, None]
    total = float(ends[-1])

    def sample(square: Float[Tensor, "n 2"]) -> SurfacePoints:
        target = square[:, 0].double() * total
        face = torch.searchsorted(ends, target, right=True).clamp_max(len(ends) - 1)
        along = ((target - ends[face]) / areas[face] + 1.0).float().clamp(0.0, 1.0)
        local = torch.stack([along, square[:, 1]], dim=1)
        coords = local * lengths[face]
        return SurfacePoints(
            points=corners[face] + (local[:, :, None] * sides[face]).sum(1),
            normals=crosses[face] / areas[face, None],
            tangents=directions[face, 0],
            bitangents=directions[face, 1],
            coords=coords + FACE_STEP * torch.stack([face, face * 0], dim=1),
            areas=torch.full_like(along, total),
            rims=torch.minimum(local, 1 - local) * lengths[face],
        )

    return sample


def boxes(lows: Float[Tensor, "k 3"], sizes: Float[Tensor, "k 3"]) -> Surface:
    """Make axis-aligned boxes, seen from outside, six faces each."""
    corners = lows[:, None] + torch.tensor([corner for corner, _, _ in _FACES]) * sizes[:, None]
    faces = torch.tensor([(right, down) for _, right, down in _FACES]) * sizes[:, None, None]
    return quads(corners.reshape(-1, 3), faces.reshape(-1, 2, 3))


def revolution(profile: Float[Tensor, "k 2"]) -> Surface:
    """Turn a profile about the vertical axis."""
    steps = profile.diff(dim=0)
    lengths = torch.linalg.vector_norm(steps, dim=1)
    bands = math.pi * (profile[1:, 0] + profile[:-1, 0]) * lengths
    ends = bands.double().cumsum(0)
    directions = steps / lengths[:, None]
    starts = lengths.cumsum(0) - lengths
    length = float(lengths.sum())
    bends = (directions[1:] * directions[:-1]).sum(1) < 0.8
    creases = torch.cat([lengths.cumsum(0)[:-1][bends], torch.tensor([math.inf])])
    girth = float(profile[:, 0].mean())
    total = float(ends[-1])

    def sample(square: Float[Tensor, "n 2"]) -> SurfacePoints:
        target = square[:, 1].double() * total
        band = torch.searchsorted(ends, target, right=True).clamp_max(len(ends) - 1)
        share = ((target - ends[band]) / bands[band] + 1.0).float().clamp(0.0, 1.0)
        radius, height = (profile[band] + share[:, None] * steps[band]).unbind(1)
        angle = 2 * math.pi * square[:, 0]
        cos, sin, flat = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)
        out, up = directions[band].unbind(1)
        along = starts[band] + share * lengths[band]
        rim = (along[:, None] - creases).abs().amin(1)
        return SurfacePoints(
            points=torch.stack([radius * cos, -height, radius * sin], dim=1),
            normals=torch.stack([up * cos, out, up * sin], dim=1),
            tangents=torch.stack([-sin, flat, cos], dim=1),
            bitangents=torch.stack([-out * cos, up, -out * sin], dim=1),
            coords=torch.stack([angle * girth, length - along], dim=1),
            areas=torch.full_like(angle, total),
            rims=torch.stack([torch.full_like(rim, math.inf), rim], dim=1),
        )

    return sample


def sphere(radius: float) -> Surface:
    """Make a sphere around the origin."""
    angle = torch.linspace(-math.pi / 2, math.pi / 2, 257)
    return revolution(radius * torch.stack([torch.cos(angle).abs(), torch.sin(angle)], dim=1))


def torus(radius: float, thickness: float) -> Surface:
    """Make a torus that lies around the origin; ``thickness`` is the radius of the tube."""
    angle = torch.linspace(-math.pi, math.pi, 257)
    ring = torch.stack([torch.cos(angle), torch.sin(angle)], dim=1)
    return revolution(torch.tensor([radius, 0.0]) + thickness * ring)


def ground(heights: Heights, *, core: float, radius: float, hole: float = 0.0) -> Surface:
    """Make a round piece of ground, dense inside ``core`` and ever sparser outside."""
    start = core**2 + hole**2
    growth = math.log((core**2 + radius**2) / start)

    def sample(square: Float[Tensor, "n 2"]) -> SurfacePoints:
        squared = start * torch.exp(growth * square[:, 1]) - core**2
        squared = squared.clamp_min(0.0)
        angle = 2 * math.pi * square[:, 0]
        flat = squared.sqrt()[:, None] * torch.stack([torch.cos(angle), torch.sin(angle)], dim=1)
        step = 0.01 * (core + squared.sqrt())
        level = heights(flat)
        slopes = [
            (heights(flat + step[:, None] * axis) - level) / step for axis in torch.eye(2).unbind()
        ]
        one, none = torch.ones_like(level), torch.zeros_like(level)
        tangents = torch.stack([one, -slopes[0], none], dim=1)
        bitangents = torch.stack([none, -slopes[1], one], dim=1)
        unit = torch.nn.functional.normalize
        return SurfacePoints(
            points=torch.stack([flat[:, 0], -level, flat[:, 1]], dim=1),
            normals=unit(torch.stack([-slopes[0], -one, -slopes[1]], dim=1), dim=1),
            tangents=unit(tangents, dim=1),
            bitangents=unit(bitangents, dim=1),
            coords=flat,
            areas=math.pi * growth * (squared + core**2),
            rims=torch.full_like(flat, math.inf),
        )

    return sample


def dome(radius: float, lowest: float) -> Surface:
    """Make the sky: a sphere seen from inside, without what is below."""

    def sample(square: Float[Tensor, "n 2"]) -> SurfacePoints:
        rise = 1.0 - (1.0 - lowest) * square[:, 1]
        angle = 2 * math.pi * square[:, 0]
        cos, sin, flat = torch.cos(angle), torch.sin(angle), (1 - rise * rise).clamp_min(0).sqrt()
        outward = torch.stack([flat * cos, -rise, flat * sin], dim=1)
        tangents = torch.stack([-sin, torch.zeros_like(sin), cos], dim=1)
        return SurfacePoints(
            points=radius * outward,
            normals=-outward,
            tangents=tangents,
            bitangents=torch.linalg.cross(outward, tangents),
            coords=torch.acos(rise.clamp(-1, 1))[:, None] * torch.stack([cos, sin], dim=1),
            areas=torch.full_like(rise, 2 * math.pi * (1.0 - lowest) * radius**2),
            rims=torch.full((len(rise), 2), math.inf),
        )

    return sample
