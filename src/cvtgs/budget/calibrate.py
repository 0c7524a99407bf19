"""Measure what the presets cost on this machine, on a few small generated scenes."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

from cvtgs.budget.cost_model import CostModel, Measurement
from cvtgs.budget.work import Work
from cvtgs.config import PRESETS, RefineConfig, Section, SimplifyConfig
from cvtgs.counts import target_count
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.report import StageCost
from cvtgs.scene import GaussianScene
from cvtgs.simplifier import Simplifier
from cvtgs.synthetic import scene as make

STAGE = "calibrate"

PATIENCE_SECONDS = 1.0
"""A measurement is repeated, and the fastest counts, until it has taken so long."""

MOST_REPEATS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A generated scene and how far to simplify it.

    Attributes:
        kind: Kind of the scene.
        count: Its Gaussians.
        sh_degree: Degree of its colours.
        ratios: Ratios to keep.
    """

    kind: str
    count: int
    sh_degree: int
    ratios: tuple[float, ...]


TRIALS = (
    Trial(kind="object", count=20_000, sh_degree=0, ratios=(0.02, 0.2)),
    Trial(kind="courtyard", count=60_000, sh_degree=3, ratios=(0.01, 0.2)),
    Trial(kind="room", count=200_000, sh_degree=1, ratios=(0.002, 0.05)),
)
"""Small and large, with few and many colours, a few and many cells: no two alike."""

CANDIDATES = tuple(name for name in PRESETS if name != "paper")
"""Presets to choose from; ``paper`` is there to compare with."""

SHORT = (
    {"views": 3, "steps": 8, "batch": 8, "heldout": 4},
    {"views": 6, "steps": 16, "batch": 16, "heldout": 4},
)
"""Images and refinements are cut to so many, in turn: what they cost grows with their number."""

MOST_START_SECONDS = 1.0
"""What takes longer to load was compiled, which happens once in the life of an installation."""

StageSeconds = Callable[[SimplifyConfig, GaussianScene, int], Mapping[str, float]]
"""Gives the seconds by stage of a simplification of a scene to so many Gaussians."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Task:
    preset: str
    config: SimplifyConfig
    scene: GaussianScene
    count: int

    def seconds(self, run: StageSeconds) -> Mapping[str, float]:
        return run(self.config, self.scene, self.count)


def measured_seconds(device: str | torch.device) -> StageSeconds:
    """Return a function that simplifies and measures."""
    simplifiers: dict[SimplifyConfig, Simplifier] = {}

    def run(config: SimplifyConfig, scene: GaussianScene, count: int) -> Mapping[str, float]:
        if config not in simplifiers:
            simplifiers[config] = Simplifier(config=config, device=device)
        report = simplifiers[config].run(scene, count=count).report
        return {cost.stage: undisturbed_seconds(cost) for cost in report.stages}

    return run


def undisturbed_seconds(cost: StageCost) -> float:
    """Return what a stage takes where no other program is in its way.

    A stage on the CPU computes all the time and reads no file, so it cannot take longer than its
    processor seconds; what is beyond them went to other programs.
    """
    if cost.peak_device_memory_bytes:
        return cost.seconds
    return min(cost.seconds, cost.cpu_seconds)


def calibrate(
    run: StageSeconds,
    *,
    presets: Sequence[str] = CANDIDATES,
    trials: Sequence[Trial] = TRIALS,
    clock: Callable[[], float] = time.perf_counter,
    listener: ProgressListener = silent,
) -> CostModel:
    """Measure presets on generated scenes, and fit what they cost.

    Every preset is run once to load what it needs. Then every trial is measured up to three times,
    once if that takes long; of each stage the fastest counts, since other programs only ever make
    a stage slower. Presets that take images take only a few here.
    """
    alike = _alike(presets)
    tasks = _tasks(list(dict.fromkeys(alike.values())), trials)
    total = MOST_REPEATS * len(tasks)
    listener(ProgressEvent(stage=STAGE, done=0, total=total))
    loaded: dict[str, float] = {}
    for task in tasks:
        if task.preset not in loaded:
            loaded[task.preset] = sum(task.seconds(run).values())
    best: list[dict[str, float]] = [{} for _ in tasks]
    spent = [0.0 for _ in tasks]
    for number in range(total):
        row = number % len(tasks)
        if spent[row] <= PATIENCE_SECONDS:
            begin = clock()
            for stage, seconds in tasks[row].seconds(run).items():
                best[row][stage] = min(seconds, best[row].get(stage, seconds))
            spent[row] += clock() - begin
        listener(ProgressEvent(stage=STAGE, done=number + 1, total=total))
    for task, stages in zip(tasks, best, strict=True):
        if task.scene is tasks[0].scene and task.count == tasks[0].count:
            excess = loaded[task.preset] - sum(stages.values())
            loaded[task.preset] = min(max(excess, 0.0), MOST_START_SECONDS)
    measured = {preset: _of(kind, tasks, best) for preset, kind in alike.items()}
    return CostModel.fit(measured, _starts(presets, loaded))


def _of(
    preset: str, tasks: Sequence[_Task], seconds: Sequence[Mapping[str, float]]
) -> list[Measurement]:
    return [
        Measurement(work=Work.of(task.scene, task.count), config=task.config, seconds=stages)
        for task, stages in zip(tasks, seconds, strict=True)
        if task.preset == preset
    ]


def _alike(presets: Sequence[str]) -> dict[str, str]:
    """Return for every preset the first that differs from it only in its number of images."""
    first: dict[SimplifyConfig, str] = {}
    for preset in presets:
        first.setdefault(_cut(preset, SHORT[0]).model_copy(update={"preset": ""}), preset)
    return {
        preset: first[_cut(preset, SHORT[0]).model_copy(update={"preset": ""})]
        for preset in presets
    }


def _tasks(presets: Sequence[str], trials: Sequence[Trial]) -> list[_Task]:
    scenes = [make(trial.kind, trial.count, sh_degree=trial.sh_degree) for trial in trials]
    return [
        _Task(
            preset=preset,
            config=_cut(preset, SHORT[number % len(SHORT)]),
            scene=scene,
            count=target_count(len(scene), rho),
        )
        for scene, trial in zip(scenes, trials, strict=True)
        for number, rho in enumerate(trial.ratios)
        for preset in presets
    ]


def _cut(preset: str, short: Mapping[str, int]) -> SimplifyConfig:
    """Return a preset that takes only a few images and steps, if it takes any."""
    config = SimplifyConfig.from_preset(preset)
    changes: dict[str, Section] = {}
    if config.uses_renders:
        changes["visibility"] = config.visibility.model_copy(update={"views": short["views"]})
    if config.refine.enabled:
        update = {name: short[name] for name in ("steps", "batch", "heldout")} | {"seconds": 0}
        update["half_after"] = RefineConfig().half_after  # it costs nothing
        changes["refine"] = config.refine.model_copy(update=update)
    return config.model_copy(update=changes)


def _starts(presets: Sequence[str], loading: Mapping[str, float]) -> dict[str, float]:
    """Return what a new process loads: the first preset shows it, and the first with images."""
    plain = next((s for name, s in loading.items() if not _takes_images(name)), 0.0)
    images = next((s for name, s in loading.items() if _takes_images(name)), 0.0)
    return {name: plain + images * _takes_images(name) for name in presets}


def _takes_images(preset: str) -> bool:
    config = SimplifyConfig.from_preset(preset)
    return config.uses_renders or config.refine.enabled
