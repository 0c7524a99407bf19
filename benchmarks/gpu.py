"""Measure time and memory on a CUDA device and on the CPU: stages, renderers, training steps.

``python -m benchmarks.gpu`` writes its Markdown tables to docs/gpu.md. ``nox -s gpu`` first runs
the tests that are useful on a device.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch

import cvtgs
from benchmarks.device_search import search_table
from benchmarks.measuring import around_tables, machine, renew_tables
from cvtgs import GaussianScene, Simplifier, SimplifyConfig
from cvtgs.devices import device_name
from cvtgs.errors import CvtgsError
from cvtgs.evaluation import EvaluationSettings, evaluate
from cvtgs.progress import ProgressEvent
from cvtgs.rendering import BackendName, choose_backend, render
from cvtgs.report import SimplifyReport
from cvtgs.train import DataConfig, TrainConfig, TrainFiles, ViewsConfig, train
from cvtgs.views import automatic_views

PAGE = Path("docs/gpu.md")
COUNTS = (1_000_000, 4_200_000, 13_600_000)
COLORED = (1_000_000, 4_200_000)  # counts of the scenes with view-dependent colour
IMAGE_PRESETS: tuple[dict[str, Any], ...] = ({"preset": "matched"}, {"preset": "high"})
"""The configurations that render the scene."""

VIEWS = 4
"""Number of images of the full scene to compare results with."""

CASE_COUNT = 20_000
"""Number of Gaussians of the scene to train on."""

RENDERERS: tuple[BackendName, ...] = ("torch", "gsplat", "numba")
TRAININGS: tuple[Literal["scene", "local"], ...] = ("scene", "local")
"""Kinds of training to time."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="Gaussians")
    parser.add_argument("--colored", type=int, nargs="*", default=COLORED, help="with SH degree 3")
    parser.add_argument("--rho", type=float, default=0.01)
    parser.add_argument("--runs", type=int, default=3, help="measured runs, after one warm-up")
    parser.add_argument("--size", type=int, default=400, help="pixels along both edges")
    parser.add_argument("--steps", type=int, default=20, help="training steps")
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args()
    device = torch.device(options.device)
    around_tables(options.page, script="benchmarks.gpu")
    text = "\n".join(
        [
            f"{device_name(device)}; CPU: {machine()}; torch {torch.__version__}, cvtgs "
            f"{cvtgs.__version__}.\n",
            *stage_table(device, options.counts, rho=options.rho, runs=options.runs),
            *files_table(device, options.counts, rho=options.rho, runs=options.runs),
            *color_table(device, options.colored, rho=options.rho, runs=options.runs),
            *preset_table(device, options.counts[0], rho=options.rho),
            *renderer_table(device, options.counts[0], size=options.size, runs=options.runs),
            *training_table(device, steps=options.steps),
            *search_table(device, options.counts, axes=6, share=min(1.0, 8 * options.rho)),
        ]
    )
    print(text)
    renew_tables(options.page, text, script="benchmarks.gpu")


def stage_table(device: torch.device, counts: Sequence[int], *, rho: float, runs: int) -> list[str]:
    """Return a table of median seconds and peak per stage, and of seconds on the CPU."""
    lines = [
        "| Gaussians, SH 0 | stage | device s | peak on the device MB | CPU s | CPU / device |",
        "|---|---|---|---|---|---|",
    ]
    notes = []
    for count in counts:
        scene = cvtgs.synthetic.scene("courtyard", count, sh_degree=0, seed=0)
        moved = [seconds(partial(scene.to, device), device) for _ in range(runs + 1)]
        there = scene.to(device)
        small, reports = repeat(there, SimplifyConfig(), rho, device=device, runs=runs)
        (on_cpu, *_), others = repeat(
            scene, SimplifyConfig(), rho, device=torch.device("cpu"), runs=runs
        )
        lines.append(row(count, "copy", statistics.median(moved[1:]), None, None))
        peaks, on_host = stage_peaks(reports), stage_seconds(others)
        for stage, found in stage_seconds(reports).items():
            lines.append(row(count, stage, found, peaks[stage], on_host[stage]))
        same = all(equal(small[0], one) for one in small[1:])
        found, wanted = (
            scores.psnr.mean
            for scores in evaluate(
                there,
                {"device": small[0].to(device), "CPU": on_cpu.to(device)},
                automatic_views(scene, VIEWS, width=400, height=400),
                settings=EvaluationSettings(lpips="off"),
            ).scenes
        )
        notes.append(
            f"{count:,}: runs give {'the same' if same else 'DIFFERENT'} bits; PSNR of {VIEWS} "
            f"images {found:.2f} dB, of the CPU's result {wanted:.2f}. {reports[0].device_note}"
        )
    return [*lines, "", *(f"- {note}".rstrip() for note in notes), ""]


