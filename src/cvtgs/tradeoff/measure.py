"""Measure cost and quality of every preset on one scene, each run in a process of its own."""

import os
import platform
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.clock import check_listener
from cvtgs.config import PRESETS, SimplifyConfig
from cvtgs.config.simplify import unknown_preset
from cvtgs.counts import written_ratios
from cvtgs.devices import chosen_device, device_name
from cvtgs.errors import InvalidArgumentError, RunError, warn
from cvtgs.evaluation import Comparison, EvaluationSettings, compare
from cvtgs.evaluation.compare import check_scores
from cvtgs.io import load, load_cameras, scene_file, scene_size
from cvtgs.io.atomic import atomic_output, check_outputs
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.report import SimplifyReport
from cvtgs.scene import GaussianScene
from cvtgs.text import counted, printable_name, shown
from cvtgs.tradeoff.process_cost import ProcessCost, pass_warnings_on, run_process, start_seconds
from cvtgs.tradeoff.results import Failure, Tradeoff, TradeoffResult, with_fronts
from cvtgs.views import automatic_views, find_own_cameras

STAGE = "simplify"
RATIOS = (0.1, 0.01, 0.001)


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


def tasks_of(presets: Sequence[str] | None, rhos: Sequence[float]) -> tuple[Task, ...]:
    """Check presets and ratios, and list the runs, ratio by ratio."""
    if isinstance(presets, str) or not isinstance(presets, Sequence | None):
        raise InvalidArgumentError(f"presets must be a list of names, found {shown(presets)}.")
    tasks: dict[str, Task] = {}  # by name, whose ratios have 15 digits
    for rho in written_ratios(rhos):
        for preset in PRESETS if presets is None else presets:
            if preset not in PRESETS:
                raise unknown_preset(preset)
            task = Task(preset=preset, rho=rho)
            if task.name in tasks:
                raise InvalidArgumentError(
                    f"every preset and ratio must be given once, found {task.name} twice."
                )
            tasks[task.name] = task
    if not tasks:
        raise InvalidArgumentError("give at least one preset and one ratio.")
    return tuple(tasks.values())


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
    """Run ``cvtgs simplify`` in its own process.

    Presets that use images are fitted to the training split of ``training``, or find cameras.
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


def run_tasks(
    tasks: Sequence[Task],
    run: Callable[[Task], Run],
    *,
    unnamed: str,
    listener: ProgressListener,
) -> tuple[list[Run], list[Failure]]:
    """Run all tasks, and warn of those that fail, without the folder ``unnamed`` in their reasons.

    Raise if all fail.
    """
    runs, failures, warned = list[Run](), list[Failure](), set[str]()
    for done, task in enumerate(tasks):
        listener(ProgressEvent(stage=STAGE, done=done, total=len(tasks), note=task.name))
        try:
            runs.append(run(task))
        except RunError as error:
            reason = str(error).replace(unnamed, "")
            failures.append(
                Failure(name=task.name, preset=task.preset, rho=task.rho, reason=reason)
            )
        else:
            pass_warnings_on(runs[-1].cost.errors, warned)
    listener(ProgressEvent(stage=STAGE, done=len(tasks), total=len(tasks)))
    if failures and not runs:
        raise RunError(f"every run failed; {failures[0].name}: {failures[0].reason}")
    for failure in failures:
        warn(f"{failure.name} failed: {failure.reason}")
    return runs, failures


def keep_results(runs: Sequence[Run], folder: Path) -> None:
    """Move the results of all runs to a folder; replaced files keep their links and permissions."""
    for run in runs:
        with (
            run.path.open("rb") as file,
            atomic_output(folder / run.path.name, overwrite=True) as output,
        ):
            shutil.copyfileobj(file, output)
        run.path.unlink()


def count_shared(views: Cameras, training: Path | None) -> int:
    """Count the views that the training split has, too, which presets with images learn from."""
    learned = load_cameras(training, split="train").viewmats.tolist() if training else []
    return sum(pose in learned for pose in views.viewmats.tolist())


def results_of(runs: Sequence[Run], comparison: Comparison) -> tuple[TradeoffResult, ...]:
    """Join the costs and the scores of every run, and mark what nothing else surpasses."""
    results = [
        TradeoffResult(
            name=run.task.name,
            preset=run.task.preset,
            rho=run.task.rho,
            count=scores.count,
            bytes=comparison.sizes[run.task.name],
            seconds=run.cost.wall_seconds,
            peak_memory_bytes=run.cost.peak_memory_bytes,
            report=run.report,
            **scores.means(),
        )
        for run, scores in zip(runs, comparison.evaluation.scenes, strict=True)
    ]
    return tuple(with_fronts(results))


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
    rhos: Sequence[float] = RATIOS,
    cameras: Callable[[GaussianScene], Cameras] = automatic_views,
    photographs: Callable[[Cameras], Float[Tensor, "c h w 3"]] | None = None,
    settings: EvaluationSettings = EvaluationSettings(),  # noqa: B008 (frozen)
    device: str | torch.device = "auto",
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
        rhos: Ratios of Gaussians to keep, each in (0, 1].
        cameras: Returns the views of the scene.
        photographs: Returns their photographs, to score all scenes against too; None for none.
        settings: Background, LPIPS network and backend.
        device: Any torch device, or ``auto``.
        folder: Folder to keep the results in, made if it is missing, as ``fast_0.01.ply``; files
            of the same name are replaced, none before all are measured. None keeps no results.
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
        ...     found = measure_tradeoff(path, presets=["standard"], rhos=[0.1], cameras=look)
        >>> [(result.name, result.count) for result in found.tradeoff.results]
        [('standard 0.1', 50)]
    """
    tasks = tasks_of(presets, rhos)
    check_listener(listener)
    if not callable(cameras):
        raise InvalidArgumentError(
            f"cameras must be a function that returns the views of a scene, found {shown(cameras)}."
        )
    where = chosen_device(device)
    if folder is not None:
        check_outputs(folder, [task.file_name for task in tasks], overwrite=True)
        check_results(source, Path(folder), tasks)
    full, source_name = load(source, trust_sizes=trust_sizes), printable_name(Path(source).name)
    full = full.to(where)
    views, own = cameras(full), find_own_cameras(full, source)
    truths = None if photographs is None else photographs(views)
    check_scores(full, views, photographs=truths, settings=settings, name=source_name)
    training = own.source if own is not None and own.test_cameras() is not None else None
    shared = count_shared(views, training)
    if shared and any(task.uses_images for task in tasks):
        warn(
            f"presets that use images are fitted to {shared} of the {counted(len(views), 'view')} "
            f"that score, which favours them; the test split of {training} has other views."
        )
    with TemporaryDirectory(prefix="cvtgs-" if folder is None else ".cvtgs-", dir=folder) as name:
        place = Path(name)
        start = start_seconds()
        run = partial(
            run_task,
            source,
            folder=place,
            training=training,
            device=str(device),
            trust_sizes=trust_sizes,
        )
        runs, failures = run_tasks(tasks, run, unnamed=f"{place}{os.sep}", listener=listener)
        sizes = {run.task.name: run.path.stat().st_size for run in runs}
        comparison = compare(
            full,
            {run.task.name: load(run.path).to(where) for run in runs},
            views,
            reference_name=source_name,
            sizes=sizes | {source_name: scene_size(source)},
            photographs=truths,
            settings=settings,
            listener=listener,
        )
        if folder is not None:
            keep_results(runs, Path(folder))
    tradeoff = Tradeoff(
        source=source_name,
        source_count=len(full),
        source_bytes=comparison.sizes[source_name],
        start_seconds=start,
        machine=f"{device_name(where)}, {os.cpu_count()} cores, "
        f"Python {platform.python_version()}, torch {torch.__version__}",
        evaluation=comparison.evaluation,
        results=results_of(runs, comparison),
        failures=tuple(failures),
        held_out=training is not None and not shared,
    )
    return Measured(tradeoff, comparison)
