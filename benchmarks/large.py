"""Measure levels of detail, and out-of-core runs on large files.

``python -m benchmarks.large levels`` compares the time of levels with that of separate runs;
``seams`` compares runs by blocks with runs in one piece, by the cameras beside a file where it has
some (``benchmarks.cameras``); ``--fit 48`` gives presets with images that many others, and
``--exact`` takes the ratio alone instead of five around it, and ``--stream`` compares the finest
level of streams, written as SOG in both cases. ``blocks`` simplifies large files, or a
generated one of ``--count`` Gaussians, each in its own process, and prints user CPU seconds and
peak memory. With ``--workers 1 2`` it also prints the speedup of two workers on two cores over one
on one, and whether both write the same bytes. ``make`` writes a generated file. Tables are
Markdown.
"""

import argparse
import hashlib
import itertools
import json
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import mean, median

import torch

import cvtgs
from benchmarks.cameras import cameras_beside, cameras_file, spread_cameras
from benchmarks.measuring import cores, difference, generated_scenes, machine, names_of, run_python
from benchmarks.quality import score_views
from cvtgs.cameras import Cameras
from cvtgs.outofcore import simplify_file
from cvtgs.outofcore.memory import read_bytes
from cvtgs.streams import plan_stream, stream_file, write_sog_stream
from cvtgs.views import automatic_views

RATIOS, RUNS = (0.1, 0.01, 0.001), 3
SHARES = (0.97, 0.985, 1.0, 1.015, 1.03)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("levels", "seams", "blocks", "make"))
    parser.add_argument("files", nargs="*", type=Path, help="PLYs; generated scenes if none")
    parser.add_argument("--count", type=int, default=200_000, help="Gaussians of generated scenes")
    kinds = ",".join(cvtgs.synthetic.KINDS)
    parser.add_argument("--kinds", default=kinds, help="kinds of generated scenes")
    parser.add_argument("--blocks", default="4,16", help="numbers of blocks to compare")
    parser.add_argument("--presets", default="standard", help="presets to compare by blocks")
    parser.add_argument("--fit", type=int, default=0, help="number of cameras to give to presets")
    parser.add_argument("--by-given", action="store_true", help="score by the given cameras")
    parser.add_argument("--exact", action="store_true", help="compare at the ratio alone")
    parser.add_argument("--stream", action="store_true", help="compare streams by blocks")
    parser.add_argument(
        "--memory",
        default="2GB",
        help="memory of each worker, so that all runs make the same blocks",
    )
    parser.add_argument(
        "--workers",
        type=int,
        nargs="+",
        default=[1],
        help="numbers of processes, with a core each; one row per number, user CPU summed",
    )
    parser.add_argument("--rho", type=float, default=0.01)
    parser.add_argument("--folder", type=Path, help="folder for large files")
    options = parser.parse_intermixed_args()
    load = os.getloadavg()[0]
    print(f"{machine()}, torch {torch.__version__}; load {load:.1f} when this started\n")
    {"levels": levels, "seams": seams, "blocks": blocks, "make": make}[options.what](options)


def levels(options: argparse.Namespace) -> None:
    """Print the time of three levels against those of the finest alone and of separate runs."""
    print("| scene | finest, CPU s | levels, CPU s | ratio | separate runs, CPU s |")
    print("|---|---|---|---|---|")
    torch.set_num_threads(1)  # waiting threads would count as CPU time
    simplifier = cvtgs.Simplifier(device="cpu")
    for name, scene in scenes(options):
        simplifier.simplify(scene[:1000], 0.1)  # loads scipy
        together, apart = [], []
        for _ in range(RUNS):
            times = [time.process_time()]
            simplifier.levels(scene, RATIOS)
            times.append(time.process_time())
            for rho in RATIOS:
                simplifier.simplify(scene, rho)
                times.append(time.process_time())
            first, *others = (end - start for start, end in itertools.pairwise(times))
            together.append(first)
            apart.append(others)
        finest, least = median(own[0] for own in apart), median(together)
        print(
            f"| {name}, {len(scene):,} | {finest:.2f} | {least:.2f} | {least / finest:.2f} "
            f"| {median(map(sum, apart)):.2f} |",
            flush=True,
        )


