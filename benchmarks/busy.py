"""Measure how much longer a program with cvtgs takes while others use the same cores.

``python -m benchmarks.busy`` prints seconds on a quiet machine and beside endless loops, one per
core. Twice as long would be fair: half of the cores' time goes to the loops.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from io import BytesIO
from pathlib import Path

import torch

import cvtgs
from benchmarks.measuring import generated_scenes, machine, run_python, spread, warm_up
from cvtgs.devices import core_count
from cvtgs.errors import DroppedDataWarning
from cvtgs.evaluation import EvaluationSettings
from cvtgs.views import automatic_views

SUFFIXES = (".compressed.ply", ".spz", ".sog", ".glb")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", nargs="?", type=Path, help="a PLY; a generated scene if none")
    parser.add_argument("--loops", type=int, default=core_count(), help="endless loops beside it")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(measure(options.file, options.runs)))
        return
    with tempfile.TemporaryDirectory() as folder:
        file = options.file or generated_scenes(Path(folder), [("courtyard", 200_000, 3)])[0]
        command = ["-m", "benchmarks.busy", str(file), "--runs", str(options.runs), "--child"]
        quiet = json.loads(run_python(*command).output)
        with endless_loops(options.loops):
            busy = json.loads(run_python(*command).output)
    print(f"{machine()}, torch {torch.__version__}; {file.stem}, {options.runs} runs\n")
    print(f"| wall s | quiet | beside {options.loops} loops |\n|---|---|---|")
    for name, seconds in quiet.items():
        print(f"| {name} | {spread(seconds)} | {spread(busy[name])} |")


@contextmanager
def endless_loops(count: int) -> Iterator[None]:
    """Run processes that use one core each."""
    with ExitStack() as stack:
        for _ in range(count):
            loop = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(loop.kill)
        time.sleep(1.0)  # until they have started
        yield


def measure(file: Path, runs: int) -> dict[str, list[float]]:
    """Measure the wall seconds of several operations, each after one that does not count."""
    warnings.simplefilter("ignore", DroppedDataWarning)
    warm_up()
    found = {}
    for name, operation in operations(cvtgs.load(file)).items():
        operation()
        found[name] = [wall_seconds(operation) for _ in range(runs)]
    return found


def operations(scene: cvtgs.GaussianScene) -> dict[str, Callable[[], object]]:
    """Return what to measure, by name."""
    small = cvtgs.Simplifier(config="draft", device="cpu").simplify(scene, 0.1)
    views = automatic_views(scene, 8, width=400, height=400)
    few = automatic_views(scene, 2, width=200, height=200)
    settings = EvaluationSettings(lpips="off")

    def simplify(preset: str, rho: float) -> Callable[[], object]:
        return lambda: cvtgs.Simplifier(config=preset, device="cpu").simplify(scene, rho)

    def save(suffix: str) -> Callable[[], object]:
        return lambda: cvtgs.save(scene, BytesIO(), format=suffix)

    return {
        "`standard` at 0.01": simplify("standard", 0.01),
        "`matched` at 0.1": simplify("matched", 0.1),
        **{f"save as `{suffix}`": save(suffix) for suffix in SUFFIXES},
        "scores in 8 images of 400 pixels": lambda: cvtgs.evaluate(
            scene, {"small": small}, views, settings=settings
        ),
        "2 images of 200 pixels by torch": lambda: cvtgs.render(small, few, backend="torch"),
    }


def wall_seconds(operation: Callable[[], object]) -> float:
    start = time.perf_counter()
    operation()
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
