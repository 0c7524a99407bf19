"""Put an object into rooms and under skies of few large Gaussians, far away.

``python -m benchmarks.surroundings FOLDER --object OBJECT.ply`` writes one scene per kind of
surroundings, ``KIND-OBJECT.ply``, with cameras around the object and looking outward; without
``--object``, around a generated vase. All are y-down, and the object has a robust radius of 1.
Captures cover what stands near with many small Gaussians, and walls, skies and haze with a few
large ones: in ``faces6``, six Gaussians cover most of every image.
"""

import argparse
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import cvtgs
from benchmarks.cameras import beside_format, cameras_file, looking
from benchmarks.placed import UP, upright, without_tag
from benchmarks.yards import Array, Part, joined_parts, turned_to, unit
from cvtgs import edit, synthetic
from cvtgs.cameras import Cameras
from cvtgs.scene import GaussianScene
from cvtgs.validity import valid_part

OBJECT = 40_000
"""Number of Gaussians of the object, at most."""

FLOOR = 0.9
"""Height of ground and floors, downward, in radii of the object."""

SIDE = 256  # of images, in pixels

SKY_COLOR = np.array([0.4, 0.6, 0.9])
WALL_COLORS = (
    (0.8, 0.75, 0.65), (0.7, 0.75, 0.8), (0.82, 0.8, 0.78),
    (0.8, 0.6, 0.5), (0.45, 0.3, 0.2), (0.95, 0.95, 0.95),
)  # fmt: skip
"""Of the walls at +z, -z, +x and -x, the floor and the ceiling of a room."""

Random = np.random.Generator


class Face(NamedTuple):
    """A rectangle; ``across`` and ``up`` are half of its sides."""

    middle: Array
    across: Array
    up: Array


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder to write to")
    parser.add_argument("--object", type=Path, help="a scene; default: a generated vase")
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=list(KINDS))
    options = parser.parse_args(arguments)
    thing, name = synthetic.scene("object", OBJECT, sh_degree=0), "vase"
    if options.object:
        thing, name = cvtgs.load(options.object), options.object.stem
    options.folder.mkdir(parents=True, exist_ok=True)
    for kind in options.kind:
        path = options.folder / f"{kind}-{name}.ply"
        cvtgs.save(scene_of(kind, thing), path, overwrite=True)
        cameras_file(path).write_text(json.dumps(beside_format(cameras(kind))), encoding="utf-8")
        print(path)


def scene_of(kind: str, thing: GaussianScene) -> GaussianScene:
    """Put an object into surroundings of a kind."""
    around = joined_parts(KINDS[kind](np.random.default_rng(7)))
    center = upright(middle_of(valid_part(thing), OBJECT), radius=1.0, level=0.98)
    center = edit.move(center, edit.Motion(shift=(0.0, FLOOR, 0.0)))
    return edit.concatenate([without_tag(center), around], fill=True)


def middle_of(scene: GaussianScene, count: int) -> GaussianScene:
    """Return the Gaussians that lie nearest to the median of all."""
    away = (scene.means - scene.means.median(dim=0).values).norm(dim=1)
    return scene.select(away.argsort(stable=True)[:count].sort().values)


def cameras(kind: str) -> Cameras:
    """Return cameras around the object and others that look outward; in a street, along it."""
    if kind == "street":
        eyes = np.array([(0.5, 0.2, -20), (-1, 0.2, -5), (0, 0.2, 20), (2, 0.2, 5)])
        targets = np.array([(0, -1, 0), (1, -1.5, 10), (0, -1, 0), (-4, -2, 9)])
    else:
        turns = np.radians([10, 130, 250, 30, 150, 270])
        away, heights = np.repeat([2.85, 2.0], 3), np.repeat([-0.65, -0.2], 3)
        eyes = np.stack([away * np.cos(turns), heights, away * np.sin(turns)], axis=1)
        outward = eyes[3:] * 5 + [0, -2, 0]
        targets = np.concatenate([np.broadcast_to([0, -0.15, 0], (3, 3)), outward])
    points = (torch.tensor(rows).double() for rows in (eyes, targets, UP))
    return looking(*points, size=(SIDE, SIDE))


def sky(rng: Random, count: int, *, away: float) -> Part:
    """Cover a sphere of a radius with Gaussians."""
    ways = unit(rng.normal(size=(count, 3)))
    size = away * math.sqrt(4 * math.pi / count) * 0.6 * np.exp(rng.normal(0, 0.2, (count, 3)))
    opacities = 1 / (1 + np.exp(-rng.normal(2, 0.5, count)))
    colors = SKY_COLOR + ways[:, 1:2] * [0.3, 0.2, 0] + rng.normal(0, 0.03, (count, 3))
    means = ways * away * rng.uniform(1, 1.1, (count, 1))
    return Part(means, size, unit(rng.normal(size=(count, 4))), opacities, colors)


def ground(rng: Random, count: int, *, radius: float) -> Part:
    """Cover a disc with thin Gaussians that grow with the distance from its middle."""
    away = radius * rng.uniform(0, 1, count)
    turns = rng.uniform(0, 2 * np.pi, count)
    x, z = away * np.cos(turns), away * np.sin(turns)
    size = np.clip(0.7 * np.sqrt(2 * np.pi * radius * away / count), 0.002 * radius, 0.2 * radius)
    waves = (np.sin(3 * x) + np.sin(4 * z) + np.sin(9 * (x + z))) / 6
    colors = np.array([0.45, 0.42, 0.3]) + waves[:, None] * [1, 0.8, 0.5]
    return Part(
        np.stack([x, FLOOR + rng.normal(0, 0.01, count), z], axis=1),
        size[:, None] * [1, 1, 0.05],
        turned_to(np.broadcast_to([0, -1.0, 0], (count, 3))),
        1 / (1 + np.exp(-rng.normal(2.5, 1, count))),
        colors + rng.normal(0, 0.05, (count, 3)),
    )


