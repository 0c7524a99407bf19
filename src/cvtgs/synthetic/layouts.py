"""The objects in a scene of each kind, and their positions."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.synthetic import surfaces, textures, thin_structures
from cvtgs.synthetic.gaussians import Draw, Material, cover_surface, floaters, haze
from cvtgs.synthetic.surfaces import Surface, boxes, ground, placed, sphere, torus
from cvtgs.synthetic.textures import Random, Texture, blend, plain
from cvtgs.synthetic.thin_structures import Strands, joined, railing, rods, wire

_MATTE = Material()
_UNLIT = Material(lit=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """An object in a scene, and its share of the Gaussians, relative to the other parts."""

    share: float
    draw: Draw


def single_object(rng: Random) -> list[Part]:
    """Lay out one object with an ornament on a plate, without surroundings."""
    body = [
        placed(sphere(0.8), height=0.8),
        placed(torus(0.75, rng.uniform(0.2, 0.35)), height=1.05, tilt=rng.uniform(1.0, 1.57)),
        _vase(rng, rng.uniform(1.6, 2.1)),
        surfaces.box(1.2, rng.uniform(0.9, 1.6), 1.2),
        surfaces.column(0.4, rng.uniform(1.5, 2.0)),
    ][rng.permutation(5)[0]]
    ring = placed(torus(rng.uniform(0.95, 1.05), rng.uniform(0.05, 0.1)), height=0.15)
    ball = placed(sphere(0.22), rng.ring_positions(1, (0.9, 1.0))[0], height=0.4)
    turn = rng.uniform(0.0, 6.28)
    patterns = rng.permutation(60)[0]
    glossy = Material(specular=rng.uniform(0.0, 0.8))
    plate = placed(surfaces.disc(1.2, 0.12), height=-0.12)
    return [
        _covered(
            placed(body, turn=turn), rng.pattern(rng.uniform(0.1, 0.25), patterns), 65, glossy
        ),
        _covered(ring, rng.pattern(0.1, patterns + 1), 12, Material(specular=0.5)),
        _covered(ball, rng.pattern(0.06, patterns + 2), 6, Material(specular=0.7)),
        _covered(plate, rng.stone(rng.color(0.2, 0.75), 1.5), 16),
        Part(share=0.5, draw=floaters(torch.zeros(3), 1.0)),
    ]


def room(rng: Random) -> list[Part]:
    """Lay out a furnished room around the origin, seen from inside."""
    width, height, depth = rng.uniform(4.5, 6.5), rng.uniform(2.5, 2.9), rng.uniform(4.0, 5.5)
    paper = rng.stone(rng.color(0.25, 0.85), 2.0)
    if rng.uniform(0, 1) < 0.6:
        dado = rng.pattern(rng.uniform(0.15, 0.3))
        paper = blend(paper, dado, lambda coords: (coords[:, 1] > 1.4).float())
    wood = rng.stone(rng.similar((0.6, 0.42, 0.26)), 1.0)
    planks = textures.bricks(wood, plain((0.2, 0.13, 0.08)), 0.14)
    white = plain(rng.similar((0.9, 0.89, 0.86)))
    poster = placed(surfaces.upright_rectangle(1.4, 1.0), (0.3, 0.5 * depth - 0.03), height=1.1)
    window = placed(
        surfaces.upright_rectangle(1.4, 1.2),
        (-0.5 * width + 0.03, 0.2), height=0.95, turn=-0.5 * math.pi,
    )  # fmt: skip
    walls, floor, ceiling = surfaces.room_shell(width, height, depth)
    return [
        _covered(walls, paper, 22, _UNLIT),
        _covered(floor, planks, 11, Material(lit=False, specular=0.2)),
        _covered(ceiling, white, 4, _UNLIT),
        _covered(poster, rng.poster(0.2), 6, _UNLIT),
        _covered(window, _window_panes(rng), 4, _UNLIT),
        *_furniture(rng),
        _bookshelves(rng, 0.5 * width - 0.32),
        Part(share=0.5, draw=floaters(torch.tensor([0.0, -0.8, 0.0]), 0.8)),
    ]


def landscape(rng: Random) -> list[Part]:
    """Lay out hills, a tower, trees and a far sky."""
    hills, relief = rng.noise(90.0, 0.2), rng.uniform(6.0, 14.0)

    def heights(flat: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        away = ((torch.linalg.vector_norm(flat, dim=1) - 5.0) / 25.0).clamp(0, 1)
        rise: Tensor = relief * (hills(flat) - 0.35) * away
        return rise

    land = blend(rng.meadow(), rng.stone((0.55, 0.48, 0.4), 6.0), rng.noise(40.0, 0.3))
    positions = rng.ring_positions(7, (3.0, 6.0))
    rises = heights(torch.tensor(positions)).tolist()
    tower = surfaces.column(1.1, rng.uniform(5.0, 7.0))
    return [
        _covered(ground(heights, core=6.0, radius=13.0), land, 18),
        _covered(ground(heights, core=13.0, radius=150.0, hole=12.0), land, 10),
        _covered(tower, rng.masonry(), 20),
        *(
            part
            for (x, z), rise in zip(positions, rises, strict=True)
            for part in _tree(rng, (x, -rise, z), height=rng.uniform(2.5, 4.5), share=5)
        ),
        Part(share=10, draw=_lawn(rng, (1.8, 7.0), 0.25)),
        Part(share=0.5, draw=floaters(torch.zeros(3), 6.0)),
        _sky(rng, rng.uniform(110.0, 160.0), 6),
    ]


def hazy(rng: Random) -> list[Part]:
    """Lay out a mostly faint scene, like some trained scenes."""
    faint = Material(overlap=2.6, faintness=3.2, specular=0.1)
    columns = [
        _covered(
            placed(surfaces.column(0.3, rng.uniform(1.0, 3.0)), position),
            rng.pattern(0.2), 9, faint,
        )
        for position in rng.ring_positions(4, (1.2, 2.0))
    ]  # fmt: skip
    mist = haze(
        torch.tensor([0.0, -0.7, 0.0]),
        torch.tensor([1.6, 0.5, 1.6]),
        rng.uniform(0.6, 1.2),
        rng.similar((0.75, 0.77, 0.8)),
    )
    return [
        _covered(ground(_level, core=2.5, radius=6.0), rng.pattern(0.4), 24, faint),
        *columns,
        *_objects_on_pedestals(rng, rng.ring_positions(2, (0.5, 0.8)), share=4, pedestal=0.4),
        Part(share=35, draw=mist),
        Part(share=0.5, draw=floaters(torch.zeros(3), 2.0)),
    ]


def thin(rng: Random) -> list[Part]:
    """Lay out rails, wires, trees and grass."""
    paint = rng.clouds(rng.color(0.4, 0.25), rng.color(0.4, 0.5), 0.9)
    rails = [
        railing(
            torch.tensor([rng.uniform(-2.2, -1.0), 0.0, row - 2.0]),
            torch.tensor([rng.uniform(2.0, 3.5), 0.0, rng.uniform(-0.6, 0.6)]),
            rng.uniform(0.6, 1.2),
        )
        for row in range(5)
    ]
    feet = torch.tensor([[x, 0.0, z] for x, z in rng.ring_positions(4, (2.2, 3.0))])
    tops = feet - torch.tensor([0.0, rng.uniform(2.2, 3.2), 0.0])
    drops = torch.tensor([0.0, 0.15, 0.0]) * torch.arange(3)[:, None]
    wires = [
        wire(tops[i] + drop, tops[j] + drop, rng.uniform(0.1, 0.6))
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
            for x, z in rng.ring_positions(3, (1.0, 1.8))
            for part in _tree(rng, (x, 0.0, z), height=rng.uniform(1.8, 3.0), share=10)
        ),
        Part(share=14, draw=_lawn(rng, (0.2, 3.0), 0.25)),
        _covered(ground(_level, core=9.0, radius=3.8), rng.meadow(), 14),
        Part(share=0.5, draw=floaters(torch.zeros(3), 2.5)),
    ]


def courtyard(rng: Random) -> list[Part]:
    """Lay out a paved yard with a bit of everything in it."""
    positions = rng.ring_positions(5, (1.5, 2.3))
    shadows = torch.tensor(positions) - torch.tensor([0.55, 0.5])
    paving = textures.round_shadows(rng.paving(), shadows, 0.75)
    meadow, masonry, corner = rng.meadow(), rng.masonry(), (-3.9, -3.9)
    return [
        _covered(ground(_level, core=20.0, radius=4.9), paving, 15),
        _covered(ground(_level, core=5.0, radius=70.0, hole=4.8), meadow, 6),
        _covered(surfaces.wall(corner, (3.9, -3.9), 1.5), masonry, 8),
        _covered(surfaces.wall(corner, (-3.9, 2.2), 1.5), masonry, 6),
        *_objects_on_pedestals(rng, positions, share=38, pedestal=0.5),
        *_fence(rng),
        *_tree(rng, (-2.7, 0.0, -2.7), height=3.6, share=9),
        Part(share=6, draw=_lawn(rng, (5.0, 8.0), 0.2)),
        _mist(rng),
        Part(share=0.5, draw=floaters(torch.zeros(3), 3.0)),
        _sky(rng, rng.uniform(50.0, 80.0), 3.5),
    ]


# Layout function of every kind of scene
LAYOUTS = {
    "object": single_object,
    "room": room,
    "landscape": landscape,
    "haze": hazy,
    "thin": thin,
    "courtyard": courtyard,
}


def _covered(surface: Surface, texture: Texture, share: float, material: Material = _MATTE) -> Part:
    return Part(share=share, draw=cover_surface(surface, texture, material))


def _level(flat: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
    return torch.zeros(len(flat))


def _vase(rng: Random, height: float) -> Surface:
    belly, neck, low = rng.uniform(0.28, 0.42), rng.uniform(0.07, 0.15), rng.uniform(0.25, 0.45)
    return surfaces.vase(height, belly=belly, neck=neck, low=low)


def _objects_on_pedestals(
    rng: Random, positions: list[tuple[float, float]], *, share: float, pedestal: float
) -> list[Part]:
    """Put textured objects on round and square pedestals."""
    size = [rng.uniform(0.42, 0.58) for _ in range(6)]
    edge, tilt = 1.5 * size[1], rng.uniform(0.7, 1.5)
    models = [
        (placed(sphere(size[0]), height=size[0]), 0.7),
        (surfaces.box(edge, edge, edge), 0.1),
        (placed(torus(size[2], 0.4 * size[2]), height=1.3 * size[2], tilt=tilt), 0.5),
        (_vase(rng, 2.6 * size[3]), 0.6),
        (surfaces.column(0.5 * size[4], 4.5 * size[4]), 0.0),
        (placed(sphere(size[5]), height=size[5]), 0.2),
    ]
    patterns = rng.permutation(60)
    parts = []
    order = rng.permutation(len(models))
    for row, (position, k) in enumerate(zip(positions, order, strict=False)):
        surface, specular = models[k]
        turn = rng.uniform(0, 2 * math.pi)
        each = share * rng.uniform(0.7, 1.3) / len(positions)
        texture = rng.pattern(rng.uniform(0.08, 0.14), patterns[0] + row)
        stand = surfaces.disc(0.62, pedestal) if row % 2 else surfaces.box(1.0, pedestal, 1.0)
        stone = rng.stone(rng.similar((0.75, 0.72, 0.66)), 1.0)
        surface = placed(surface, position, height=pedestal, turn=turn)
        parts += [
            _covered(surface, texture, 0.75 * each, Material(specular=specular)),
            _covered(placed(stand, position, turn=turn), stone, 0.25 * each),
        ]
    return parts


def _furniture(rng: Random) -> list[Part]:
    """Put a table with a vase and a ball, stools and a lamp in the middle of the room."""
    wood = rng.stone(rng.similar((0.55, 0.37, 0.23)), 0.8)
    turn = rng.uniform(-0.3, 0.3)
    cord = wire(torch.tensor([0.0, -2.5, 0.0]), torch.tensor([0.0, -1.95, 0.0]), 0.0)
    glossy = Material(specular=0.7)
    table, stool = surfaces.table(1.5, 0.75, 0.9), surfaces.table(0.42, 0.45, 0.42)
    stools = [
        _covered(placed(stool, position, turn=turn), wood, 2.5)
        for position in rng.ring_positions(4, (0.95, 1.25))
    ]
    vase = placed(_vase(rng, rng.uniform(0.4, 0.6)), (0.25, 0.1), height=0.75)
    ball = placed(sphere(0.13), (-0.4, -0.1), height=0.88)
    lamp = placed(sphere(0.17), height=1.85)
    return [
        _covered(placed(table, turn=turn), wood, 8, Material(specular=0.15)),
        *stools,
        _covered(vase, rng.pattern(0.05), 9, glossy),
        _covered(ball, rng.pattern(0.05), 4, glossy),
        Part(share=0.5, draw=rods(cord, plain((0.1, 0.1, 0.1)), 0.0)),
        _covered(lamp, plain((1.0, 0.95, 0.8)), 1.5, _UNLIT),
    ]


def _bookshelves(rng: Random, left: float) -> Part:
    """Fill four shelves along a wall with books of every colour."""
    lows, sizes, colors = [], [], []
    for shelf in range(4):
        level, along = -0.25 - 0.46 * shelf, -1.2
        lows.append((left, level, -1.25))
        sizes.append((0.3, 0.03, 2.5))
        colors.append((0.42, 0.29, 0.18))
        while along < 1.15:
            thickness, height = rng.uniform(0.03, 0.08), rng.uniform(0.22, 0.38)
            lows.append((left + rng.uniform(0.0, 0.06), level - height, along))
            sizes.append((0.2, height, thickness))
            colors.append(rng.color(0.6, 0.65))
            along += thickness + 0.004
    books = boxes(torch.tensor(lows), torch.tensor(sizes))
    return _covered(books, textures.color_per_box(torch.tensor(colors)), 14)


def _window_panes(rng: Random) -> Texture:
    """Show clouds through a window with bars."""
    bars, clouds = plain((0.3, 0.28, 0.26)), rng.clouds((0.6, 0.75, 0.95), (1, 1, 1), 2.0)
    return blend(bars, clouds, lambda c: ((c / 0.4).remainder(1.0) > 0.1).all(dim=1).float())


def _fence(rng: Random) -> list[Part]:
    """Close the open sides of the yard with railings, and hang wires across it."""
    rails = joined(
        railing(torch.tensor([3.9, 0, -3.6]), torch.tensor([0, 0, 7.4]), 1.0),
        railing(torch.tensor([-3.6, 0, 3.9]), torch.tensor([5.5, 0, 0]), 1.0),
    )
    feet = torch.tensor([[-3.9, 0.0, 3.6], [3.8, 0.0, -3.7]])
    tops = feet - torch.tensor([0.0, 3.4, 0.0])
    wires = [
        wire(tops[0] + drop, tops[1] + drop, rng.uniform(0.3, 0.6))
        for drop in torch.tensor([[0, 0.05, 0], [0, 0.3, 0], [0, 0.55, 0]])
    ]
    poles = Strands(starts=feet, ends=tops, radii=torch.tensor([0.06, 0.06]))
    steel = rng.clouds((0.2, 0.21, 0.23), (0.36, 0.37, 0.4), 2.0)
    return [
        Part(share=4.5, draw=rods(rails, steel, 0.3)),
        Part(share=0.7, draw=rods(poles, steel, 0.3)),
        Part(share=0.8, draw=rods(joined(*wires), plain((0.1, 0.1, 0.11)), 0.1)),
    ]


def _tree(
    rng: Random, position: tuple[float, float, float], *, height: float, share: float
) -> list[Part]:
    """Make the wood and the leaves of one tree."""
    strands, tips = thin_structures.tree(torch.tensor(position), height, rng.generator)
    bark = rng.clouds((0.22, 0.16, 0.11), rng.similar((0.46, 0.36, 0.27)), 0.5)
    crown = rng.clouds((0.16, 0.3, 0.08), rng.similar((0.36, 0.52, 0.16)), 0.2 * height)
    return [
        Part(share=0.3 * share, draw=rods(strands, bark, 0.0)),
        Part(share=0.7 * share, draw=thin_structures.leaves(tips, 0.045 * height, crown)),
    ]


def _lawn(rng: Random, ring: tuple[float, float], height: float) -> Draw:
    """Plant grass in a ring around the origin, densest inside."""
    angle, share = torch.rand(2, 900, generator=rng.generator).unbind()
    radius = ring[0] + (ring[1] - ring[0]) * share.square()
    x, z = radius * torch.cos(2 * math.pi * angle), radius * torch.sin(2 * math.pi * angle)
    dark, bright = plain(rng.similar((0.16, 0.26, 0.07))), plain(rng.similar((0.55, 0.62, 0.25)))
    roots = torch.stack([x, torch.zeros_like(x), z], dim=1)
    return thin_structures.grass(roots, height, (dark, bright))


def _mist(rng: Random) -> Part:
    """Put a bank of mist in the corner of the walls."""
    turn = rng.uniform(0, 1)
    center = torch.tensor([-2.0 + 1.5 * turn, -0.4, -0.5 - 1.5 * turn])
    extent = torch.tensor([1.8, 0.45, 1.5])
    color = rng.similar((0.8, 0.82, 0.86))
    return Part(share=5, draw=haze(center, extent, rng.uniform(0.5, 0.8), color))


def _sky(rng: Random, radius: float, share: float) -> Part:
    """Put a sky with clouds over the scene."""
    zenith, horizon = rng.similar((0.22, 0.42, 0.78)), rng.similar((0.78, 0.86, 0.93))
    blue = blend(
        plain(zenith),
        plain(horizon),
        lambda coords: (torch.linalg.vector_norm(coords, dim=1) / 1.55).clamp(0, 1) ** 1.6,
    )
    noise = rng.noise(6.0, 0.28)
    clouds = blend(blue, plain((0.97, 0.97, 0.98)), lambda c: (2.2 * noise(c) - 1.1).clamp(0, 1))
    material = Material(overlap=1.4, faintness=-1.5, thickness=0.5, lit=False)
    return _covered(surfaces.dome(radius, -0.08), clouds, share, material)