def files_table(device: torch.device, counts: Sequence[int], *, rho: float, runs: int) -> list[str]:
    """Return a table of median seconds from file to file."""
    lines = ["| Gaussians, SH 0 | load s | simplify s | save s | all s |", "|---|---|---|---|---|"]
    simplifier = Simplifier(device=device)
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder) / "full.ply", Path(folder) / "small.ply"
            cvtgs.save(cvtgs.synthetic.scene("courtyard", count, sh_degree=0, seed=0), source)
            times = []
            for _ in range(runs + 1):
                start = time.perf_counter()
                scene = cvtgs.load(source)
                loaded = time.perf_counter()
                small = simplifier.simplify(scene, rho)
                simplified = time.perf_counter()
                cvtgs.save(small, target, overwrite=True)
                end = time.perf_counter()
                times.append((loaded - start, simplified - loaded, end - simplified, end - start))
        medians = [statistics.median(column) for column in zip(*times[1:], strict=True)]
        lines.append(f"| {count:,} | " + " | ".join(f"{one:.2f}" for one in medians) + " |")
    return [*lines, ""]


def color_table(device: torch.device, counts: Sequence[int], *, rho: float, runs: int) -> list[str]:
    """Return a table of median seconds of whole calls for scenes with view-dependent colour."""
    lines = [
        "| Gaussians, SH 3 | copy s | simplify on the device s | peak on the device MB | CPU s |",
        "|---|---|---|---|---|",
    ]
    for count in counts:
        scene = cvtgs.synthetic.scene("courtyard", count, sh_degree=3, seed=0)
        moved = [seconds(partial(scene.to, device), device) for _ in range(runs + 1)]
        copy, config = statistics.median(moved[1:]), SimplifyConfig()
        _, reports = repeat(scene.to(device), config, rho, device=device, runs=runs)
        _, others = repeat(scene, config, rho, device=torch.device("cpu"), runs=runs)
        there, here = (stage_seconds(some)["all"] for some in (reports, others))
        peak = stage_peaks(reports)["all"] / 1e6
        lines.append(f"| {count:,} | {copy:.3f} | {there:.3f} | {peak:.0f} | {here:.2f} |")
    return [*lines, ""]


def preset_table(device: torch.device, count: int, *, rho: float) -> list[str]:
    """Return a table of seconds of the presets that render the scene, after a warm-up."""
    scene = cvtgs.synthetic.scene("courtyard", count, sh_degree=0, seed=0).to(device)
    lines = [
        "| preset, Gaussians | seconds | views and their images s | steps s | steps | renderer |",
        "|---|---|---|---|---|---|",
    ]
    for settings in IMAGE_PRESETS:
        config = SimplifyConfig.from_mapping(settings)
        _, (report,) = repeat(scene, config, rho, device=device, runs=1)
        refined, costs = report.refinement, {one.stage: one.seconds for one in report.stages}
        assert refined is not None
        lines.append(
            f"| {config.preset}, {count:,} | {report.seconds:.2f} | {costs['visibility']:.2f} "
            f"| {costs['refine']:.2f} | {refined.steps} | {refined.backend} |"
        )
    return [*lines, ""]


