"""Calibration: the cost of the presets on this machine, measured once and cached for the user."""

import hashlib
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import torch

import cvtgs
from cvtgs.budget.costs import COLORS, FEATURES, CostModel, Measurement, Work
from cvtgs.clock import StageCost, check_listener
from cvtgs.config import PRESETS, SimplifyConfig
from cvtgs.config.base import Record
from cvtgs.counts import target_count
from cvtgs.devices import chosen_device, device_name
from cvtgs.errors import OutputError, reason_of, warn
from cvtgs.io.atomic import write_atomically
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.scene import GaussianScene
from cvtgs.simplifier import Simplifier
from cvtgs.synthetic import scene as make

STAGE = "calibrate"

PATIENCE_SECONDS = 1.0  # total until which a measurement is repeated; the fastest counts
MOST_REPEATS = 3
MOST_CPU_SECONDS = 15.0  # after which nothing is repeated, and only mandatory trials are measured
LEAST_MEASURED = 3  # number of trials that are measured however long they take
MOST_START_SECONDS = 1.0  # for loading: what takes longer was compilation, once per installation

CANDIDATES = tuple(name for name in PRESETS if name != "paper")  # which is only for comparison
RENDERERS = ("gsplat", "numba")  # not imported to check, as that can outlast a run

VERSION: Literal[8] = 8  # of the cache file; raised when features change, to replace older files
SHIPPED_RATES = "rates.json"  # written by ``python -m benchmarks.cost_model --ship``
STALE_SECONDS = 90 * 24 * 3600.0  # since drivers, limits and other loads change
CPU_STEP = 1 / 64  # of a process's CPU seconds on Windows

StageSeconds = Callable[[SimplifyConfig, GaussianScene, int], Mapping[str, float]]
"""Returns the seconds, by stage, of the simplification of a scene to a target count."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A simplification of a generated scene, with square images and steps if the preset has any."""

    preset: str
    kind: str
    count: int
    sh_degree: int
    rho: float
    views: int = 0
    size: int = 0  # pixels
    steps: int = 0

    @property
    def work(self) -> Work:
        """The size of the simplification."""
        target = target_count(self.count, self.rho)
        return Work(count=self.count, target=target, colors=COLORS[self.sh_degree])

    @property
    def name(self) -> str:
        """A name of everything that is measured, also of what follows from the preset."""
        scene = f"{self.kind} of {self.count:,}, SH degree {self.sh_degree}"
        images = f"{self.views} images of {self.size}, {self.steps} steps"
        amounts = [
            f"{amount:.6g}"  # a logarithm has other last bits on other systems
            for stage in FEATURES
            for amount in self.work.features(stage, self.config).values()
        ]
        return f"{self.preset} at {self.rho}: {scene}; {images}; amounts {_digest(amounts)}"

    @property
    def config(self) -> SimplifyConfig:
        """The preset, with fewer and smaller images."""
        config = SimplifyConfig.from_preset(self.preset)
        if not config.uses_images:
            return config
        visibility = config.visibility.model_copy(update={"views": self.views, "size": self.size})
        exact = {"size": self.size, "steps": self.steps, "lengthening": 1.0}
        refine = config.refine.model_copy(update=exact)
        return config.model_copy(update={"visibility": visibility, "refine": refine})


# Small and large scenes, with few and many colour coefficients, and few and many cells. Of fewer
# than eight images, matching would hold out all instead of every eighth.
TRIALS = (
    Trial(preset="standard", kind="object", count=20_000, sh_degree=0, rho=0.15),
    Trial(
        preset="matched", kind="object", count=20_000, sh_degree=0, rho=0.15,
        views=8, size=256, steps=6,
    ),
    Trial(preset="standard", kind="room", count=100_000, sh_degree=3, rho=0.05),
    Trial(
        preset="matched", kind="courtyard", count=60_000, sh_degree=1, rho=0.2,
        views=8, size=352, steps=8,
    ),
    Trial(preset="standard", kind="courtyard", count=60_000, sh_degree=1, rho=0.01),
)  # fmt: skip

_UNSAVED: dict[Path, "CachedModel"] = {}  # measurements that could not be written, by their file


class CachedModel(Record, allow_inf_nan=False):
    """The content of the cache file."""

    version: Literal[8]
    key: dict[str, str]
    made: float
    model: CostModel


