"""Is up found in files of other conventions?

``python -m benchmarks.upright FILES --up hexagon=+y`` turns every scene so that its up direction,
-y unless it is given by the name of the file, is -y, +y and +z of the file, and prints the angle
between that and what :func:`cvtgs.views.find_view_positions` takes as up, as Markdown.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import cvtgs
from cvtgs.edit import Motion, move
from cvtgs.views.layout import find_layout

AXES = {
    f"{sign}{name}": (1.0 if sign == "+" else -1.0) * np.eye(3)[row]
    for row, name in enumerate("xyz")
    for sign in "+-"
}
USUAL = ("-y", "+y", "+z")
WRONG = 25.0  # degrees; views lean as far themselves


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--up", nargs="*", default=[], metavar="NAME=AXIS", help="+x to -z")
    options = parser.parse_args(arguments)
    known = {}
    for word in options.up:
        name, _, known[name] = word.rpartition("=")
        if not name or known[name] not in AXES:
            parser.error(f"--up must be NAME=AXIS, an axis of {', '.join(AXES)}; found {word!r}.")
    found = [angles(cvtgs.load(path), known.get(path.stem, "-y")) for path in options.files]
    print("| up is |", *(f"{axis} |" for axis in USUAL))
    print("|---" * (1 + len(USUAL)) + "|")
    for path, row in zip(options.files, found, strict=True):
        print(f"| {path.stem} |", *(f"{angle:.0f}° |" for angle in row))
    wrong = [sum(angle > WRONG for angle in column) for column in zip(*found, strict=True)]
    print("| wrong |", *(f"{count} |" for count in wrong))


def angles(scene: cvtgs.GaussianScene, up: str) -> list[float]:
    """Return how far off the up direction is, in degrees, for every usual one of the file."""
    scene, errors = scene.with_sh_degree(0), []
    for axis in USUAL:
        turn, _ = Rotation.align_vectors(AXES[axis][None], AXES[up][None])
        x, y, z, w = turn.as_quat().tolist()
        found = find_layout(move(scene, Motion(quat=(w, x, y, z)))).up
        cosine = float(found @ torch.from_numpy(AXES[axis]).to(found))
        errors.append(math.degrees(math.acos(min(1.0, max(-1.0, cosine)))))
    return errors


if __name__ == "__main__":
    main()
