"""One process per preset and ratio, so that seconds and memory are those that a user sees."""

import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from cvtgs.config import PRESETS
from cvtgs.counts import target_count
from cvtgs.errors import ConfigError, InvalidArgumentError, RunError
from cvtgs.progress import ProgressEvent, ProgressListener
from cvtgs.report import SimplifyReport
from cvtgs.tradeoff.processes import ProcessCost, run_process
from cvtgs.tradeoff.results import Failure

STAGE = "simplify"
WARNING = "cvtgs: warning: "

START = "import cvtgs.cli.main, cvtgs.config, cvtgs.io, cvtgs.mergenet, cvtgs.simplifier"
"""What every process does before it reads a scene."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What one process is to do.

    Attributes:
        preset: Name of the preset.
        rho: Ratio to keep.
    """

    preset: str
    rho: float

    @property
    def name(self) -> str:
        """Preset and ratio."""
        return f"{self.preset} {self.rho:g}"

    @property
    def file_name(self) -> str:
        """Name of the file that comes out."""
        return f"{self.preset}_{self.rho:g}.ply"


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """What one process did.

    Attributes:
        task: What it was to do.
        path: What it wrote.
        cost: What it cost.
        report: What it said.
    """

    task: Task
    path: Path
    cost: ProcessCost
    report: SimplifyReport


def tasks_of(presets: Sequence[str] | None, ratios: Sequence[float]) -> tuple[Task, ...]:
    """List what to run, ratio by ratio."""
    names = list(PRESETS) if presets is None else list(presets)
    for name in names:
        if name not in PRESETS:
            raise ConfigError(f"preset must be one of {', '.join(PRESETS)}; found {name!r}.")
    for rho in ratios:
        target_count(1, rho)
    tasks = tuple(Task(preset=name, rho=rho) for rho in ratios for name in names)
    if not tasks:
        raise InvalidArgumentError("give at least one preset and one ratio.")
    twice = [task.name for number, task in enumerate(tasks) if task in tasks[:number]]
    if twice:
        raise InvalidArgumentError(
            f"every preset and ratio must be given once, found {twice[0]} twice."
        )
    return tasks


def run_tasks(
    source: str | os.PathLike[str],
    tasks: Sequence[Task],
    folder: Path,
    *,
    device: str,
    listener: ProgressListener,
) -> Iterator[Run | Failure]:
    """Run every task in a process of its own, one after the other."""
    heard: set[str] = set()
    for done, task in enumerate(tasks):
        listener(ProgressEvent(stage=STAGE, done=done, total=len(tasks), note=task.name))
        try:
            run = run_task(source, task, folder, device=device)
        except RunError as error:
            yield Failure(name=task.name, reason=str(error))
        else:
            _pass_on(run.cost.errors, heard)
            yield run
    listener(ProgressEvent(stage=STAGE, done=len(tasks), total=len(tasks)))


def run_task(
    source: str | os.PathLike[str], task: Task, folder: Path, *, device: str = "auto"
) -> Run:
    """Run one task as ``cvtgs simplify`` does, in a process of its own."""
    path, report = folder / task.file_name, folder / f".{task.file_name}.json"
    words = ["--rho", repr(task.rho), "--preset", task.preset, "--device", device]
    words += ["--report", str(report), "--overwrite", "--quiet"]
    try:
        cost = run_process(
            [sys.executable, "-m", "cvtgs", "simplify", os.fspath(source), str(path), *words]
        )
        found = SimplifyReport.model_validate_json(report.read_bytes())
    finally:
        report.unlink(missing_ok=True)
    return Run(task=task, path=path, cost=cost, report=found)


def start_seconds() -> float:
    """Measure what a process costs before it reads a scene."""
    return run_process([sys.executable, "-c", START]).wall_seconds


def _pass_on(errors: str, heard: set[str]) -> None:
    """Report what a process warned of, once for all processes."""
    for line in errors.splitlines():
        if line.startswith(WARNING) and line not in heard:
            heard.add(line)
            warnings.warn(line.removeprefix(WARNING), UserWarning, stacklevel=2)