def cost_model(
    device: str | torch.device = "auto",
    *,
    recalibrate: bool = False,
    calibration: Callable[[], CostModel] | None = None,
    folder: str | os.PathLike[str] | None = None,
    listener: ProgressListener = silent,
) -> CostModel:
    """Return the cost of presets on this machine; the first call measures and caches it.

    It is measured again if the machine, the device, the number of threads, the versions of Python,
    torch or cvtgs, the installed renderers or the presets change, after 90 days, and if the cache
    file is damaged. If the file cannot be written, a warning says so, and this process keeps the
    result.

    Args:
        device: Device that the presets run on.
        recalibrate: Whether to measure again in any case.
        calibration: Function that measures; None for the real one, which takes about 10 seconds.
        folder: Cache folder; None for ``cvtgs`` in the user's cache folder.
        listener: Called with progress events.

    Raises:
        DeviceError: The device cannot be used.

    Example:
        >>> import tempfile
        >>> rates = {"check": {"in": 1e-6, "in_values": 0.0}}
        >>> with tempfile.TemporaryDirectory() as name:
        ...     model = cost_model(calibration=lambda: CostModel(rates=rates), folder=Path(name))
        >>> list(model.rates)
        ['check']
    """
    check_listener(listener)
    where = chosen_device(device)
    key = machine_key(where)
    path = _cache_path(key, folder)
    known = None if recalibrate else _read_cached(path, key)
    if known is not None:
        return known
    model = calibration() if calibration else calibrate(measured_seconds(where), listener=listener)
    record = CachedModel(version=VERSION, key=key, made=time.time(), model=model)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, record.to_json().encode(), overwrite=True)
        _UNSAVED.pop(path, None)
    except (OSError, OutputError) as error:
        _UNSAVED[path] = record
        is_own = isinstance(error, OutputError)
        reason = str(error) if is_own else f"{path.parent}: {reason_of(error)}"
        warn(f"the measurement of this machine is not saved, the next process repeats it: {reason}")
    return model


def shipped_model() -> CostModel:
    """Return the cost that comes with the package: of two cores of a server without a GPU.

    Example:
        >>> "tessellate" in shipped_model().rates
        True
    """
    text = files("cvtgs.budget").joinpath(SHIPPED_RATES).read_text(encoding="utf-8")
    return CostModel.model_validate_json(text)


def is_calibrated(
    device: str | torch.device = "auto", *, folder: str | os.PathLike[str] | None = None
) -> bool:
    """Check whether the cost model of this machine is cached."""
    key = machine_key(chosen_device(device))
    return _read_cached(_cache_path(key, folder), key) is not None


def machine_key(device: torch.device) -> dict[str, str]:
    """Return the properties of machine and software that run times depend on."""
    presets = {name: SimplifyConfig.from_preset(name).model_dump(mode="json") for name in PRESETS}
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": device_name(torch.device("cpu")),
        "cores": str(os.cpu_count()),
        "threads": str(torch.get_num_threads()),
        "device": "cpu" if device.type == "cpu" else device_name(device),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "cvtgs": cvtgs.__version__,
        "renderers": ", ".join(name for name in RENDERERS if find_spec(name)),
        "presets": _digest(presets),
    }


def cache_folder() -> Path:
    """Return the folder of cvtgs in the user's cache."""
    named = Path(os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or ".")
    if named.is_absolute():  # others are invalid (XDG Base Directory Specification)
        return named / "cvtgs"
    home = Path(os.path.expanduser("~"))  # noqa: PTH111 (Path.home() fails where there is none)
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "cvtgs"


def _cache_path(key: Mapping[str, str], folder: str | os.PathLike[str] | None) -> Path:
    return Path(folder or cache_folder()) / f"cost-{_digest(key)}.json"


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def _read_cached(path: Path, key: Mapping[str, str]) -> CostModel | None:
    """Read the cached model; None if it is missing, damaged, stale or made for another key."""
    try:
        record = _UNSAVED.get(path) or CachedModel.model_validate_json(path.read_bytes())
    except (OSError, ValueError):
        return None
    fresh = 0 <= time.time() - record.made < STALE_SECONDS
    complete = set(FEATURES) <= set(record.model.rates)
    return record.model if fresh and complete and record.key == key else None