def wall(
    rng: Random, side: int, face: Face, *, color: Array | Sequence[float],
    texture: float = 0.02, opacity: float = 0.98, window: bool = False,
) -> Part:  # fmt: skip
    """Cover a rectangle with ``side`` times ``side`` thin Gaussians; the window is a hole in it."""
    steps = (np.arange(side) + 0.5) / side * 2 - 1
    u, v = (values.ravel() for values in np.meshgrid(steps, steps))
    if window:
        solid = (np.abs(u) > 0.4) | (np.abs(v + 0.2) > 0.3)
        u, v = u[solid], v[solid]
    half = np.array([np.linalg.norm(face.across), np.linalg.norm(face.up)])
    x, y = face.across / half[0], face.up / half[1]
    turn = Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=1)).as_quat()[[3, 0, 1, 2]]
    scales = np.array([*half * 1.1, min(half) * 0.02]) / side
    shade = 1 + texture * rng.normal(size=(len(u), 1))
    return Part(
        face.middle + u[:, None] * face.across + v[:, None] * face.up,
        np.broadcast_to(scales, (len(u), 3)),
        np.broadcast_to(turn, (len(u), 4)),
        np.full(len(u), opacity),
        np.array(color) * shade + rng.normal(0, 0.02, (len(u), 3)),
    )


def room(
    rng: Random, side: int, *, half: float, height: float, texture: float = 0.02,
    windows: bool = False,
) -> list[Part]:  # fmt: skip
    """Cover four walls, the floor and the ceiling; ``half`` a side, ``height`` half as well."""
    middle = np.array([0, FLOOR - height, 0.0])
    x, y, z = np.diag([half, height, half]).astype(float)
    faces = [(z, x, y), (-z, x, y), (x, z, y), (-x, z, y), (y, x, z), (-y, x, z)]
    return [
        wall(
            rng, side, Face(middle + away, across, up), color=color,
            texture=texture, window=windows and number in (0, 2),
        )
        for number, ((away, across, up), color) in enumerate(zip(faces, WALL_COLORS, strict=True))
    ]  # fmt: skip


def glass(rng: Random) -> list[Part]:
    """Put five clear panes around the object."""
    panes = []
    for turn in np.radians([10, 82, 155, 226, 298]):
        x, z = math.cos(turn), math.sin(turn)
        middle, across = np.array([1.6 * x, -0.2, 1.6 * z]), 1.2 * np.array([-z, 0, x])
        face = Face(middle, across, np.array([0, 1.2, 0]))
        panes.append(wall(rng, 3, face, color=(0.6, 0.8, 0.85), opacity=0.15))
    return panes


def haze(rng: Random, count: int, *, half: float) -> Part:
    """Fill a cube with large faint Gaussians of one colour."""
    means = rng.uniform(-half, half, (count, 3))
    means[:, 1] = np.minimum(means[:, 1], FLOOR - 0.1)
    scales = 0.4 * np.exp(rng.normal(0, 0.5, (count, 3)))
    colors = np.array([0.75, 0.78, 0.82]) + rng.normal(0, 0.05, (count, 3))
    quats = unit(rng.normal(size=(count, 4)))
    return Part(means, scales, quats, 0.02 * rng.uniform(0.3, 1.7, count), colors)


def street(rng: Random) -> list[Part]:
    """Build two rows of houses with windows, 3,600 Gaussians a house."""
    houses = []
    for x in (-5.0, 5.0):
        for z in np.arange(-28, 29, 8.0):
            up = np.array([0, rng.uniform(3, 7), 0])
            face = Face(np.array([x, FLOOR - up[1], z]), np.array([0, 0, 3.9]), up)
            house = wall(rng, 60, face, color=rng.uniform(0.3, 0.8, 3), opacity=0.95)
            is_window = (house.means[:, 2] % 1.3 < 0.6) & (house.means[:, 1] % 1.5 < 0.8)
            colors = np.where(is_window[:, None], [0.12, 0.15, 0.2], house.colors)
            houses.append(house._replace(colors=colors))
    return houses


KINDS: dict[str, Callable[[Random], list[Part]]] = {
    "sky200": lambda rng: [ground(rng, 8000, radius=6), sky(rng, 200, away=60)],
    "sky2000": lambda rng: [ground(rng, 5000, radius=15), sky(rng, 2000, away=30)],
    "sky20000": lambda rng: [ground(rng, 20_000, radius=20), sky(rng, 20_000, away=100)],
    "faces6": lambda rng: [ground(rng, 5000, radius=12), *room(rng, 1, half=50, height=50)],
    "faces600": lambda rng: [ground(rng, 5000, radius=12), *room(rng, 10, half=50, height=50)],
    "room280": lambda rng: [
        *room(rng, 7, half=4, height=2, windows=True), sky(rng, 300, away=40)
    ],
    "room9000": lambda rng: [
        *room(rng, 40, half=4, height=2, texture=0.08, windows=True), sky(rng, 300, away=40)
    ],
    "glass": lambda rng: [ground(rng, 5000, radius=8), *glass(rng), sky(rng, 300, away=50)],
    "haze": lambda rng: [
        haze(rng, 3000, half=3.5), ground(rng, 5000, radius=8), sky(rng, 300, away=50)
    ],
    "street": lambda rng: [
        *street(rng), ground(rng, 10_000, radius=30), sky(rng, 100, away=150)
    ],
}  # fmt: skip
"""Parts around the object, for a random generator."""


if __name__ == "__main__":
    main()
