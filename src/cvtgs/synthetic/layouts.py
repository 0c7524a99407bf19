"""What is in a scene of each kind, and where."""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

import torch

from cvtgs.synthetic.assemble import Part
from cvtgs.synthetic.dice import Dice
from cvtgs.synthetic.splats import Finish, coated
from cvtgs.synthetic.surfaces import Surface, ground, placed, quads, revolution, sphere, torus, boxes
from cvtgs.synthetic.textures import Texture, blend, bricks, checker, noise, patches, plain, within
from cvtgs.synthetic.things import (
    box, column_profile, exhibits, masonry, poster, screen, sky, standing, tilted, trees,
    vase_profile, wall,
)
from cvtgs.synthetic.thin import Strands, grass, joined, railing, rods, wire
from cvtgs.synthetic.volumes import floaters, haze


def courtyard(dice: Dice) -> list[Part]:
    """Lay out a paved yard with a bit of everything in it."""
    places = list(dice.spots(5, (1.5, 2.3)))
    meadow = _meadow(dice)
    paving = bricks(dice.stone((0.7, 0.66, 0.58), 2.0), plain((0.33, 0.31, 0.28)), 0.3)
    floor = blend(meadow, paving, within(4.6, 0.04))
    corner, reach = (-4.2, -4.2), 4.2
    rails = joined(
        railing(torch.tensor([4.1, 0, -3.8]), torch.tensor([0, 0, 7.4]), 1.0),
        railing(torch.tensor([-3.8, 0, 4.1]), torch.tensor([5.5, 0, 0]), 1.0),
    )
    poles = torch.tensor([[-4.2, 0.0, 3.6], [4.0, 0.0, -4.0]])
    tops = poles - torch.tensor([0.0, 3.4, 0.0])
    lines = joined(
        Strands(starts=poles, ends=tops, radii=torch.tensor([0.06, 0.06])),
        *(wire(tops[0], tops[1] + torch.tensor([0, lift, 0]), 0.5) for lift in (0.05, 0.3, 0.55)),
    )
    steel = dice.clouds((0.2, 0.21, 0.23), (0.4, 0.41, 0.43), 0.4)
    bank = torch.tensor([-1.8, -0.45, -2.6])
    return [
        Part(share=19, draw=coated(ground(_flat, core=4.5, radius=70.0), floor, Finish())),
        Part(share=8, draw=coated(wall(corner, (reach, corner[1]), 1.5), masonry(dice), Finish())),
        Part(share=6, draw=coated(wall(corner, (corner[0], 2.2), 1.5), masonry(dice), Finish())),
        *exhibits(dice, places, 36),
        Part(share=4, draw=rods(rails, steel, 0.4)),
        Part(share=1.5, draw=rods(lines, steel, 0.3)),
        *trees(dice, (-3.0, -2.9), 3.8, 9),
        Part(share=6, draw=_lawn(dice, (4.8, 8.0), 0.2)),
        Part(share=5, draw=haze(bank, torch.tensor([1.6, 0.35, 1.0]), 0.5, (0.8, 0.82, 0.86))),
        Part(share=0.5, draw=floaters(torch.zeros(3), 3.0)),
        sky(dice, 60.0, 3.5),
    ]


def single_object(dice: Dice) -> list[Part]:
    """Lay out one big thing without surroundings."""
    gloss = dice.between(0.0, 0.9)
    models: list[Callable[[], Surface]] = [
        lambda: sphere(1.0),
        lambda: placed(torus(1.0, dice.between(0.25, 0.45)), torch.zeros(3), tilted(1.1)),
        lambda: revolution(vase_profile(dice, 2.2)),
        lambda: box((1.4, dice.between(1.0, 1.9), 1.4)),
        lambda: revolution(column_profile(0.45, 2.4)),
    ]
    surface = models[dice.order(len(models))[0]]()
    ring = torus(dice.between(1.15, 1.35), dice.between(0.05, 0.12))
    parts = [
        Part(share=70, draw=coated(surface, dice.pattern(dice.between(0.1, 0.3)), Finish(gloss=gloss))),
        Part(share=14, draw=coated(standing(ring, (0.0, 0.0), 0.1), dice.pattern(0.1), Finish(gloss=0.6))),
        Part(share=15, draw=coated(standing(revolution(column_profile(0.9, 0.3)), (0, 0), -0.3),
            dice.stone(dice.hue(0.2, 0.7), 1.5), Finish())),
        Part(share=1, draw=floaters(torch.zeros(3), 1.0)),
    ]  # fmt: skip
    return parts


