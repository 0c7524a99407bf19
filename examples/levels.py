"""Make all levels of detail for a viewer in one run, in less time than separate runs.

python examples/levels.py scene.ply levels --rho 0.25,0.05,0.01 --suffix .spz
"""

import argparse
from pathlib import Path

import cvtgs


def ratios(text: str) -> list[float]:
    """Read ratios separated by commas, as the command line does."""
    return [float(word) for word in text.split(",")]


def main() -> None:
    """Read, make all levels, write each level."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("input", type=Path)
    parser.add_argument("output", type=Path, help="folder for level0, level1, ...")
    parser.add_argument(
        "--rho", type=ratios, default=[0.25, 0.05, 0.01], help="separated by commas"
    )
    parser.add_argument("--suffix", default=".ply")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    levels = cvtgs.Simplifier().levels(cvtgs.load(options.input), options.rho)
    for number, level in enumerate(levels):
        path = options.output / f"level{number}{options.suffix}"
        cvtgs.save(level.scene, path)
        # A viewer can switch to a coarser level once this error is below a pixel.
        print(f"{path}: {len(level.scene):,} Gaussians, error {level.geometric_error:.3g} units")


if __name__ == "__main__":
    main()
