"""Measure cost and quality of every preset on one scene, each run in a process of its own."""

import os
import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.config import PRESETS, SimplifyConfig
from cvtgs.config.simplify import unknown_preset
from cvtgs.counts import written_ratios
from cvtgs.devices import chosen_device, device_name
from cvtgs.errors import InvalidArgumentError, RunError, warn
from cvtgs.evaluation import Comparison, EvaluationSettings, compare
from cvtgs.evaluation.scorer import mean_of
from cvtgs.io import load, load_cameras, scene_file, scene_size
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.report import SimplifyReport
from cvtgs.scene import GaussianScene
from cvtgs.text import counted, printable_name
from cvtgs.tradeoff.results import Failure, Tradeoff, TradeoffResult, with_fronts
from cvtgs.views import automatic_views, find_own_cameras

WARNING = "cvtgs: warning: "

START = """
import gc, cvtgs.cli.main, cvtgs.startup
cvtgs.startup.load_torch()
import cvtgs.config, cvtgs.io, cvtgs.mergenet, cvtgs.simplifier
gc.freeze()
"""
"""What every process does besides work on a scene: it loads modules as the command line does."""

# A process inherits the peak memory of its parent, so this small launcher starts the command. On an
# interrupt, which the child receives too, it keeps waiting for the child. When its own parent ends
# or closes the pipe, for whatever reason, it terminates the child.
LAUNCHER = """
import os, signal, subprocess, sys, threading, time
signal.signal(signal.SIGINT, lambda *_: None)
start = time.perf_counter()
process = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)
def end():
    os.read(0, 1)
    process.terminate()
threading.Thread(target=end, daemon=True).start()
signal.signal(signal.SIGTERM, lambda *_: process.terminate())
code = process.wait()
wall = time.perf_counter() - start
try:
    import resource
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    user, peak = usage.ru_utime, usage.ru_maxrss
except ImportError:
    user = peak = 0
sys.stdout.write(f"\\n{code} {user} {wall} {peak}\\n")
"""

STAGE = "simplify"
RATIOS = (0.1, 0.01, 0.001)

CameraChoice = Callable[[GaussianScene], Cameras]  # function that returns the views of a scene

PhotographChoice = Callable[[Cameras], Float[Tensor, "c h w 3"]]
"""Function that returns the photograph of every camera, at the size of the cameras."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessCost:
    """The cost of one process, its stdout and its stderr; Windows reports no peak memory: 0."""

    wall_seconds: float
    user_seconds: float
    peak_memory_bytes: int
    output: str
    errors: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A preset and a ratio to run."""

    preset: str
    rho: float

    @property
    def name(self) -> str:
        """Preset and ratio."""
        return f"{self.preset} {self.rho:.15g}"

    @property
    def file_name(self) -> str:
        """Name of the output file."""
        return f"{self.preset}_{self.rho:.15g}.ply"

    @property
    def uses_images(self) -> bool:
        """Whether the preset renders images of the scene."""
        return SimplifyConfig.from_preset(self.preset).uses_images


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """A finished run: its output file, the cost of its process, and the report."""

    task: Task
    path: Path
    cost: ProcessCost
    report: SimplifyReport


def tasks_of(presets: Sequence[str] | None, ratios: Sequence[float]) -> tuple[Task, ...]:
    """Check presets and ratios, and list the runs, ratio by ratio."""
    names = list(PRESETS) if presets is None else list(presets)
    for name in names:
        if name not in PRESETS:
            raise unknown_preset(name)
    tasks = tuple(Task(preset=name, rho=rho) for rho in written_ratios(ratios) for name in names)
    if not tasks:
        raise InvalidArgumentError("give at least one preset and one ratio.")
    twice = [task.name for number, task in enumerate(tasks) if task in tasks[:number]]
    if twice:
        raise InvalidArgumentError(
            f"every preset and ratio must be given once, found {twice[0]} twice."
        )
    return tasks


def check_results(source: str | os.PathLike[str], folder: Path, tasks: Sequence[Task]) -> None:
    """Raise if a result would replace the scene, which all tasks read."""
    file = scene_file(source)
    for task in tasks:
        path = folder / task.file_name
        if path.exists() and file.exists() and path.samefile(file):
            raise InvalidArgumentError(
                f"{path}: a result must not replace the scene that all presets simplify; choose "
                f"another folder."
            )


