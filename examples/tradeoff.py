"""Measure seconds and PSNR of each preset on your own scene.

python examples/tradeoff.py scene.ply page --rho 0.01 --presets draft,standard,high
"""

import argparse
from functools import partial
from pathlib import Path

from cvtgs.evaluation import EvaluationSettings
from cvtgs.tradeoff import measure_tradeoff, write_tradeoff
from cvtgs.views import automatic_views


def ratios(text: str) -> list[float]:
    """Read ratios separated by commas, as the command line does."""
    return [float(word) for word in text.split(",")]


def main() -> None:
    """Measure, print results, and write a table, a plot and a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("input", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--rho", type=ratios, default=[0.01], help="separated by commas")
    parser.add_argument("--presets", default="draft,fast,standard", help="separated by commas")
    parser.add_argument("--size", type=int, default=480, help="side of the images, pixels")
    options = parser.parse_args()
    measured = measure_tradeoff(
        options.input,
        presets=options.presets.split(","),
        rhos=options.rho,
        cameras=partial(automatic_views, count=4, width=options.size, height=options.size),
        settings=EvaluationSettings(lpips="off"),
    )
    for result in measured.tradeoff.results:
        print(f"{result.preset:<10} {result.seconds:6.2f} s {result.psnr:6.2f} dB")
    write_tradeoff(measured, options.output, overwrite=True)


if __name__ == "__main__":
    main()
