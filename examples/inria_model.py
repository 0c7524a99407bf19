"""Simplify a model folder of INRIA's code into a model folder that its viewer opens.

python examples/inria_model.py output/garden garden-small --rho 0.1

``cvtgs evaluate output/garden garden-small`` scores the folders directly, from the training
cameras.
"""

import argparse
import shutil
from pathlib import Path

import cvtgs


def main() -> None:
    """Read, simplify, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path, help="the folder that holds point_cloud/iteration_*")
    parser.add_argument("output", type=Path)
    parser.add_argument("--rho", type=float, default=0.1)
    options = parser.parse_args()
    if not options.model.is_dir():
        parser.error(f"model must be a folder; found {options.model}.")
    scene_file = cvtgs.io.scene_file(options.model)
    small = cvtgs.Simplifier().simplify(cvtgs.load(scene_file), options.rho)
    target = options.output / scene_file.relative_to(options.model)
    target.parent.mkdir(parents=True, exist_ok=True)
    cvtgs.save(small, target)
    for name in ("cameras.json", "cfg_args", "input.ply", "exposure.json"):
        if (options.model / name).is_file():
            shutil.copy(options.model / name, options.output / name)


if __name__ == "__main__":
    main()