def run_task(
    source: str | os.PathLike[str],
    task: Task,
    folder: Path,
    *,
    training: Path | None = None,
    device: str = "auto",
    trust_sizes: bool = False,
) -> Run:
    """Run one task by ``cvtgs simplify`` in its own process.

    ``training`` has the cameras to whose training split presets that use images are fitted; without
    it, these presets find their cameras themselves.
    """
    path, report = folder / task.file_name, folder / f".{task.file_name}.json"
    words = ["--rho", repr(task.rho), "--preset", task.preset, "--device", device]
    words += [f"--report={report}", "--overwrite", "--quiet"]  # names may begin with a dash
    words += ["--trust-sizes"] * trust_sizes
    if training is not None and task.uses_images:
        words += [f"--cameras={training}", "--split", "train"]
    words += ["--", os.fspath(source), str(path)]
    try:
        cost = run_process([sys.executable, "-m", "cvtgs", "simplify", *words])
        found = SimplifyReport.model_validate_json(report.read_bytes())
    finally:
        report.unlink(missing_ok=True)
    return Run(task=task, path=path, cost=cost, report=found)


def start_seconds() -> float:
    """Measure the seconds that a process takes before it reads a scene; the first may be cold."""
    return min(run_process([sys.executable, "-c", START]).wall_seconds for _ in range(2))


def pass_warnings_on(errors: str, warned: set[str]) -> None:
    """Repeat the warnings of a process, except those in ``warned``, which is updated."""
    for line in errors.splitlines():
        if line.startswith(WARNING) and line not in warned:
            warned.add(line)
            warn(line.removeprefix(WARNING))


def run_process(command: Sequence[str]) -> ProcessCost:
    r"""Run a command to its end and measure it.

    If this call is interrupted, the process is terminated first. Lines of its output end with
    ``\n``, and Python writes it as UTF-8, on Windows too.
    """
    launcher = [sys.executable, "-S", "-c", LAUNCHER, *command]
    reading, writing = os.pipe()
    with os.fdopen(writing, "wb") as held:
        with os.fdopen(reading, "rb") as watched:
            process = subprocess.Popen(
                launcher,
                stdin=watched,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env={**os.environ, "PYTHONIOENCODING": "utf-8"},
            )
        with process:
            try:
                written = process.communicate()
            except BaseException:
                held.close()
                process.communicate()
                raise
    texts = (part.decode(errors="replace") for part in written)
    output, errors = (text.replace("\r\n", "\n") for text in texts)
    output, _, line = output.rstrip("\n").rpartition("\n")
    try:
        code, user, wall, peak = (float(word) for word in line.split())
    except ValueError:
        raise RunError(f"{command[0]} could not be started: {_last_line(errors)}.") from None
    if code < 0:
        raise RunError(f"it was ended by signal {-code:.0f}; 9 often means that memory ran out.")
    if code:
        raise RunError(_last_line(errors) or f"it ended with exit code {code:.0f}.")
    unit = 1 if sys.platform == "darwin" else 1024
    return ProcessCost(
        wall_seconds=wall,
        user_seconds=user,
        peak_memory_bytes=int(peak) * unit,
        output=output,
        errors=errors,
    )


def _last_line(errors: str) -> str:
    lines = [line for line in errors.splitlines() if line.strip()]
    return lines[-1].removeprefix("cvtgs: error: ") if lines else ""


def _shared(views: Cameras, training: Path) -> int:
    """Return how many of some views are of training cameras."""
    cameras = load_cameras(training, split="train")
    learned, shown = ({*map(str, one.viewmats.tolist())} for one in (cameras, views))
    return len(learned & shown)


class Measured(NamedTuple):
    """The measurements, and images of the scenes.

    Attributes:
        tradeoff: Costs and scores.
        comparison: Images of the full scene and of all results.
    """

    tradeoff: Tradeoff
    comparison: Comparison