def seams(options: argparse.Namespace) -> None:
    """Print scores of runs by blocks against runs in one piece, as means over several counts.

    Changing the count by one per cent changes a single figure by more than seams do.
    """
    numbers = [1, *(int(word) for word in options.blocks.split(","))]
    shares = (1.0,) if options.exact else SHARES
    columns = f"| scene, rho {options.rho:g} | preset | one piece, dB (SSIM) |"
    print(columns, *(f"{n} blocks |" for n in numbers[1:]))
    print("|---|---|---|" + "---|" * len(numbers[1:]))
    for (name, scene, cameras), preset in itertools.product(
        seen_scenes(options), options.presets.split(",")
    ):
        given = spread_cameras(scene, options.fit) if options.fit else None
        views = given if given is not None and options.by_given else cameras
        simplifier = cvtgs.Simplifier(preset=preset, device="cpu")
        found: dict[int, list[cvtgs.GaussianScene]] = {number: [] for number in numbers}
        with tempfile.TemporaryDirectory() as folder:
            path, output = Path(folder) / "in.ply", Path(folder) / "out.ply"
            cvtgs.save(scene, path)
            for number, share in itertools.product(numbers, shares):
                rho = min(1.0, share * options.rho)
                if options.stream:
                    stream(path, scene, rho, Path(folder) / "out", blocks=number, by=simplifier)
                    found[number].append(cvtgs.load(Path(folder) / "out"))
                    continue
                if number == 1:
                    found[number].append(simplifier.simplify(scene, rho, cameras=given))
                    continue
                simplify_file(
                    path, output, rho, blocks=number, simplifier=simplifier, cameras=given,
                    overwrite=True,
                )  # fmt: skip
                found[number].append(cvtgs.load(output))
        psnr, ssim = zip(*(scores(scene, found[n], views) for n in numbers), strict=True)
        words = [f"{psnr[0]:.2f} ({ssim[0]:.4f}) |"]
        for one, other in zip(psnr[1:], ssim[1:], strict=True):
            words.append(f"{difference(one, psnr[0]):+.2f} ({other - ssim[0]:+.4f}) |")
        print(f"| {name}, {len(scene):,} | {preset} |", *words, flush=True)


def stream(
    path: Path,
    scene: cvtgs.GaussianScene,
    rho: float,
    folder: Path,
    *,
    blocks: int,
    by: cvtgs.Simplifier,
) -> None:
    """Write a stream whose finest level has a ratio and whose other one a quarter of it."""
    rhos = [rho, rho / 4]
    if blocks == 1:
        write_sog_stream(plan_stream(by.levels(scene, rhos)), folder, overwrite=True)
    else:
        stream_file(path, folder, rhos, kind="sog", blocks=blocks, simplifier=by, overwrite=True)


def blocks(options: argparse.Namespace) -> None:
    """Measure whole processes on large files, and each number of workers against the first."""
    names = ("file", "memory each", "workers", "user CPU s", "wall s", "ratio", "peak MB")
    print(f"| {' | '.join((*names, 'Gaussians', 'blocks'))} |")
    print("|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        output, report = Path(folder) / "small.ply", Path(folder) / "report.json"
        made = [("courtyard", options.count, 0)]
        files = options.files or generated_scenes(Path(folder), made)
        for file, workers in itertools.product(files, options.workers):
            memory = workers * read_bytes(options.memory)
            with cores(workers):
                cost = run_python(
                    "-m", "cvtgs", "simplify", str(file), str(output), "--rho", str(options.rho),
                    "--memory", str(memory), "--workers", str(workers),
                    "--report", str(report), "--overwrite", "--quiet",
                )  # fmt: skip
            said, digest = json.loads(report.read_text()), hashlib.sha256(output.read_bytes())
            if workers == options.workers[0]:
                wall, first = cost.wall_seconds, digest.digest()
            same = "same" if digest.digest() == first else "DIFFERENT"
            print(
                f"| {file.stem}, {file.stat().st_size / 1e9:.2f} GB | {options.memory} | {workers} "
                f"| {cost.user_seconds:.1f} | {cost.wall_seconds:.1f} "
                f"| {wall / cost.wall_seconds:.2f}, {same} bytes "
                f"| {cost.peak_bytes / 1e6:.0f} | {said['output_count']:,} | {said['blocks']} |",
                flush=True,
            )


def make(options: argparse.Namespace) -> None:
    """Write a courtyard scene of ``--count`` Gaussians without view-dependent colour."""
    if len(options.files) != 1:
        raise SystemExit(f"make must have one file to write; found {len(options.files)}.")
    (file,) = options.files
    cvtgs.save(cvtgs.synthetic.scene("courtyard", options.count, sh_degree=0, seed=0), file)


def scenes(options: argparse.Namespace) -> list[tuple[str, cvtgs.GaussianScene]]:
    """Return the scenes to compare on."""
    if options.files:
        named = zip(names_of(options.files), options.files, strict=True)
        return [(name, cvtgs.load(file)) for name, file in named]
    make_one, kinds = cvtgs.synthetic.scene, options.kinds.split(",")
    return [(kind, make_one(kind, options.count, sh_degree=1, seed=3)) for kind in kinds]


def seen_scenes(
    options: argparse.Namespace,
) -> Iterator[tuple[str, cvtgs.GaussianScene, Cameras]]:
    """Yield the scenes with the cameras beside them; automatic views where there are none."""
    named = zip(names_of(options.files), options.files, strict=True)
    beside = {name: file for name, file in named if cameras_file(file).is_file()}
    for name, scene in scenes(options):
        if name in beside:
            yield name, scene, cameras_beside(beside[name])
        else:
            yield name, scene, automatic_views(scene, 6, width=400, height=300)


def scores(
    scene: cvtgs.GaussianScene, small: Sequence[cvtgs.GaussianScene], cameras: Cameras
) -> tuple[float, float]:
    """Return the mean PSNR and SSIM of several simplified scenes."""
    named = {str(number): one for number, one in enumerate(small)}
    found = score_views(scene, named, cameras).values()
    return mean(one.psnr for one in found), mean(one.ssim for one in found)


if __name__ == "__main__":
    main()
