"""Things that layouts show: textured exhibits, trees, lawns, the sky."""

import math

import torch

from cvtgs.synthetic.assemble import Part
from cvtgs.synthetic.chunks import Draw
from cvtgs.synthetic.dice import Dice
from cvtgs.synthetic.shapes import (
    Place,
    box,
    column_profile,
    disc_profile,
    lifted,
    standing,
    vase_profile,
)
from cvtgs.synthetic.splats import Finish, coated
from cvtgs.synthetic.surfaces import Surface, dome, revolution, sphere, torus
from cvtgs.synthetic.textures import Texture, blend, bricks, letters, plain, stripes
from cvtgs.synthetic.thin import grass, leaves, rods, tree

MATTE = Finish()
"""Lit, without highlights."""

GLOWING = Finish(lit=False)
"""Of one brightness from all sides."""


def covered(surface: Surface, texture: Texture, *, share: float, finish: Finish = MATTE) -> Part:
    """Make a part of a surface."""
    return Part(share=share, draw=coated(surface, texture, finish))


def vase(dice: Dice, height: float) -> Surface:
    """Turn a vase of random proportions."""
    belly, neck, low = dice.between(0.28, 0.42), dice.between(0.07, 0.15), dice.between(0.25, 0.45)
    return revolution(vase_profile(height, belly=belly, neck=neck, low=low))


def exhibits(dice: Dice, places: list[Place], *, share: float, pedestal: float) -> list[Part]:
    """Show textured things on round and square pedestals."""
    size = [dice.between(0.42, 0.58) for _ in range(6)]
    edge = 1.5 * size[1]
    models = [
        (lifted(sphere(size[0]), size[0]), 0.7),
        (box(edge, edge, edge), 0.1),
        (lifted(torus(size[2], 0.4 * size[2]), 1.3 * size[2], dice.between(0.7, 1.5)), 0.5),
        (vase(dice, 2.6 * size[3]), 0.6),
        (revolution(column_profile(0.5 * size[4], 4.5 * size[4])), 0.0),
        (lifted(sphere(size[5]), size[5]), 0.2),
    ]
    patterns = dice.order(60)
    parts = []
    for row, (place, k) in enumerate(zip(places, dice.order(len(models)), strict=False)):
        surface, gloss = models[k]
        turn = dice.between(0, 2 * math.pi)
        each = share * dice.between(0.7, 1.3) / len(places)
        texture = dice.pattern(dice.between(0.08, 0.14), patterns[0] + row)
        stand = revolution(disc_profile(0.62, pedestal)) if row % 2 else box(1.0, pedestal, 1.0)
        stone = dice.stone(dice.near((0.75, 0.72, 0.66)), 1.0)
        parts += [
            covered(
                standing(surface, place, height=pedestal, turn=turn),
                texture, share=0.75 * each, finish=Finish(gloss=gloss),
            ),
            covered(standing(stand, place, turn=turn), stone, share=0.25 * each),
        ]  # fmt: skip
    return parts


def trees(
    dice: Dice, place: tuple[float, float, float], *, height: float, share: float
) -> list[Part]:
    """Grow one tree: its wood and its leaves."""
    strands, tips = tree(torch.tensor(place), height, dice.generator)
    bark = dice.clouds((0.22, 0.16, 0.11), dice.near((0.46, 0.36, 0.27)), 0.5)
    crown = dice.clouds((0.16, 0.3, 0.08), dice.near((0.36, 0.52, 0.16)), 0.2 * height)
    return [
        Part(share=0.3 * share, draw=rods(strands, bark, 0.0)),
        Part(share=0.7 * share, draw=leaves(tips, 0.045 * height, crown)),
    ]


def lawn(dice: Dice, ring: tuple[float, float], height: float) -> Draw:
    """Plant grass in a ring around the origin, densest inside."""
    angle, share = torch.rand(2, 900, generator=dice.generator).unbind()
    radius = ring[0] + (ring[1] - ring[0]) * share.square()
    x, z = radius * torch.cos(2 * math.pi * angle), radius * torch.sin(2 * math.pi * angle)
    foot, tip = plain(dice.near((0.16, 0.26, 0.07))), plain(dice.near((0.55, 0.62, 0.25)))
    return grass(torch.stack([x, torch.zeros_like(x), z], dim=1), height, (foot, tip))


def meadow(dice: Dice) -> Texture:
    """Mix greens and browns of grown ground."""
    green = dice.clouds(dice.near((0.2, 0.3, 0.1)), dice.near((0.45, 0.5, 0.22)), 5.0)
    return blend(green, plain(dice.near((0.45, 0.38, 0.24))), dice.noise(17.0, 0.3))


def sky(dice: Dice, radius: float, share: float) -> Part:
    """Span a sky with clouds over the scene."""
    zenith, horizon = dice.near((0.22, 0.42, 0.78)), dice.near((0.78, 0.86, 0.93))
    blue = blend(
        plain(zenith),
        plain(horizon),
        lambda coords: (torch.linalg.vector_norm(coords, dim=1) / 1.55).clamp(0, 1) ** 1.6,
    )
    puffs = dice.noise(6.0, 0.28)
    clouds = blend(blue, plain((0.97, 0.97, 0.98)), lambda c: (2.2 * puffs(c) - 1.1).clamp(0, 1))
    finish = Finish(overlap=1.4, faintness=-1.5, thickness=0.5, lit=False)
    return covered(dome(radius, -0.08), clouds, share=share, finish=finish)


def masonry(dice: Dice) -> Texture:
    """Lay bricks in random colours."""
    stone = dice.stone(dice.near((0.66, 0.42, 0.33)), 1.3)
    return bricks(stone, plain(dice.near((0.72, 0.7, 0.66))), dice.between(0.2, 0.28))


def poster(dice: Dice, size: float) -> Texture:
    """Print letters or stripes."""
    paper, ink = plain(dice.hue(0.1, 0.95)), plain(dice.hue(0.8, 0.45))
    if dice.between(0, 1) < 0.6:
        return letters(paper, ink, size)
    return stripes(paper, ink, torch.tensor([0.7, 0.7]) / size)
