"""Measure time and memory of ``cvtgs simplify``: process, stages, against the floor, by cores.

The floor is the work that no cell-based method can avoid: read the file, search the nearest site of
every Gaussian once, write the result. ``python -m benchmarks.speed`` prints Markdown tables.
"""

import argparse
import itertools
import json
import os
import statistics
import tempfile
import time
from pathlib import Path

import torch

import cvtgs
from benchmarks.measuring import cores, generated_scenes, machine, run_python, spread
from cvtgs.devices import core_count
from cvtgs.math.frames import morton_order, robust_frame
from cvtgs.validity import valid_part

SCENES = (("courtyard", 1_000_000, 0), ("courtyard", 250_000, 2), ("courtyard", 400_000, 3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="PLYs; generated scenes if none")
    parser.add_argument("--rho", type=float, default=0.01)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--child", choices=("stages", "wall"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        measure = {"stages": stage_costs, "wall": stage_seconds}[options.child]
        print(json.dumps(measure(options.files[0], options.rho, options.preset)))
        return
    with tempfile.TemporaryDirectory() as folder:
        files = options.files or generated_scenes(Path(folder), SCENES)
        print(f"{machine()}, torch {torch.__version__}; rho {options.rho:g}, {options.runs} runs\n")
        measure_processes(files, Path(folder), options)
        measure_stages(files, options)
        measure_cores(files, options)


def measure_processes(files: list[Path], folder: Path, options: argparse.Namespace) -> None:
    """Measure whole processes, including start-up of Python and torch, reading and writing."""
    bare = [run_python("-c", "import torch") for _ in range(options.runs)]
    bare_peak = max(cost.peak_bytes for cost in bare)
    print("| process | user CPU s | wall s | peak MB | above bare torch / file |")
    print("|---|---|---|---|---|")
    print(
        f"| python -c 'import torch' | {spread([cost.user_seconds for cost in bare])} "
        f"| {spread([cost.wall_seconds for cost in bare])} | {bare_peak / 1e6:.0f} | |"
    )
    for file in files:
        command = ["-m", "cvtgs", "simplify", str(file), str(folder / "small.ply"), "--overwrite"]
        command += ["--rho", str(options.rho), "--preset", options.preset, "--quiet"]
        costs = [run_python(*command) for _ in range(options.runs)]
        peak = max(cost.peak_bytes for cost in costs)
        print(
            f"| {file.stem} | {spread([cost.user_seconds for cost in costs])} "
            f"| {spread([cost.wall_seconds for cost in costs])} | {peak / 1e6:.0f} "
            f"| {(peak - bare_peak) / file.stat().st_size:.2f} |"
        )


def measure_stages(files: list[Path], options: argparse.Namespace) -> None:
    """Measure CPU seconds of the stages and their sum over the floor, in fresh processes."""
    print("\n| CPU s per stage | " + " | ".join(file.stem for file in files) + " |")
    print("|---|" + "---|" * len(files))
    columns = []
    for file in files:
        arguments = child_arguments(file, options)
        costs = [run_child("stages", arguments) for _ in range(options.runs)]
        columns.append({name: [cost[name] for cost in costs] for name in costs[0]})
    for name in columns[0]:
        print(f"| {name} | " + " | ".join(spread(column[name]) for column in columns) + " |")


def measure_cores(files: list[Path], options: argparse.Namespace) -> None:
    """Measure wall seconds of the stages of ``Simplifier.run``, alternating one and all cores."""
    if not hasattr(os, "sched_setaffinity"):
        return
    counts = (1, core_count())
    for file in files:
        found: dict[int, list[dict[str, float]]] = {count: [] for count in counts}
        for _, count in itertools.product(range(options.runs), counts):
            with cores(count):
                found[count].append(run_child("wall", child_arguments(file, options)))
        print(f"\n| wall s, {file.stem} | 1 core | {counts[1]} cores | ratio |\n|---|---|---|---|")
        for name in found[1][0]:
            one, several = ([run[name] for run in found[count]] for count in counts)
            ratio = statistics.median(one) / statistics.median(several)
            print(f"| {name} | {spread(one)} | {spread(several)} | {ratio:.2f} |")


def child_arguments(file: Path, options: argparse.Namespace) -> list[str]:
    return [str(file), "--rho", str(options.rho), "--preset", options.preset]


def run_child(what: str, arguments: list[str]) -> dict[str, float]:
    """Measure in a fresh process."""
    output = run_python("-m", "benchmarks.speed", "--child", what, *arguments).output
    costs: dict[str, float] = json.loads(output)
    return costs


def stage_seconds(file: Path, rho: float, preset: str) -> dict[str, float]:
    """Measure wall seconds of the stages once, in this process, after a small warm-up scene."""
    scene, simplifier = cvtgs.load(file), cvtgs.Simplifier(config=preset, device="cpu")
    simplifier.simplify(scene.select(torch.arange(min(20_000, len(scene)))), rho)
    stages = simplifier.run(scene, rho).report.stages
    seconds = {cost.stage: cost.seconds for cost in stages}
    return seconds | {"all": sum(seconds.values())}


def stage_costs(file: Path, rho: float, preset: str) -> dict[str, float]:
    """Measure the stages and the floor once, in this process, without the import of scipy."""
    cvtgs.cvt.nearest_scipy(torch.zeros(1, 3), torch.zeros(1, 3))
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "small.ply"
        start = time.process_time()
        scene = cvtgs.load(file)
        read = time.process_time() - start
        small, report = cvtgs.Simplifier(config=preset, device="cpu").run(scene, rho)
        start = time.process_time()
        cvtgs.save(small, output)
        write = time.process_time() - start
    stages = {cost.stage: cost.cpu_seconds for cost in report.stages}
    floor = read + one_pass(scene, len(small)) + write
    total = read + sum(stages.values()) + write
    return {"read": read, **stages, "write": write, "all": total, "floor": floor} | {
        "all / floor": total / floor
    }


def one_pass(scene: cvtgs.GaussianScene, count: int) -> float:
    """Time the search of the nearest of ``count`` sites for every Gaussian, by position only."""
    means = valid_part(scene).means
    points = robust_frame(means).contract(means)
    points = points[morton_order(points)]
    sites = points[:: len(points) // count][:count]
    start = time.process_time()
    cvtgs.cvt.nearest_scipy(points, sites)
    return time.process_time() - start


if __name__ == "__main__":
    main()
