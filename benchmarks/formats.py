"""What each format costs: bytes, seconds, and quality after a round trip.

``python -m benchmarks.formats`` prints Markdown tables. Seconds are those of one process that has
imported everything; images are rendered by cvtgs from automatic views.
"""

import argparse
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import torch

import cvtgs
from benchmarks.processes import machine, spread
from cvtgs.errors import DroppedDataWarning
from cvtgs.evaluation import EvaluationSettings, evaluate

FORMATS = ("ply", "compressed.ply", "spz", "splat", "sog")
SCENES = (("courtyard", 3), ("object", 3), ("landscape", 0))
VIEWS, WIDTH, HEIGHT = 6, 480, 360


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="scenes; generated ones if none")
    parser.add_argument("--count", type=int, default=100_000, help="Gaussians to generate")
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    warnings.simplefilter("ignore", DroppedDataWarning)
    scenes = {file.name: cvtgs.load(file) for file in options.files} or {
        f"{kind}, SH {degree}": cvtgs.synthetic.scene(kind, options.count, sh_degree=degree)
        for kind, degree in SCENES
    }
    print(f"{machine()}, torch {torch.__version__}, {options.runs} runs")
    for name, scene in scenes.items():
        print(f"\n{name}: {len(scene):,} Gaussians\n")
        print("| format | bytes per Gaussian | write s | read s | PSNR dB | SSIM |")
        print("|---|---|---|---|---|---|")
        for end in FORMATS:
            print(measured(scene, end, options.runs), flush=True)


def measured(scene: cvtgs.GaussianScene, end: str, runs: int) -> str:
    """Return the row of a format."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{end}"
        write = [seconds(lambda: cvtgs.save(scene, path, overwrite=True)) for _ in range(runs)]
        read = [seconds(lambda: cvtgs.load(path)) for _ in range(runs)]
        size, again = path.stat().st_size, cvtgs.load(path)
    cameras = cvtgs.views.automatic_views(scene, VIEWS, width=WIDTH, height=HEIGHT)
    (scores,) = evaluate(
        scene, {end: again}, cameras, settings=EvaluationSettings(lpips="off")
    ).scenes
    return (
        f"| .{end} | {size / len(scene):.1f} | {spread(write)} | {spread(read)} | "
        f"{scores.psnr.mean:.1f} | {scores.ssim.mean:.4f} |"
    )


def seconds(job: Callable[[], object]) -> float:
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
