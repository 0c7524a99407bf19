"""The layout of a furnished room, seen from inside."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.synthetic.assemble import Part
from cvtgs.synthetic.dice import Dice
from cvtgs.synthetic.shapes import lifted, screen, standing
from cvtgs.synthetic.splats import Finish
from cvtgs.synthetic.surfaces import Surface, boxes, quads, sphere
from cvtgs.synthetic.textures import Texture, blend, bricks, patches, plain
from cvtgs.synthetic.thin import rods, wire
from cvtgs.synthetic.things import GLOWING, covered, poster, vase
from cvtgs.synthetic.volumes import floaters


def room(dice: Dice) -> list[Part]:
    """Lay out a furnished room around the origin."""
    width, height, depth = dice.between(4.5, 6.5), dice.between(2.5, 2.9), dice.between(4.0, 5.5)
    paper = dice.stone(dice.hue(0.25, 0.85), 2.0)
    if dice.between(0, 1) < 0.6:
        dado = dice.pattern(dice.between(0.15, 0.3))
        paper = blend(paper, dado, lambda coords: (coords[:, 1] > 1.4).float())
    planks = bricks(dice.stone(dice.near((0.6, 0.42, 0.26)), 1.0), plain((0.2, 0.13, 0.08)), 0.14)
    ceiling = plain(dice.near((0.9, 0.89, 0.86)))
    image = standing(screen(1.4, 1.0), (0.3, 0.5 * depth - 0.03), height=1.1)
    window = standing(
        screen(1.4, 1.2), (-0.5 * width + 0.03, 0.2), height=0.95, turn=-0.5 * math.pi
    )
    sides, floor, top = _inside(width, height, depth)
    return [
        covered(sides, paper, share=22, finish=GLOWING),
        covered(floor, planks, share=11, finish=Finish(lit=False, gloss=0.2)),
        covered(top, ceiling, share=4, finish=GLOWING),
        covered(image, poster(dice, 0.2), share=6, finish=GLOWING),
        covered(window, _panes(dice), share=4, finish=GLOWING),
        *_furniture(dice),
        *_shelves(dice, 0.5 * width - 0.32),
        Part(share=0.5, draw=floaters(torch.tensor([0.0, -0.8, 0.0]), 0.8)),
    ]


def _furniture(dice: Dice) -> list[Part]:
    """Put a table with a vase and a ball, stools and a lamp in the middle."""
    wood = dice.stone(dice.near((0.55, 0.37, 0.23)), 0.8)
    turn = dice.between(-0.3, 0.3)
    cord = wire(torch.tensor([0.0, -2.5, 0.0]), torch.tensor([0.0, -1.95, 0.0]), 0.0)
    shiny = Finish(gloss=0.7)
    return [
        covered(
            standing(_table(1.5, 0.75, 0.9), (0, 0), turn=turn),
            wood, share=8, finish=Finish(gloss=0.15),
        ),
        *(
            covered(standing(_table(0.42, 0.45, 0.42), place, turn=turn), wood, share=2.5)
            for place in dice.spots(4, (0.95, 1.25))
        ),
        covered(
            standing(vase(dice, dice.between(0.4, 0.6)), (0.25, 0.1), height=0.75),
            dice.pattern(0.05), share=9, finish=shiny,
        ),
        covered(
            standing(sphere(0.13), (-0.4, -0.1), height=0.88),
            dice.pattern(0.05), share=4, finish=shiny,
        ),
        Part(share=0.5, draw=rods(cord, plain((0.1, 0.1, 0.1)), 0.0)),
        covered(lifted(sphere(0.17), 1.85), plain((1.0, 0.95, 0.8)), share=1.5, finish=GLOWING),
    ]  # fmt: skip


def _shelves(dice: Dice, left: float) -> list[Part]:
    """Fill four shelves along a wall with books of every colour."""
    lows, sizes, colors = [], [], []
    for shelf in range(4):
        level, along = -0.25 - 0.46 * shelf, -1.2
        lows.append((left, level, -1.25))
        sizes.append((0.3, 0.03, 2.5))
        colors.append((0.42, 0.29, 0.18))
        while along < 1.15:
            thickness, height = dice.between(0.03, 0.08), dice.between(0.22, 0.38)
            lows.append((left + dice.between(0.0, 0.06), level - height, along))
            sizes.append((0.2, height, thickness))
            colors.append(dice.hue(0.6, 0.65))
            along += thickness + 0.004
    texture = patches(torch.tensor(colors))
    return [covered(boxes(torch.tensor(lows), torch.tensor(sizes)), texture, share=14)]


def _inside(width: float, height: float, depth: float) -> tuple[Surface, Surface, Surface]:
    """Make walls, floor and ceiling, seen from inside."""
    across, away = torch.tensor([width, 0.0, 0.0]), torch.tensor([0.0, 0.0, depth])
    down = torch.tensor([0.0, height, 0.0])
    left_back = -0.5 * across - 0.5 * away - down
    corners = [left_back + away, left_back + across, left_back, left_back + across + away]
    rights = [across, -across, away, -away]
    walls = quads(
        torch.stack(corners), torch.stack([torch.stack([right, down]) for right in rights])
    )
    floor = quads((left_back + down + away)[None], torch.stack([across, -away])[None])
    ceiling = quads(left_back[None], torch.stack([across, away])[None])
    return walls, floor, ceiling


def _table(width: float, height: float, depth: float) -> Surface:
    """Make a board on four legs."""
    legs = torch.tensor([(x, z) for x in (-0.5, 0.5) for z in (-0.5, 0.5)])
    feet = legs * (torch.tensor([width, depth]) - 0.1) - 0.025
    lows = torch.stack([feet[:, 0], torch.full((4,), 0.05 - height), feet[:, 1]], dim=1)
    board = torch.tensor([[-0.5 * width, -height, -0.5 * depth]])
    sizes = torch.tensor([[width, 0.05, depth]] + [[0.05, height - 0.05, 0.05]] * 4)
    return boxes(torch.cat([board, lows]), sizes)


def _panes(dice: Dice) -> Texture:
    """Show clouds through a window with bars."""

    def open_(coords: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        return ((coords / 0.4).remainder(1.0) > 0.1).all(dim=1).float()

    return blend(plain((0.3, 0.28, 0.26)), dice.clouds((0.6, 0.75, 0.95), (1, 1, 1), 2.0), open_)
