"""Layouts under the open sky: the courtyard, the landscape and the thin structures."""

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.synthetic.assemble import Part
from cvtgs.synthetic.dice import Dice
from cvtgs.synthetic.shapes import column_profile, standing, wall
from cvtgs.synthetic.surfaces import ground, revolution
from cvtgs.synthetic.textures import Texture, blend, bricks, checker, plain, shadows
from cvtgs.synthetic.thin import Strands, joined, railing, rods, wire
from cvtgs.synthetic.things import covered, exhibits, lawn, masonry, meadow, sky, trees
from cvtgs.synthetic.volumes import floaters, haze

_SHADOW = torch.tensor([-0.55, -0.5])
"""Where the shadow of a thing on a pedestal falls, from its foot."""


def courtyard(dice: Dice) -> list[Part]:
    """Lay out a paved yard with a bit of everything in it."""
    places = dice.spots(5, (1.5, 2.3))
    paving = shadows(_paving(dice), torch.tensor(places) + _SHADOW, 0.75)
    grown = meadow(dice)
    corner = -3.9
    bricked = masonry(dice)
    return [
        covered(ground(level, core=20.0, radius=4.9), paving, share=15),
        covered(ground(level, core=5.0, radius=70.0, hole=4.8), grown, share=6),
        covered(wall((corner, corner), (3.9, corner), height=1.5), bricked, share=8),
        covered(wall((corner, corner), (corner, 2.2), height=1.5), bricked, share=6),
        *exhibits(dice, places, share=38, pedestal=0.5),
        *_fence(dice),
        *trees(dice, (-2.7, 0.0, -2.7), height=3.6, share=9),
        Part(share=6, draw=lawn(dice, (5.0, 8.0), 0.2)),
        _mist(dice),
        Part(share=0.5, draw=floaters(torch.zeros(3), 3.0)),
        sky(dice, dice.between(50.0, 80.0), 3.5),
    ]


def landscape(dice: Dice) -> list[Part]:
    """Lay out hills, a tower, trees and a far sky."""
    hills, relief = dice.noise(90.0, 0.2), dice.between(6.0, 14.0)

    def heights(flat: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        away = ((torch.linalg.vector_norm(flat, dim=1) - 5.0) / 25.0).clamp(0, 1)
        rise: Tensor = relief * (hills(flat) - 0.35) * away
        return rise

    land = blend(meadow(dice), dice.stone((0.55, 0.48, 0.4), 6.0), dice.noise(40.0, 0.3))
    places = dice.spots(7, (3.0, 6.0))
    rises = heights(torch.tensor(places)).tolist()
    tower = revolution(column_profile(1.1, dice.between(5.0, 7.0)))
    return [
        covered(ground(heights, core=6.0, radius=13.0), land, share=18),
        covered(ground(heights, core=13.0, radius=150.0, hole=12.0), land, share=10),
        covered(standing(tower, (0, 0)), masonry(dice), share=20),
        *(
            part
            for (x, z), rise in zip(places, rises, strict=True)
            for part in trees(dice, (x, -rise, z), height=dice.between(2.5, 4.5), share=5)
        ),
        Part(share=10, draw=lawn(dice, (1.8, 7.0), 0.25)),
        Part(share=0.5, draw=floaters(torch.zeros(3), 6.0)),
        sky(dice, dice.between(110.0, 160.0), 6),
    ]


def thin_structures(dice: Dice) -> list[Part]:
    """Lay out rails, wires, trees and grass."""
    paint = dice.clouds(dice.hue(0.4, 0.25), dice.hue(0.4, 0.5), 0.9)
    rails = [
        railing(
            torch.tensor([dice.between(-2.2, -1.0), 0.0, row - 2.0]),
            torch.tensor([dice.between(2.0, 3.5), 0.0, dice.between(-0.6, 0.6)]),
            dice.between(0.6, 1.2),
        )
        for row in range(5)
    ]
    feet = torch.tensor([[x, 0.0, z] for x, z in dice.spots(4, (2.2, 3.0))])
    tops = feet - torch.tensor([0.0, dice.between(2.2, 3.2), 0.0])
    drops = torch.tensor([0.0, 0.15, 0.0]) * torch.arange(3)[:, None]
    wires = [
        wire(tops[i] + drop, tops[j] + drop, dice.between(0.1, 0.6))
        for i in range(4)
        for j in range(i)
        for drop in drops
    ]
    poles = Strands(starts=feet, ends=tops, radii=torch.full((4,), 0.05))
    return [
        Part(share=24, draw=rods(joined(*rails), paint, 0.4)),
        Part(share=14, draw=rods(joined(*wires), plain((0.12, 0.12, 0.13)), 0.2)),
        Part(share=4, draw=rods(poles, paint, 0.3)),
        *(
            part
            for x, z in dice.spots(3, (1.0, 1.8))
            for part in trees(dice, (x, 0.0, z), height=dice.between(1.8, 3.0), share=10)
        ),
        Part(share=14, draw=lawn(dice, (0.2, 3.0), 0.25)),
        covered(ground(level, core=9.0, radius=3.8), meadow(dice), share=14),
        Part(share=0.5, draw=floaters(torch.zeros(3), 2.5)),
    ]


def level(flat: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
    """Return the heights of flat ground."""
    return torch.zeros(len(flat))


def _paving(dice: Dice) -> Texture:
    """Lay slabs or tiles of stone."""
    stone = dice.stone(dice.near((0.7, 0.66, 0.58)), 2.0)
    if dice.between(0, 1) < 0.6:
        return bricks(stone, plain((0.3, 0.28, 0.25)), dice.between(0.4, 0.55))
    dark = dice.stone(dice.near((0.45, 0.36, 0.32)), 2.0)
    return checker(stone, dark, dice.between(0.5, 0.8))


def _fence(dice: Dice) -> list[Part]:
    """Close the open sides of the yard with railings, and hang wires across it."""
    rails = joined(
        railing(torch.tensor([3.9, 0, -3.6]), torch.tensor([0, 0, 7.4]), 1.0),
        railing(torch.tensor([-3.6, 0, 3.9]), torch.tensor([5.5, 0, 0]), 1.0),
    )
    feet = torch.tensor([[-3.9, 0.0, 3.6], [3.8, 0.0, -3.7]])
    tops = feet - torch.tensor([0.0, 3.4, 0.0])
    wires = [
        wire(tops[0] + drop, tops[1] + drop, dice.between(0.3, 0.6))
        for drop in torch.tensor([[0, 0.05, 0], [0, 0.3, 0], [0, 0.55, 0]])
    ]
    poles = Strands(starts=feet, ends=tops, radii=torch.tensor([0.06, 0.06]))
    steel = dice.clouds((0.2, 0.21, 0.23), (0.36, 0.37, 0.4), 2.0)
    return [
        Part(share=4.5, draw=rods(rails, steel, 0.3)),
        Part(share=0.7, draw=rods(poles, steel, 0.3)),
        Part(share=0.8, draw=rods(joined(*wires), plain((0.1, 0.1, 0.11)), 0.1)),
    ]


def _mist(dice: Dice) -> Part:
    """Let a bank of mist hang in the corner of the walls."""
    turn = dice.between(0, 1)
    center = torch.tensor([-2.0 + 1.5 * turn, -0.4, -0.5 - 1.5 * turn])
    extent = torch.tensor([1.8, 0.45, 1.5])
    color = dice.near((0.8, 0.82, 0.86))
    return Part(share=5, draw=haze(center, extent, dice.between(0.5, 0.8), color))
