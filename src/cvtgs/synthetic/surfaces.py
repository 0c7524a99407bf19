"""Parametric surfaces: functions from the unit square to points, frames and areas.

Up is -y. Surfaces are built at the origin; :func:`placed` moves them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

FACE_STEP = 32.0  # offset between the texture coordinates of consecutive quads


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfacePoints:
    """Points of a surface."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]  # unit normals of the visible side
    tangents: Float[Tensor, "n 3"]  # unit directions of the first texture coordinate
    bitangents: Float[Tensor, "n 3"]  # unit directions of the second one
    coords: Float[Tensor, "n 2"]  # texture coordinates, scene units
    areas: Float[Tensor, "n"]  # of the surface, had it the local point density throughout
    rims: Float[Tensor, "n 2"]  # distance to the border along each texture coordinate


# Faces of the unit cube: a corner, and the directions right and down as seen from outside
_FACES = (
    ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((1.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
)
# Function from points of the unit square to points of the surface
Surface = Callable[[Float[Tensor, "n 2"]], SurfacePoints]
Heights = Callable[[Float[Tensor, "n 2"]], Float[Tensor, "n"]]  # height of the ground at x, z


def placed(
    surface: Surface,
    position: tuple[float, float] = (0.0, 0.0),
    *,
    height: float = 0.0,
    turn: float = 0.0,
    tilt: float = 0.0,
) -> Surface:
    """Tilt a surface about x, turn it about the vertical, and put it at x, z above the ground."""
    cos, sin = math.cos(turn), math.sin(turn)
    turned = torch.tensor([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    cos, sin = math.cos(tilt), math.sin(tilt)
    tilted = torch.tensor([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    rotation = turned @ tilted
    offset = torch.tensor([position[0], -height, position[1]])

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
    """Build parallelograms seen from outside, whose sides run right and down."""
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
    """Build axis-aligned boxes, six faces each."""
    corners = lows[:, None] + torch.tensor([corner for corner, _, _ in _FACES]) * sizes[:, None]
    faces = torch.tensor([(right, down) for _, right, down in _FACES]) * sizes[:, None, None]
    return quads(corners.reshape(-1, 3), faces.reshape(-1, 2, 3))


def revolution(profile: Float[Tensor, "k 2"]) -> Surface:
    """Build a surface of revolution about the vertical from a profile of (radius, height)."""
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
    """Build a sphere around the origin."""
    angle = torch.linspace(-math.pi / 2, math.pi / 2, 257)
    return revolution(radius * torch.stack([torch.cos(angle).abs(), torch.sin(angle)], dim=1))


def torus(radius: float, thickness: float) -> Surface:
    """Build a horizontal torus around the origin; ``thickness`` is the radius of the tube."""
    angle = torch.linspace(-math.pi, math.pi, 257)
    ring = torch.stack([torch.cos(angle), torch.sin(angle)], dim=1)
    return revolution(torch.tensor([radius, 0.0]) + thickness * ring)


def ground(heights: Heights, *, core: float, radius: float, hole: float = 0.0) -> Surface:
    """Build a disc of ground, sampled densely inside ``core`` and more sparsely farther out."""
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
    """Build the sky: the upper part of a sphere, seen from inside."""

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


def box(width: float, height: float, depth: float) -> Surface:
    """Build a box that stands at the origin."""
    size = torch.tensor([[width, height, depth]])
    return boxes(size * torch.tensor([-0.5, -1.0, -0.5]), size)


def table(width: float, height: float, depth: float) -> Surface:
    """Build a board on four legs."""
    legs = torch.tensor([(x, z) for x in (-0.5, 0.5) for z in (-0.5, 0.5)])
    feet = legs * (torch.tensor([width, depth]) - 0.1) - 0.025
    lows = torch.stack([feet[:, 0], torch.full((4,), 0.05 - height), feet[:, 1]], dim=1)
    board = torch.tensor([[-0.5 * width, -height, -0.5 * depth]])
    sizes = torch.tensor([[width, 0.05, depth]] + [[0.05, height - 0.05, 0.05]] * 4)
    return boxes(torch.cat([board, lows]), sizes)


def wall(start: tuple[float, float], end: tuple[float, float], height: float) -> Surface:
    """Build a wall between two positions on the ground."""
    middle = (0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1]))
    turn = -math.atan2(end[1] - start[1], end[0] - start[0])
    return placed(box(math.dist(start, end), height, 0.24), middle, turn=turn)


def upright_rectangle(width: float, height: float) -> Surface:
    """Build an upright rectangle with its foot at the origin, seen from -z."""
    sides = torch.tensor([[[width, 0.0, 0.0], [0.0, height, 0.0]]])
    return quads(torch.tensor([[-0.5 * width, -height, 0.0]]), sides)


def room_shell(width: float, height: float, depth: float) -> tuple[Surface, Surface, Surface]:
    """Build the walls, the floor and the ceiling of a room, seen from inside."""
    across, away = torch.tensor([width, 0.0, 0.0]), torch.tensor([0.0, 0.0, depth])
    down = torch.tensor([0.0, height, 0.0])
    left_back = -0.5 * across - 0.5 * away - down
    corners = torch.stack(
        [left_back + away, left_back + across, left_back, left_back + across + away]
    )
    sides = torch.stack([torch.stack([right, down]) for right in (across, -across, away, -away)])
    floor = quads((left_back + down + away)[None], torch.stack([across, -away])[None])
    ceiling = quads(left_back[None], torch.stack([across, away])[None])
    return quads(corners, sides), floor, ceiling


def column(radius: float, height: float) -> Surface:
    """Build a column with base and capital."""
    profile = [
        (0.0, 0.0), (1.5, 0.0), (1.5, 0.05), (1.15, 0.08), (1.0, 0.1), (0.97, 0.5), (0.88, 0.9),
        (1.1, 0.92), (1.45, 0.96), (1.45, 1.0), (0.0, 1.0),
    ]  # fmt: skip
    return revolution(torch.tensor(profile) * torch.tensor([radius, height]))


def disc(radius: float, height: float) -> Surface:
    """Build a round plate."""
    return revolution(torch.tensor([(0.0, 0.0), (radius, 0.0), (radius, height), (0.0, height)]))


def vase(height: float, *, belly: float, neck: float, low: float) -> Surface:
    """Build a vase: a foot, a belly, a neck and a lip."""
    knots = torch.tensor([(0.16, 0.0), (belly, low), (neck, 0.8), (0.2, 1.0)])
    share = torch.linspace(0, 1, 40)[1:, None]
    eased = 0.5 - 0.5 * torch.cos(math.pi * share)
    bends = [
        torch.lerp(start, end, torch.cat([eased, share], dim=1))
        for start, end in pairwise(knots.unbind())
    ]
    return revolution(height * torch.cat([torch.tensor([(0.0, 0.0), (0.16, 0.0)]), *bends]))
