"""Simplify a scene and print a report.

python examples/simplify.py scene.ply small.ply --rho 0.01
"""

import argparse
from pathlib import Path

import cvtgs


def main() -> None:
    """Read, simplify, write, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("input", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--rho", type=float, default=0.01)
    parser.add_argument("--preset", default="standard", choices=list(cvtgs.PRESETS))
    options = parser.parse_args()
    cvtgs.io.check_save(options.output)  # fail early
    simplifier = cvtgs.Simplifier(config=options.preset, listener=tell)
    small, report = simplifier.run(cvtgs.load(options.input), options.rho)
    cvtgs.save(small, options.output)
    print(f"{report.input_count:,} -> {report.output_count:,} Gaussians")
    print(f"{report.filtered_count:,} left out, with {report.filtered_mass_share:.1%} of the mass")
    for stage in report.stages:
        print(f"  {stage.stage:<10} {stage.seconds:6.2f} s")


def tell(event: cvtgs.ProgressEvent) -> None:
    """Show progress; a listener can stop the run by raising an exception."""
    if event.done == event.total:
        print(f"{event.stage} is done")


if __name__ == "__main__":
    main()
