"""Run one baseline on a file: ``python -m benchmarks.baselines METHOD IN OUT --count M``."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.baselines import BASELINES, baseline
from cvtgs.startup import load_torch


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("method", choices=BASELINES)
    parser.add_argument("input", type=Path, metavar="IN")
    parser.add_argument("output", type=Path, metavar="OUT")
    parser.add_argument("--count", type=int, required=True, help="number of Gaussians to keep")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)

    from cvtgs.io import load, save  # noqa: PLC0415 (torch starts after its setting is made)

    small = baseline(options.method)(load(options.input), options.count, seed=options.seed)
    save(small, options.output, overwrite=True)


if __name__ == "__main__":
    load_torch()  # as the command line of cvtgs does
    main()
