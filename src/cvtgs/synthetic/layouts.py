"""What is in a scene of each kind, and where."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import torch

from cvtgs.synthetic.assemble import Part
from cvtgs.synthetic.dice import Dice
from cvtgs.synthetic.indoors import room
from cvtgs.synthetic.outdoors import courtyard, landscape, level, thin_structures
from cvtgs.synthetic.shapes import box, column_profile, disc_profile, lifted, standing
from cvtgs.synthetic.splats import Finish
from cvtgs.synthetic.surfaces import ground, revolution, sphere, torus
from cvtgs.synthetic.things import covered, exhibits, vase
from cvtgs.synthetic.volumes import floaters, haze


def single_object(dice: Dice) -> list[Part]:
    """Lay out one thing with an ornament on a plate, without surroundings."""
    body = [
        lifted(sphere(0.8), 0.8),
        lifted(torus(0.75, dice.between(0.2, 0.35)), 1.05, dice.between(1.0, 1.57)),
        vase(dice, dice.between(1.6, 2.1)),
        box(1.2, dice.between(0.9, 1.6), 1.2),
        revolution(column_profile(0.4, dice.between(1.5, 2.0))),
    ][dice.order(5)[0]]
    ring = lifted(torus(dice.between(0.95, 1.05), dice.between(0.05, 0.1)), 0.15)
    ball = standing(sphere(0.22), dice.spots(1, (0.9, 1.0))[0], height=0.4)
    turn = dice.between(0.0, 6.28)
    patterns = dice.order(60)[0]
    gloss = Finish(gloss=dice.between(0.0, 0.8))
    plate = revolution(disc_profile(1.2, 0.12))
    return [
        covered(
            standing(body, (0.0, 0.0), turn=turn),
            dice.pattern(dice.between(0.1, 0.25), patterns), share=65, finish=gloss,
        ),
        covered(ring, dice.pattern(0.1, patterns + 1), share=12, finish=Finish(gloss=0.5)),
        covered(ball, dice.pattern(0.06, patterns + 2), share=6, finish=Finish(gloss=0.7)),
        covered(lifted(plate, -0.12), dice.stone(dice.hue(0.2, 0.75), 1.5), share=16),
        Part(share=0.5, draw=floaters(torch.zeros(3), 1.0)),
    ]  # fmt: skip


def hazy(dice: Dice) -> list[Part]:
    """Lay out a scene that is faint for the most part, as some trained scenes are."""
    faint = Finish(overlap=2.6, faintness=3.2, gloss=0.1)
    columns = [
        covered(
            standing(revolution(column_profile(0.3, dice.between(1.0, 3.0))), place),
            dice.pattern(0.2), share=9, finish=faint,
        )
        for place in dice.spots(4, (1.2, 2.0))
    ]  # fmt: skip
    bank = torch.tensor([1.6, 0.5, 1.6])
    mist = haze(
        torch.tensor([0.0, -0.7, 0.0]), bank, dice.between(0.6, 1.2), dice.near((0.75, 0.77, 0.8))
    )
    return [
        covered(ground(level, core=2.5, radius=6.0), dice.pattern(0.4), share=24, finish=faint),
        *columns,
        *exhibits(dice, dice.spots(2, (0.5, 0.8)), share=4, pedestal=0.4),
        Part(share=35, draw=mist),
        Part(share=0.5, draw=floaters(torch.zeros(3), 2.0)),
    ]


LAYOUTS: Mapping[str, Callable[[Dice], list[Part]]] = MappingProxyType(
    {
        "object": single_object,
        "room": room,
        "landscape": landscape,
        "haze": hazy,
        "thin": thin_structures,
        "courtyard": courtyard,
    }
)
"""The layout of every kind."""