def room(dice: Dice) -> list[Part]:
    """Lay out a furnished room around the origin."""
    width, depth, height = dice.between(4.5, 6.5), dice.between(4, 5.5), dice.between(2.5, 2.9)
    low = torch.tensor([[-0.5 * width, -height, -0.5 * depth]])
    size = torch.tensor([[width, height, depth]])
    paper = dice.pattern(dice.between(0.15, 0.35)) if dice.between(0, 1) < 0.5 else dice.stone(
        dice.hue(0.25, 0.85), 2.0)
    planks = bricks(dice.stone((0.6, 0.42, 0.26), 1.0), plain((0.2, 0.13, 0.08)), 0.14)
    back, side = -0.5 * depth, 0.5 * width
    seats = list(dice.spots(4, (0.9, 1.2)))
    shine = Finish(lit=False, gloss=0.25)
    flat = Finish(lit=False)
    wood = dice.stone(dice.near((0.5, 0.33, 0.2)), 0.8)
    turn = dice.between(-0.3, 0.3)
    books, colors = _books(dice, side - 0.35)
    return [
        Part(share=22, draw=coated(_inside(low, size), paper, flat)),
        Part(share=11, draw=coated(_level(low, size, 0.0), planks, shine)),
        Part(share=5, draw=coated(_level(low, size, height), plain(dice.near((0.9, 0.89, 0.86))), flat)),
        Part(share=8, draw=coated(standing(_table(1.5, 0.9, 0.75), (0, 0), turn=turn), wood, Finish(gloss=0.2))),
        *(Part(share=3, draw=coated(standing(_table(0.42, 0.42, 0.45), at, turn=turn), wood, Finish())) for at in seats),
        Part(share=9, draw=coated(standing(revolution(vase_profile(dice, 0.6)), (0.2, 0.1), 0.75), dice.pattern(0.05), Finish(gloss=0.8))),
        Part(share=4, draw=coated(standing(sphere(0.12), (-0.4, -0.1), 0.87), dice.pattern(0.05), Finish(gloss=0.9))),
        Part(share=13, draw=coated(books, patches(colors), Finish())),
        Part(share=6, draw=coated(standing(screen(1.4, 1.0), (0.3, back + 0.03), 1.1, math.pi), poster(dice, 0.2), flat)),
        Part(share=3, draw=coated(standing(screen(1.3, 1.2), (-0.5 * width + 0.03, 0.2), 1.0, -0.5 * math.pi), _window(dice), flat)),
        Part(share=1.5, draw=rods(wire(torch.tensor([0, -height, 0]), torch.tensor([0, -1.9, 0]), 0.0), plain((0.1, 0.1, 0.1)), 0.0)),
        Part(share=2.5, draw=coated(standing(sphere(0.2), (0, 0), 1.8), plain((1.0, 0.95, 0.8)), flat)),
        Part(share=1, draw=floaters(torch.tensor([0.0, -0.8, 0.0]), 0.9)),
    ]  # fmt: skip


def landscape(dice: Dice) -> list[Part]:
    """Lay out hills, a tower, trees and a far sky."""
    hills = noise(60.0, 0.22, dice.generator)
    relief = dice.between(4.0, 9.0)

    def heights(flat: torch.Tensor) -> torch.Tensor:
        away = (torch.linalg.vector_norm(flat, dim=1) / 12.0).clamp(0, 1)
        return relief * (hills(flat + 17.0) - 0.45) * away * away

    land = blend(_meadow(dice), dice.stone((0.55, 0.48, 0.4), 6.0), noise(40.0, 0.5, dice.generator))
    places = list(dice.spots(5, (3.5, 7.0)))
    feet = torch.tensor(places)
    levels = heights(feet)
    tower = revolution(column_profile(0.9, dice.between(4.0, 7.0)))
    return [
        Part(share=40, draw=coated(ground(heights, core=6.0, radius=150.0), land, Finish())),
        Part(share=14, draw=coated(standing(tower, (0, 0)), masonry(dice), Finish())),
        *(part for place, level in zip(places, levels.tolist(), strict=True)
          for part in trees(dice, place, dice.between(2.5, 4.5), 5)),
        Part(share=12, draw=_lawn(dice, (1.5, 6.0), 0.25)),
        Part(share=1, draw=floaters(torch.zeros(3), 8.0)),
        sky(dice, 140.0, 6),
    ]  # fmt: skip


def hazy(dice: Dice) -> list[Part]:
    """Lay out a scene of which nine tenths are faint."""
    faint = Finish(overlap=2.6, faintness=4.2, gloss=0.1)
    places = list(dice.spots(4, (1.0, 2.0)))
    bank = torch.tensor([1.5, 0.5, 1.5])
    return [
        Part(share=30, draw=coated(ground(_flat, core=2.5, radius=8.0), dice.pattern(0.4), faint)),
        *(Part(share=8, draw=coated(standing(revolution(column_profile(0.3, dice.between(1, 3))), at), dice.pattern(0.15), faint)) for at in places),
        *exhibits(dice, list(dice.spots(2, (0.3, 0.7))), 7),
        Part(share=35, draw=haze(torch.tensor([0.0, -0.7, 0.0]), bank, dice.between(0.6, 1.2), dice.near((0.75, 0.77, 0.8)))),
        Part(share=1, draw=floaters(torch.zeros(3), 2.0)),
    ]  # fmt: skip