def measure_tradeoff(  # noqa: PLR0913 (options by name)
    source: str | os.PathLike[str],
    *,
    presets: Sequence[str] | None = None,
    ratios: Sequence[float] = RATIOS,
    cameras: CameraChoice = automatic_views,
    photographs: PhotographChoice | None = None,
    settings: EvaluationSettings = EvaluationSettings(),  # noqa: B008 (frozen)
    device: str = "auto",
    folder: str | os.PathLike[str] | None = None,
    trust_sizes: bool = False,
    listener: ProgressListener = silent,
) -> Measured:
    """Simplify a file with several presets, and measure cost and quality of each.

    Each run is a separate process, ``cvtgs simplify``, so that seconds and memory are those that
    users see. Then all results are rendered from the same views. A run that fails causes a warning
    and is listed; the others go on.

    Presets that use images are fitted to the cameras beside the source, but not to their test split
    (:meth:`cvtgs.views.OwnCameras.test_cameras`), if there is one. Score by this split, so that no
    preset is scored by what it learned from.

    Memory: that of :func:`cvtgs.evaluation.compare` in this process, plus that of one run at a
    time.

    Args:
        source: The full scene.
        presets: Names of presets; None for all, from the fastest to the best.
        ratios: Ratios of Gaussians to keep, each in (0, 1].
        cameras: Returns the views of the scene.
        photographs: Returns their photographs, to score all scenes against too; None for none.
        settings: Background, LPIPS network and backend.
        device: ``auto``, ``cpu`` or ``cuda``.
        folder: Folder to keep the results in, as ``fast_0.01.ply``; files of the same name are
            replaced. None keeps no results.
        trust_sizes: Whether to believe a compressed source that claims far more Gaussians than its
            bytes can hold.
        listener: Called after each run and image.

    Returns:
        Costs, scores and images.

    Raises:
        CvtgsError: The scene cannot be read, a preset or ratio is invalid, or a result would
            replace the scene.
        RunError: All runs failed.

    Example:
        >>> from cvtgs.io import save
        >>> from cvtgs.synthetic import scene as make
        >>> def look(scene):
        ...     return automatic_views(scene, 2, width=32, height=24)
        >>> with TemporaryDirectory() as name:
        ...     path = Path(name) / "full.ply"
        ...     save(make("object", 500, sh_degree=0), path)
        ...     found = measure_tradeoff(path, presets=["standard"], ratios=[0.1], cameras=look)
        >>> [(result.name, result.count) for result in found.tradeoff.results]
        [('standard 0.1', 50)]
    """
    tasks = tasks_of(presets, ratios)
    if folder is not None:
        check_results(source, Path(folder), tasks)
    where = chosen_device(device)
    full = load(source, trust_sizes=trust_sizes).to(where)
    views, own = cameras(full), find_own_cameras(full, source)
    training = own.source if own is not None and own.test_cameras() is not None else None
    shared = 0 if training is None else _shared(views, training)
    if shared and any(task.uses_images for task in tasks):
        warn(
            f"presets that use images are fitted to {shared} of the {counted(len(views), 'view')} "
            f"that score, which favours them; the test split of {training} has other views."
        )
    kept = None if folder is None else nullcontext(folder)
    with kept or TemporaryDirectory(prefix="cvtgs-") as name:
        place = Path(name)
        start = start_seconds()
        runs, failures, warned = list[Run](), list[Failure](), set[str]()
        for done, task in enumerate(tasks):
            listener(ProgressEvent(stage=STAGE, done=done, total=len(tasks), note=task.name))
            try:
                run = run_task(
                    source, task, place, training=training, device=device, trust_sizes=trust_sizes
                )
            except RunError as error:
                failures.append(Failure(name=task.name, reason=str(error)))
            else:
                runs.append(run)
                pass_warnings_on(run.cost.errors, warned)
        listener(ProgressEvent(stage=STAGE, done=len(tasks), total=len(tasks)))
        if failures and not runs:
            raise RunError(f"every run failed; {failures[0].name}: {failures[0].reason}")
        for failure in failures:
            warn(f"{failure.name} failed: {failure.reason}")
        sizes = {run.task.name: run.path.stat().st_size for run in runs}
        source_name = printable_name(Path(source).name)
        comparison = compare(
            full,
            {run.task.name: load(run.path).to(where) for run in runs},
            views,
            reference_name=source_name,
            sizes=sizes | {source_name: scene_size(source)},
            photographs=None if photographs is None else photographs(views),
            settings=settings,
            listener=listener,
        )
    results = [
        TradeoffResult(
            name=run.task.name,
            preset=run.task.preset,
            rho=run.task.rho,
            count=scores.count,
            bytes=sizes[run.task.name],
            seconds=run.cost.wall_seconds,
            peak_memory_bytes=run.cost.peak_memory_bytes,
            psnr=scores.psnr.mean,
            ssim=scores.ssim.mean,
            lpips=mean_of(scores.lpips),
            alpha_error=mean_of(scores.alpha_error),
            alpha_bias=mean_of(scores.alpha_bias),
            report=run.report,
        )
        for run, scores in zip(runs, comparison.evaluation.scenes, strict=True)
    ]
    tradeoff = Tradeoff(
        source=source_name,
        source_count=len(full),
        source_bytes=comparison.sizes[source_name],
        start_seconds=start,
        machine=f"{device_name(where)}, {os.cpu_count()} cores, "
        f"Python {platform.python_version()}, torch {torch.__version__}",
        evaluation=comparison.evaluation,
        results=tuple(with_fronts(results)),
        failures=tuple(failures),
        held_out=training is not None and not shared,
    )
    return Measured(tradeoff, comparison)
