"""Measure peak memory of ``cvtgs simplify`` in one piece, beside the estimate that chooses blocks.

``python -m benchmarks.memory`` prints a Markdown table.
"""

import argparse
import tempfile
from pathlib import Path

from benchmarks.measuring import generated_scenes, machine, run_python
from cvtgs import SimplifyConfig, target_count
from cvtgs.io.ply import open_rows
from cvtgs.outofcore.memory import merging_rows, needed_memory

SCENES = (
    ("courtyard", 1_000_000, 0),
    ("courtyard", 2_000_000, 0),
    ("courtyard", 400_000, 3),
    ("courtyard", 800_000, 3),
    ("landscape", 1_000_000, 0),
    ("object", 1_000_000, 1),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="binary PLYs; generated ones if none")
    parser.add_argument("--rho", type=float, nargs="+", default=[0.01, 0.1, 0.3])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        files = options.files or generated_scenes(Path(folder), SCENES)
        print(f"{machine()}; peak (estimate), MB\n")
        print("| scene | " + " | ".join(f"{rho:g}" for rho in options.rho) + " |")
        print("|---" * (1 + len(options.rho)) + "|")
        for file in files:
            cells = [measured(file, rho, Path(folder)) for rho in options.rho]
            print(f"| {file.stem} | " + " | ".join(cells) + " |", flush=True)


def measured(file: Path, rho: float, folder: Path) -> str:
    """Return the peak of one simplification, and its estimate."""
    rows, allocation = open_rows(file), SimplifyConfig().allocation
    merging = merging_rows(target_count(rows.count, rho), rows.count, allocation)
    estimate = needed_memory(rows, rows.count, merging=merging)
    command = ["-m", "cvtgs", "simplify", str(file), str(folder / "small.ply"), "--overwrite"]
    cost = run_python(*command, "--rho", str(rho), "--quiet", "--memory", "1TB")
    return f"{cost.peak_bytes / 1e6:.0f} ({estimate / 1e6:.0f})"


if __name__ == "__main__":
    main()
