"""Simplify the newest checkpoint of a Splatfacto run, without ``ns-export``.

python examples/nerfstudio_run.py outputs/room/splatfacto/2026-01-01_120000 room.spz --rho 0.1

Splatfacto moves and scales its scenes, so the cameras of ``transforms.json`` do not fit them. Use
automatic views, as ``cvtgs compare`` does without ``--cameras``.
"""

import argparse
from pathlib import Path

import cvtgs


def main() -> None:
    """Read, simplify, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="the folder that holds nerfstudio_models")
    parser.add_argument("output", type=Path)
    parser.add_argument("--rho", type=float, default=0.1)
    options = parser.parse_args()
    scene = cvtgs.load(options.run)
    cvtgs.save(cvtgs.Simplifier().simplify(scene, options.rho), options.output)


if __name__ == "__main__":
    main()
