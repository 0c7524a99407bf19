"""Measure each format: bytes, seconds, and quality after a round trip.

``python -m benchmarks.formats`` prints Markdown tables. Seconds are measured in one process, after
all imports; images are rendered by cvtgs from automatic views. ``--readers`` instead compares the
memory-mapped reader of common PLY files with plyfile: CPU seconds and peak memory, each read in
its own process.
"""

import argparse
import json
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import torch

import cvtgs
from benchmarks.measuring import Cost, generated_scenes, machine, names_of, run_python, spread
from benchmarks.quality import score_views
from benchmarks.speed import SCENES as LARGE_SCENES
from cvtgs.errors import DroppedDataWarning
from cvtgs.io.ply import read

FORMATS = ("ply", "compressed.ply", "spz", "splat", "sog")
SCENES = (("courtyard", 3), ("object", 3), ("landscape", 0))
VIEWS, WIDTH, HEIGHT = 6, 480, 360
READERS = ("mapped", "plyfile")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="scenes; generated ones if none")
    parser.add_argument("--count", type=int, default=100_000, help="Gaussians to generate")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--readers", action="store_true", help="compare readers of PLY files")
    parser.add_argument("--child", choices=READERS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(seconds_to_read(options.files[0], options.child)))
    elif options.readers:
        compare_readers(options)
    else:
        compare_formats(options)


def compare_formats(options: argparse.Namespace) -> None:
    warnings.simplefilter("ignore", DroppedDataWarning)
    named = zip(names_of(options.files), options.files, strict=True)
    scenes = {name: cvtgs.load(file) for name, file in named} or {
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
    """Measure a format and return its table row."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{end}"
        write = [seconds(lambda: cvtgs.save(scene, path, overwrite=True)) for _ in range(runs)]
        read = [seconds(lambda: cvtgs.load(path)) for _ in range(runs)]
        size, again = path.stat().st_size, cvtgs.load(path)
    cameras = cvtgs.views.automatic_views(scene, VIEWS, width=WIDTH, height=HEIGHT)
    quality = score_views(scene, {end: again}, cameras)[end]
    return (
        f"| .{end} | {size / len(scene):.1f} | {spread(write)} | {spread(read)} | "
        f"{quality.psnr:.1f} | {quality.ssim:.4f} |"
    )


def seconds(job: Callable[[], object]) -> float:
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


def compare_readers(options: argparse.Namespace) -> None:
    bare = run_python("-c", "import benchmarks.formats, plyfile").peak_bytes
    with tempfile.TemporaryDirectory() as folder:
        print(f"{machine()}, {options.runs} runs\n")
        print("| file | reader | CPU s | peak above bare / file |\n|---|---|---|---|")
        files = options.files or generated_scenes(Path(folder), LARGE_SCENES)
        for name, file in zip(names_of(files), files, strict=True):
            for reader in READERS:
                costs = [read_once(file, reader) for _ in range(options.runs)]
                peak = statistics.median(cost.peak_bytes for cost in costs)
                seconds = spread([float(cost.output) for cost in costs])
                ratio = (peak - bare) / file.stat().st_size
                print(f"| {name} | {reader} | {seconds} | {ratio:.2f} |", flush=True)


def read_once(file: Path, reader: str) -> Cost:
    return run_python("-m", "benchmarks.formats", "--child", reader, str(file))


def seconds_to_read(file: Path, reader: str) -> float:
    with mock.patch.object(read, "can_map", return_value=reader == "mapped"):
        start = time.process_time()
        cvtgs.load(file)
        return time.process_time() - start


if __name__ == "__main__":
    main()