def thin(dice: Dice) -> list[Part]:
    """Lay out rails, wires, trees and grass."""
    steel = dice.clouds((0.15, 0.16, 0.2), dice.hue(0.4, 0.6), 0.4)
    rails = []
    for k in range(5):
        start = torch.tensor([dice.between(-2, -1), 0.0, -2.0 + k])
        rails.append(railing(start, torch.tensor([dice.between(2, 3.5), 0, dice.between(-0.6, 0.6)]), dice.between(0.6, 1.2)))
    feet = torch.tensor([[x, 0.0, z] for x, z in dice.spots(4, (2.2, 3.0))])
    tops = feet - torch.tensor([0.0, dice.between(2.2, 3.2), 0.0])
    drop = torch.tensor([0.0, 0.15, 0.0])
    wires = [wire(tops[i] + k * drop, tops[j] + k * drop, dice.between(0.1, 0.6))
             for i in range(4) for j in range(i) for k in range(3)]  # fmt: skip
    return [
        Part(share=22, draw=rods(joined(*rails), steel, 0.5)),
        Part(share=12, draw=rods(joined(*wires), steel, 0.2)),
        Part(share=4, draw=rods(Strands(starts=feet, ends=tops, radii=torch.full((4,), 0.05)), steel, 0.3)),
        *(part for place in dice.spots(3, (1.0, 1.8)) for part in trees(dice, place, dice.between(1.8, 3.0), 11)),
        Part(share=14, draw=_lawn(dice, (0.2, 3.0), 0.25)),
        Part(share=14, draw=coated(ground(_flat, core=2.5, radius=4.0), _meadow(dice), Finish())),
        Part(share=1, draw=floaters(torch.zeros(3), 2.5)),
    ]  # fmt: skip


LAYOUTS: Mapping[str, Callable[[Dice], list[Part]]] = MappingProxyType(
    {
        "object": single_object,
        "room": room,
        "landscape": landscape,
        "haze": hazy,
        "thin": thin,
        "courtyard": courtyard,
    }
)
"""The layout of every kind."""


def _flat(flat: torch.Tensor) -> torch.Tensor:
    return torch.zeros(len(flat))


def _meadow(dice: Dice) -> Texture:
    return dice.clouds(dice.near((0.2, 0.3, 0.1)), dice.near((0.45, 0.5, 0.22)), 5.0)


def _lawn(dice: Dice, ring: tuple[float, float], height: float):
    angle = 2 * math.pi * torch.rand(900, generator=dice.generator)
    radius = ring[0] + (ring[1] - ring[0]) * torch.rand(900, generator=dice.generator).square()
    roots = torch.stack([radius * angle.cos(), 0 * radius, radius * angle.sin()], dim=1)
    foot, tip = plain(dice.near((0.16, 0.26, 0.07))), plain(dice.near((0.55, 0.62, 0.25)))
    return grass(roots, height, (foot, tip))


def _inside(low, size):
    full = boxes(low, size)

    def sample(square):
        from dataclasses import replace
        at = full(square)
        return replace(at, normals=-at.normals)
    return sample


def _level(low, size, height):
    width, depth = float(size[0, 0]), float(size[0, 2])
    up = 1 if height == 0 else -1
    corner = torch.tensor([[-0.5 * width, -height, -0.5 * depth]])
    sides = torch.tensor([[[0, 0, depth], [width, 0, 0]]])
    if height == 0.0:
        sides = sides.flip(1)
    return quads(corner, sides)


def _table(w, d, h):
    lows, sizes = [[-w/2, -h, -d/2]], [[w, 0.05, d]]
    for x in (-1, 1):
        for z in (-1, 1):
            lows.append([x*(w/2-.05)-.025, -h+.05, z*(d/2-.05)-.025]); sizes.append([.05, h-.05, .05])
    return boxes(torch.tensor(lows), torch.tensor(sizes))


def _books(dice, x):
    lows, sizes, colors = [], [], []
    for shelf in range(4):
        z = -1.2
        y = -0.45 * shelf - 0.1
        lows.append([x, y, -1.25]); sizes.append([.3, .03, 2.5]); colors.append((.4, .28, .18))
        while z < 1.1:
            t, h = dice.between(.02, .06), dice.between(.2, .36)
            lows.append([x + dice.between(0, .06), y - h, z]); sizes.append([.2, h, t]); colors.append(dice.hue(.6, .6))
            z += t + .004
    return boxes(torch.tensor(lows), torch.tensor(sizes)), torch.tensor(colors)


def _window(dice):
    return blend(plain((.3, .3, .3)), dice.clouds((.6, .75, .95), (1., 1., 1.), 1.0), lambda c: ((c / 0.4).remainder(1.0) > 0.08).all(1).float())
