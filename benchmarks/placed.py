"""Place captured objects on a piece of captured ground, under a generated sky, to train networks.

``python -m benchmarks.placed GROUND.ply OBJECT.ply ... -o FOLDER`` writes one scene per object,
``placed-OBJECT.ply``, with cameras of a walk around it. They are y-down like the yards
(:mod:`benchmarks.yards`), which lend far ground, trees, sky and floaters. Few captures that are
free to use are unbounded; these have captured surfaces before backgrounds that do not end.
"""

import argparse
import json
import random
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import cvtgs
from benchmarks.cameras import beside_format, cameras_file
from benchmarks.yards import cameras, far_surroundings
from cvtgs import edit
from cvtgs.scene import GaussianScene
from cvtgs.train.scenes import cut_block
from cvtgs.validity import valid_part
from cvtgs.views.layout import find_layout

GROUND, SURROUNDINGS = 120_000, 50_000
"""Number of Gaussians of the piece of ground, and roughly that of everything generated."""

GROUND_RADIUS, OBJECT_RADIUS = 1.4, 0.5
"""Robust radii of both; the yards have the same units."""

UP = (0.0, -1.0, 0.0)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ground", type=Path, help="a capture with open ground")
    parser.add_argument("objects", type=Path, nargs="+", help="captures of objects")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder to write to")
    options = parser.parse_args(arguments)
    ground = valid_part(cvtgs.load(options.ground))
    options.output.mkdir(parents=True, exist_ok=True)
    for seed, file in enumerate(options.objects):
        path = options.output / f"placed-{file.stem}.ply"
        cvtgs.save(placed(valid_part(cvtgs.load(file)), ground, seed=seed), path, overwrite=True)
        cameras_file(path).write_text(json.dumps(beside_format(cameras())), encoding="utf-8")
        print(path)


def placed(thing: GaussianScene, ground: GaussianScene, *, seed: int) -> GaussianScene:
    """Place an object on a piece of the ground, among generated surroundings."""
    piece = upright(
        cut_block(ground, random.Random(seed), count=GROUND), radius=GROUND_RADIUS, level=0.5
    )
    center = upright(thing, radius=OBJECT_RADIUS, level=0.98)
    rest = far_surroundings(SURROUNDINGS, from_radius=GROUND_RADIUS, seed=seed)
    return edit.concatenate([without_tag(scene) for scene in (center, piece, rest)], fill=True)


def without_tag(scene: GaussianScene) -> GaussianScene:
    """Return a scene without comments, since parts of a scene cannot differ in their tag."""
    return replace(scene, extras={}, comments=(), layout=())


def upright(scene: GaussianScene, *, radius: float, level: float) -> GaussianScene:
    """Rotate up to -y, scale to a robust radius, and move to the middle of the plane y = 0.

    ``level`` is the share of Gaussians that end up above the plane.
    """
    layout = find_layout(scene)
    turn, _ = Rotation.align_vectors([UP], layout.up.double()[None].numpy())  # the shortest
    x, y, z, w = turn.as_quat().tolist()
    motion = edit.Motion(quat=(w, x, y, z), scale=radius / float(layout.frame.radius))
    turned = edit.move(scene, motion)
    middle = turned.means.double().median(dim=0).values
    heights = turned.means[:, 1].double()
    lowest = float(np.quantile(heights.numpy(), level))
    shift = (-float(middle[0]), -lowest, -float(middle[2]))
    return edit.move(turned, edit.Motion(shift=shift))


if __name__ == "__main__":
    main()
