"""Things that stand around in the layouts: surfaces, already placed, with their textures."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.synthetic.assemble import Part
from cvtgs.synthetic.dice import Dice
from cvtgs.synthetic.splats import Finish, coated
from cvtgs.synthetic.surfaces import (
    Surface,
    boxes,
    dome,
    placed,
    quads,
    revolution,
    sphere,
    torus,
)
from cvtgs.synthetic.textures import Texture, blend, bricks, letters, noise, plain, stripes
from cvtgs.synthetic.thin import leaves, rods, tree

Place = tuple[float, float]
"""x and z on the ground."""

_PEDESTAL = 0.5


def turned(angle: float) -> Float[Tensor, "3 3"]:
    """Rotate about the vertical axis."""
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def tilted(angle: float) -> Float[Tensor, "3 3"]:
    """Rotate about the x axis."""
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])


def standing(surface: Surface, place: Place, height: float = 0.0, turn: float = 0.0) -> Surface:
    """Put a surface on the ground, or ``height`` above it."""
    return placed(surface, torch.tensor([place[0], -height, place[1]]), turned(turn))


def box(size: tuple[float, float, float]) -> Surface:
    """Make a box of this width, height and depth that stands on the origin."""
    extent = torch.tensor([size])
    return boxes(extent * torch.tensor([[-0.5, -1.0, -0.5]]), extent)


def wall(start: Place, end: Place, height: float, thickness: float = 0.24) -> Surface:
    """Make a wall between two places."""
    width = math.dist(start, end)
    middle = (0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1]))
    turn = -math.atan2(end[1] - start[1], end[0] - start[0])
    return standing(box((width, height, thickness)), middle, turn=turn)


def screen(width: float, height: float) -> Surface:
    """Make an upright rectangle, seen from -z, its foot at the origin."""
    corner = torch.tensor([[-0.5 * width, -height, 0.0]])
    sides = torch.tensor([[[0.0, height, 0.0], [width, 0.0, 0.0]]])
    return quads(corner, sides)


def column_profile(radius: float, height: float) -> Float[Tensor, "k 2"]:
    """Draw a column with base and capital."""
    steps = [
        (0.0, 0.0), (1.5, 0.0), (1.5, 0.05), (1.15, 0.08), (1.0, 0.1), (0.97, 0.5), (0.88, 0.9),
        (1.1, 0.92), (1.45, 0.96), (1.45, 1.0), (0.0, 1.0),
    ]  # fmt: skip
    return torch.tensor(steps) * torch.tensor([radius, height])


def vase_profile(dice: Dice, height: float) -> Float[Tensor, "k 2"]:
    """Draw a belly, a neck and a lip, in random proportions."""
    belly, neck = dice.between(0.28, 0.42), dice.between(0.07, 0.15)
    low = dice.between(0.25, 0.45)
    knots = torch.tensor(
        [(0.0, 0.0), (0.16, 0.0), (belly, low), (neck, 0.8), (0.2, 1.0)]
    )
    share = torch.linspace(0, 1, 40)
    eased = (0.5 - 0.5 * torch.cos(math.pi * share))[:, None]
    rise = share[:, None]
    pieces = [knots[:2]]
    for start, end in zip(knots[1:-1], knots[2:], strict=True):
        radius = torch.lerp(start[:1], end[:1], eased)
        level = torch.lerp(start[1:], end[1:], rise)
        pieces.append(torch.cat([radius, level], dim=1)[1:])
    return height * torch.cat(pieces)


def exhibits(dice: Dice, places: list[Place], share: float) -> list[Part]:
    """Show textured things on pedestals.

    Args:
        dice: Chances.
        places: One place each, at most 6.
        share: Share of the Gaussians for all of them.

    Returns:
        Two parts for each.
    """
    size = [dice.between(0.42, 0.58) for _ in range(6)]
    lift = _PEDESTAL
    models: list[tuple[Surface, float]] = [
        (placed(sphere(size[0]), torch.tensor([0, -size[0], 0]), torch.eye(3)), 0.9),
        (box((1.5 * size[1], 1.5 * size[1], 1.5 * size[1])), 0.1),
        (
            placed(
                torus(size[2], 0.4 * size[2]),
                torch.tensor([0.0, -1.3 * size[2], 0.0]),
                tilted(dice.between(0.7, 1.5)),
            ),
            0.7,
        ),
        (revolution(vase_profile(dice, 2.6 * size[3])), 0.6),
        (revolution(column_profile(0.5 * size[4], 4.5 * size[4])), 0.0),
        (placed(sphere(size[5]), torch.tensor([0, -size[5], 0]), torch.eye(3)), 0.25),
    ]
    parts = []
    order = dice.order(len(models))
    for place, k in zip(places, order, strict=False):
        surface, gloss = models[k]
        turn = dice.between(0, 2 * math.pi)
        density = dice.between(0.6, 1.6)
        texture = dice.pattern(dice.between(0.07, 0.13))
        stand = box((1.0, lift, 1.0))
        parts += [
            Part(
                share=0.8 * density * share / len(places),
                draw=coated(standing(surface, place, lift, turn), texture, Finish(gloss=gloss)),
            ),
            Part(
                share=0.2 * share / len(places),
                draw=coated(
                    standing(stand, place, 0.0, turn),
                    dice.stone(dice.near((0.75, 0.72, 0.66)), 1.0),
                    Finish(gloss=0.05),
                ),
            ),
        ]
    return parts


def trees(dice: Dice, place: Place, height: float, share: float) -> list[Part]:
    """Grow one tree: its wood and its leaves."""
    foot = torch.tensor([place[0], 0.0, place[1]])
    strands, tips = tree(foot, height, dice.generator)
    bark = dice.clouds((0.22, 0.16, 0.11), dice.near((0.46, 0.36, 0.27)), 0.5)
    green = dice.near((0.36, 0.52, 0.16))
    crown = dice.clouds((0.16, 0.3, 0.08), green, 0.2 * height)
    return [
        Part(share=0.3 * share, draw=rods(strands, bark, 0.0)),
        Part(share=0.7 * share, draw=leaves(tips, 0.045 * height, crown)),
    ]


def sky(dice: Dice, radius: float, share: float) -> Part:
    """Span a sky with clouds over the scene."""
    zenith, horizon = dice.near((0.22, 0.42, 0.78)), dice.near((0.78, 0.86, 0.93))
    blue = blend(
        plain(zenith),
        plain(horizon),
        lambda coords: (torch.linalg.vector_norm(coords, dim=1) / 1.55).clamp(0, 1) ** 1.6,
    )
    puffs = noise(2.6, 0.5, dice.generator)
    clouds = blend(blue, plain((0.97, 0.97, 0.98)), lambda c: (1.6 * puffs(c) - 0.75).clamp(0, 1))
    finish = Finish(overlap=1.5, faintness=-1.5, thickness=0.5, lit=False)
    return Part(share=share, draw=coated(dome(radius, -0.08), clouds, finish))


def masonry(dice: Dice) -> Texture:
    """Lay bricks in random colours."""
    stone = dice.stone(dice.near((0.66, 0.42, 0.33)), 1.3)
    return bricks(stone, plain(dice.near((0.72, 0.7, 0.66))), dice.between(0.1, 0.16))


def poster(dice: Dice, size: float) -> Texture:
    """Print letters or stripes."""
    paper, ink = plain(dice.hue(0.1, 0.95)), plain(dice.hue(0.8, 0.45))
    if dice.between(0, 1) < 0.6:
        return letters(paper, ink, size)
    return stripes(paper, ink, torch.tensor([0.7, 0.7]) / size)
