"""Shapes of known things, standing on the origin: boxes, walls, columns, vases."""

import math
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.synthetic.surfaces import Surface, boxes, placed, quads

Place = tuple[float, float]
"""x and z on the ground."""


def tilted(angle: float) -> Float[Tensor, "3 3"]:
    """Rotate about the x axis."""
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])


def lifted(surface: Surface, height: float, tilt: float = 0.0) -> Surface:
    """Lift a surface that is centred on the origin, and tilt it."""
    return placed(surface, torch.tensor([0.0, -height, 0.0]), tilted(tilt))


def standing(surface: Surface, place: Place, *, height: float = 0.0, turn: float = 0.0) -> Surface:
    """Put a surface at a place, ``height`` above the ground, turned about the vertical."""
    cos, sin = math.cos(turn), math.sin(turn)
    rotation = torch.tensor([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    return placed(surface, torch.tensor([place[0], -height, place[1]]), rotation)


def box(width: float, height: float, depth: float) -> Surface:
    """Make a box that stands on the origin."""
    size = torch.tensor([[width, height, depth]])
    return boxes(size * torch.tensor([-0.5, -1.0, -0.5]), size)


def wall(start: Place, end: Place, *, height: float, thickness: float = 0.24) -> Surface:
    """Make a wall between two places."""
    middle = (0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1]))
    turn = -math.atan2(end[1] - start[1], end[0] - start[0])
    return standing(box(math.dist(start, end), height, thickness), middle, turn=turn)


def screen(width: float, height: float) -> Surface:
    """Make an upright rectangle with its foot at the origin, seen from -z."""
    sides = torch.tensor([[[width, 0.0, 0.0], [0.0, height, 0.0]]])
    return quads(torch.tensor([[-0.5 * width, -height, 0.0]]), sides)


def column_profile(radius: float, height: float) -> Float[Tensor, "k 2"]:
    """Draw a column with base and capital."""
    steps = [
        (0.0, 0.0), (1.5, 0.0), (1.5, 0.05), (1.15, 0.08), (1.0, 0.1), (0.97, 0.5), (0.88, 0.9),
        (1.1, 0.92), (1.45, 0.96), (1.45, 1.0), (0.0, 1.0),
    ]  # fmt: skip
    return torch.tensor(steps) * torch.tensor([radius, height])


def disc_profile(radius: float, height: float) -> Float[Tensor, "k 2"]:
    """Draw a round plate."""
    return torch.tensor([(0.0, 0.0), (radius, 0.0), (radius, height), (0.0, height)])


def vase_profile(height: float, *, belly: float, neck: float, low: float) -> Float[Tensor, "k 2"]:
    """Draw a foot, a belly, a neck and a lip."""
    knots = torch.tensor([(0.16, 0.0), (belly, low), (neck, 0.8), (0.2, 1.0)])
    share = torch.linspace(0, 1, 40)[1:, None]
    eased = 0.5 - 0.5 * torch.cos(math.pi * share)
    bends = [
        torch.lerp(start, end, torch.cat([eased, share], dim=1))
        for start, end in pairwise(knots.unbind())
    ]
    return height * torch.cat([torch.tensor([(0.0, 0.0), (0.16, 0.0)]), *bends])
