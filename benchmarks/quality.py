"""PSNR and SSIM of presets on scenes, by any scorer that prints JSON.

``python -m benchmarks.quality --scorer "python score.py --json {full} {small}" full.ply ...``
simplifies every scene at every ratio and asks the scorer, which gets the full scene and the
small ones and must print a JSON list of objects with ``psnr`` and ``ssim``, in that order.
"""

import argparse
import json
import shlex
import subprocess
import tempfile
from pathlib import Path
from statistics import mean

import cvtgs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--scorer", required=True, help="command with {full} and {small}")
    parser.add_argument("--rho", type=float, nargs="+", default=[0.1, 0.01, 0.001])
    parser.add_argument("--preset", nargs="+", default=["standard", "paper"])
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    settings = dict(item.split("=", 1) for item in options.set)
    print("| preset | scene | " + " | ".join(f"rho {rho:g}" for rho in options.rho) + " |")
    print("|---|---|" + "---|" * len(options.rho))
    for preset in options.preset:
        config = cvtgs.SimplifyConfig.compose(preset=preset, settings=settings)
        rows = {file.stem: scores(file, config, options) for file in options.files}
        rows["mean"] = [
            tuple(mean(values) for values in zip(*column, strict=True))
            for column in zip(*rows.values(), strict=True)
        ]
        for name, row in rows.items():
            cells = (f"{psnr:.2f} dB / {ssim:.4f}" for psnr, ssim in row)
            print(f"| {preset} | {name} | " + " | ".join(cells) + " |", flush=True)


def scores(
    file: Path, config: cvtgs.SimplifyConfig, options: argparse.Namespace
) -> list[tuple[float, ...]]:
    scene = cvtgs.load(file)
    simplifier = cvtgs.Simplifier(config=config)
    with tempfile.TemporaryDirectory() as folder:
        small_files = []
        for rho in options.rho:
            path = Path(folder) / f"{file.stem}_{rho:g}.ply"
            cvtgs.save(simplifier.simplify(scene, rho), path)
            small_files.append(shlex.quote(str(path)))
        command = options.scorer.format(full=shlex.quote(str(file)), small=" ".join(small_files))
        output = subprocess.run(shlex.split(command), check=True, capture_output=True, text=True)
    return [(entry["psnr"], entry["ssim"]) for entry in json.loads(output.stdout)]


if __name__ == "__main__":
    main()