def renderer_table(device: torch.device, count: int, *, size: int, runs: int) -> list[str]:
    """Return a table of seconds per image and gradient of each renderer that works there."""
    scene = cvtgs.synthetic.scene("courtyard", count, sh_degree=0, seed=0)
    cameras = automatic_views(scene, 1, width=size, height=size)
    scene, wanted = scene.to(device), None
    lines = ["| renderer | image s | with gradient s | largest difference |", "|---|---|---|---|"]
    for name in RENDERERS:
        try:
            choose_backend(name, device)
        except CvtgsError as error:
            lines.append(f"| {name} | not available: {error} | | |")
            continue

        def image(name: BackendName = name) -> torch.Tensor:
            with torch.no_grad():
                return render(scene, cameras, backend=name).rgb

        def gradient(name: BackendName = name) -> None:
            leaf = scene.sh0.detach().requires_grad_()
            moved = scene.with_tensors({"sh0": leaf}, scene.extras)
            render(moved, cameras, backend=name).rgb.square().sum().backward()

        found = image().cpu()
        wanted = found if wanted is None else wanted
        times = [
            statistics.median([seconds(work, device) for _ in range(runs + 1)][1:])
            for work in (image, gradient)
        ]
        difference = float((found - wanted).abs().amax())
        lines.append(f"| {name} | {times[0]:.4f} | {times[1]:.4f} | {difference:.1e} |")
    return [*lines, ""]


def training_table(device: torch.device, *, steps: int) -> list[str]:
    """Return a table of steps per second of both trainings on the device and on the CPU."""
    lines = ["| training | device steps/s | CPU steps/s |", "|---|---|---|"]
    data = DataConfig(generated=1, generated_validation=1, generated_counts=(CASE_COUNT,))
    for kind in TRAININGS:
        rates = []
        for where in (device, torch.device("cpu")):
            config = TrainConfig(
                kind=kind,
                steps=steps,
                validate_every=steps,
                data=data.model_copy(update={"ratios": (0.06,), "validation_ratios": (0.06,)}),
                views=ViewsConfig(count=2, sizes=(256,), validation_count=1, validation_size=64),
            )
            rates.append(steps_a_second(config, where))
        lines.append(f"| {kind} | {rates[0]:.2f} | {rates[1]:.2f} |")
    return [*lines, ""]


def steps_a_second(config: TrainConfig, device: torch.device) -> float:
    """Train, and return steps per second of wall-clock time after the first fifth."""
    times: list[float] = []

    def listen(event: ProgressEvent) -> None:
        if event.stage == "train":
            times.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as folder:
        files = TrainFiles.beside(Path(folder) / "net.safetensors")
        train(config, files, device=device, listener=listen)
    first = len(times) // 5
    return (len(times) - 1 - first) / (times[-1] - times[first])


def repeat(
    scene: GaussianScene,
    config: SimplifyConfig,
    rho: float,
    *,
    device: torch.device,
    runs: int,
) -> tuple[list[GaussianScene], list[SimplifyReport]]:
    """Simplify repeatedly; the first run loads kernels and counts only if it is the only one."""
    simplifier = Simplifier(config=config, device=device)
    results = [simplifier.run(scene, rho) for _ in range(runs + 1)]
    counted = results[1:] or results
    return [one.scene.to("cpu") for one in counted], [one.report for one in counted]


def stage_seconds(reports: Sequence[SimplifyReport]) -> dict[str, float]:
    """Return the median seconds of every stage, and of all together."""
    found = {
        stages[0].stage: statistics.median(one.seconds for one in stages)
        for stages in zip(*(report.stages for report in reports), strict=True)
    }
    return found | {"all": statistics.median(report.seconds for report in reports)}


def stage_peaks(reports: Sequence[SimplifyReport]) -> dict[str, int]:
    """Return the peak bytes of every stage on the device, and the largest of all."""
    found = {
        stages[0].stage: max(one.peak_device_memory_bytes for one in stages)
        for stages in zip(*(report.stages for report in reports), strict=True)
    }
    return found | {"all": max(found.values())}


def seconds(work: Callable[[], object], device: torch.device) -> float:
    """Return the wall-clock seconds of a function on a device."""
    start = time.perf_counter()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


def row(count: int, stage: str, found: float, peak: int | None, cpu: float | None) -> str:
    """Format a row of the table of stages; cells without a value stay empty."""
    memory = "" if peak is None else f"{peak / 1e6:.0f}"
    ratio = "" if cpu is None else f"{cpu / found:.1f}"
    beside = "" if cpu is None else f"{cpu:.3f}"
    return f"| {count:,} | {stage} | {found:.3f} | {memory} | {beside} | {ratio} |"


def equal(one: GaussianScene, other: GaussianScene) -> bool:
    """Return whether two scenes on the CPU have the same bits."""
    pairs = zip(one.tensors().values(), other.tensors().values(), strict=True)
    return all(torch.equal(first, second) for first, second in pairs)


if __name__ == "__main__":
    main()