def measured_seconds(device: str | torch.device) -> StageSeconds:
    """Return a function that simplifies a scene and returns the seconds of each stage."""
    simplifier = cache(partial(Simplifier, device=device))

    def run(config: SimplifyConfig, scene: GaussianScene, count: int) -> Mapping[str, float]:
        report = simplifier(config=config).run(scene, count=count).report
        return {cost.stage: undisturbed_seconds(cost) for cost in report.stages}

    return run


def undisturbed_seconds(cost: StageCost) -> float:
    """Return the seconds of a stage without the time that other programs took."""
    # A stage on the CPU computes all the time and reads no file, so what it takes beyond its CPU
    # seconds went to other programs. On Windows, these advance in steps.
    is_short = sys.platform == "win32" and cost.seconds < 4 * CPU_STEP
    if cost.peak_device_memory_bytes or is_short:
        return cost.seconds
    return min(cost.seconds, cost.cpu_seconds)


def calibrate(
    run: StageSeconds,
    *,
    prior: CostModel | None = None,
    trials: Sequence[Trial] = TRIALS,
    clock: Callable[[], float] = time.perf_counter,
    cpu: Callable[[], float] = time.process_time,
    listener: ProgressListener = silent,
) -> CostModel:
    """Measure simplifications of generated scenes, and fit their cost.

    Rates that the measurements leave open are those of ``prior``; None is the shipped model.
    """
    made = cache(make)
    scenes = [made(trial.kind, trial.count, sh_degree=trial.sh_degree) for trial in trials]
    works = [trial.work for trial in trials]
    total, begun = MOST_REPEATS * len(trials), cpu()

    def measure(row: int, done: int, text: str) -> Mapping[str, float]:
        trial, work = trials[row], works[row]
        note = f"{text} {trial.preset}, {work.count:,} to {work.target:,} Gaussians"
        listener(ProgressEvent(stage=STAGE, done=done, total=total, note=note))
        return run(trial.config, scenes[row], work.target)

    # The first trial without images, and the first with some, also run to load their libraries.
    first = {trials[row].config.uses_images: row for row in reversed(range(len(trials)))}
    loading = {row: sum(measure(row, 0, "load preset").values()) for row in sorted(first.values())}
    best: list[dict[str, float]] = [{} for _ in trials]
    spent = [0.0 for _ in trials]
    for number in range(total):
        row = number % len(trials)
        if spent[row] <= PATIENCE_SECONDS and (
            number < LEAST_MEASURED or cpu() - begun <= MOST_CPU_SECONDS
        ):
            begin = clock()
            for stage, seconds in measure(row, number, "preset").items():
                # Other programs can only slow it down.
                best[row][stage] = min(seconds, best[row].get(stage, seconds))
            spent[row] += clock() - begin
        listener(ProgressEvent(stage=STAGE, done=number + 1, total=total))
    prior = prior or shipped_model()
    taken, measured = dict[str, dict[str, float]](), list[Measurement]()
    for trial, work, stages in zip(trials, works, best, strict=True):
        if stages:
            taken[trial.name] = stages
            here = Measurement(work=work, config=trial.config, seconds=stages)
            measured.append(_without_misfit(here, prior.trials.get(trial.name, {}), prior))
    starts = {
        with_images: min(max(loading[row] - sum(best[row].values()), 0.0), MOST_START_SECONDS)
        for with_images, row in first.items()
    }
    model = CostModel.fit(
        measured, prior=prior, start=starts.get(False, 0.0), image_start=starts.get(True, 0.0)
    )
    return model.model_copy(update={"trials": taken})


def _without_misfit(here: Measurement, there: Mapping[str, float], prior: CostModel) -> Measurement:
    """Replace the seconds of a trial by those that the prior would predict at this speed."""
    # The prior does not fit each trial exactly, so a trial that takes longer than it predicts may
    # take as long as on the machine of the prior: only the ratio of both tells the speed.
    predicted = prior.stage_seconds(here.work, here.config)
    seconds = {
        stage: predicted[stage] * one / there[stage]
        if stage in predicted and there.get(stage)
        else one
        for stage, one in here.seconds.items()
    }
    return replace(here, seconds=seconds)
