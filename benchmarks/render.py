"""Measure time and memory of rendering with each backend, forward and forward plus backward.

``python -m benchmarks.render`` prints a Markdown table. Each backend runs in its own process; its
first images, which may compile, are timed separately.
"""

import argparse
import json
import math
import statistics
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import torch

import cvtgs
from benchmarks.measuring import generated_scenes, machine, run_python, spread
from cvtgs.cameras import Cameras, look_at
from cvtgs.clock import peak_memory_bytes
from cvtgs.rendering import BackendName, render
from cvtgs.validity import valid_part

SCENES = (("courtyard", 150_000, 0), ("courtyard", 150_000, 3), ("object", 150_000, 3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="PLYs; generated scenes if none")
    parser.add_argument("--size", type=int, default=400, help="pixels along both edges")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--child", metavar="BACKEND", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(costs(options)))
        return
    with tempfile.TemporaryDirectory() as folder:
        files = options.files or generated_scenes(Path(folder), SCENES)
        print(f"{machine()}, torch {torch.__version__}, {options.device};")
        print(f"{options.size} x {options.size} pixels, {options.views} views\n")
        print("| scene | backend | first s | forward s | forward and backward s | peak MB |")
        print("|---|---|---|---|---|---|")
        for file in files:
            for backend in backends(options.device):
                print(row(file, backend, options), flush=True)


def backends(device: str) -> list[str]:
    fast = "numba" if device == "cpu" else "gsplat"
    return ["torch", fast] if find_spec(fast) else ["torch"]


def row(file: Path, backend: str, options: argparse.Namespace) -> str:
    arguments = [str(file), "--child", backend, "--size", str(options.size)]
    arguments += ["--views", str(options.views), "--device", options.device]
    cost = json.loads(run_python("-m", "benchmarks.render", *arguments).output)
    return (
        f"| {file.stem} | {backend} | {cost['first']:.2f} | {spread(cost['forward'])} "
        f"| {spread(cost['both'])} | {cost['peak_bytes'] / 1e6:.0f} |"
    )


def costs(options: argparse.Namespace) -> dict[str, float | list[float]]:
    """Measure one backend on one scene, in this process."""
    scene = valid_part(cvtgs.load(options.files[0])).to(options.device)
    cameras = orbit(scene, options.views, options.size)
    views = cameras.singles()
    first = seconds(scene, views[0], options.child, backward=True)
    forward = [seconds(scene, view, options.child, backward=False) for view in views]
    both = [seconds(scene, view, options.child, backward=True) for view in views]
    peak = peak_memory_bytes()
    return {"first": first, "forward": forward, "both": both, "peak_bytes": peak}


def orbit(scene: cvtgs.GaussianScene, count: int, size: int) -> Cameras:
    """Return cameras around the centre of the scene, at two alternating heights toward -y."""
    center = scene.means.median(dim=0).values.cpu().double()
    ways = (scene.means.cpu().double() - center).norm(dim=1)
    distance = 2.0 * statistics.median(ways[:: max(1, len(ways) // 1000)].tolist())
    turns = torch.arange(count, dtype=torch.float64) * 2 * math.pi / count
    heights = -0.3 - 0.3 * (torch.arange(count) % 2)
    rim = torch.stack([turns.cos(), heights.double(), turns.sin()], dim=1)
    focal = 0.5 * size / math.tan(math.radians(25))
    rows = [[focal, 0, 0.5 * size], [0, focal, 0.5 * size], [0, 0, 1]]
    up = torch.tensor([0.0, -1, 0], dtype=torch.float64)
    return Cameras(
        viewmats=look_at(center + distance * rim, center.expand(count, 3), up),
        Ks=torch.tensor(rows, dtype=torch.float64).expand(count, 3, 3),
        width=size,
        height=size,
    )


def seconds(
    scene: cvtgs.GaussianScene, cameras: Cameras, backend: BackendName, *, backward: bool
) -> float:
    """Time one image."""
    tensors = {
        name: tensor.clone().requires_grad_(backward) for name, tensor in scene.tensors().items()
    }
    leaves = scene.with_tensors(tensors, scene.extras)
    synchronize(scene.device)
    start = time.perf_counter()
    image = render(leaves, cameras, backend=backend).rgb
    if backward:
        image.square().mean().backward()
    synchronize(scene.device)
    return time.perf_counter() - start


def synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


if __name__ == "__main__":
    main()
