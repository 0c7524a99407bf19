"""The memory-mapped reader of common PLY files against plyfile: CPU seconds and peak memory.

``python -m benchmarks.reading`` prints a Markdown table; each reading is a process of its own.
"""

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from unittest import mock

import cvtgs
from benchmarks.processes import Cost, machine, run_python, spread
from benchmarks.speed import SCENES, generated_scenes
from cvtgs.io.ply import read

READERS = ("mapped", "plyfile")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="PLYs; generated scenes if none")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--child", choices=READERS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(seconds_to_read(options.files[0], options.child)))
        return
    bare = run_python("-c", "import torch, plyfile").peak_bytes
    with tempfile.TemporaryDirectory() as folder:
        print(f"{machine()}, {options.runs} runs\n")
        print("| file | reader | CPU s | peak above bare / file |\n|---|---|---|---|")
        for file in options.files or generated_scenes(Path(folder), SCENES):
            for reader in READERS:
                costs = [read_once(file, reader) for _ in range(options.runs)]
                peak = statistics.median(cost.peak_bytes for cost in costs)
                seconds = spread([float(cost.output) for cost in costs])
                ratio = (peak - bare) / file.stat().st_size
                print(f"| {file.stem} | {reader} | {seconds} | {ratio:.2f} |", flush=True)


def read_once(file: Path, reader: str) -> Cost:
    return run_python("-m", "benchmarks.reading", "--child", reader, str(file))


def seconds_to_read(file: Path, reader: str) -> float:
    with mock.patch.object(read, "can_map", return_value=reader == "mapped"):
        start = time.process_time()
        cvtgs.load(file)
        return time.process_time() - start


if __name__ == "__main__":
    main()
