"""Compare seconds predicted by the cost model of ``--time-budget`` with measured seconds.

``python -m benchmarks.cost_model`` simplifies generated scenes of kinds, seeds and sizes that the
calibration has not seen, with every preset to choose from. Each run is a separate process. The
script prints predicted and measured seconds as Markdown. Of several runs the fastest counts, as in
the calibration, since other programs only make runs slower. On a constantly busy machine,
``--clock undisturbed`` subtracts the time of other programs, stage by stage. ``--ship`` measures
this machine for minutes, and writes the rates that a calibration starts from.
"""

import argparse
import statistics
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import cvtgs
from benchmarks.measuring import generated_scenes, machine
from cvtgs import budget
from cvtgs.budget import CostModel, Work, cost_model
from cvtgs.budget.calibrate import (
    CANDIDATES,
    SHIPPED_RATES,
    TRIALS,
    Trial,
    calibrate,
    measured_seconds,
    undisturbed_seconds,
)
from cvtgs.clock import StageCost
from cvtgs.tradeoff.measure import Task, run_task

SCENES = (
    ("object", 50_000, 2),
    ("landscape", 150_000, 0),
    ("haze", 300_000, 3),
    ("courtyard", 1_000_000, 1),
)
RATIOS = (0.1, 0.01)
SEED = 11
SHIPPED_RATIOS = {"standard": (0.3, 0.1, 0.01, 0.001), "draft": RATIOS, "matched": RATIOS}
MOST_WITH_IMAGES = 300_000
CLOCKS: Mapping[str, Callable[[StageCost], float]] = {
    "wall": attrgetter("seconds"),
    "undisturbed": undisturbed_seconds,
}
LIMIT = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Predicted and measured seconds of one preset on one scene."""

    scene: str
    preset: str
    rho: float
    predicted: float
    measured: float

    @property
    def error(self) -> float:
        """Return the error relative to the measured seconds."""
        return self.predicted / self.measured - 1


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="PLYs; generated scenes if none")
    parser.add_argument("--rho", type=float, nargs="+", default=list(RATIOS))
    parser.add_argument("--presets", nargs="+", choices=CANDIDATES, default=list(CANDIDATES))
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--most", type=int, default=1_000_000, help="largest generated scene")
    parser.add_argument("--clock", choices=CLOCKS, default="wall", help="kind of seconds")
    parser.add_argument("--recalibrate", action="store_true", help="ignore the stored rates")
    parser.add_argument(
        "--ship", action="store_true", help="write the rates that --shipped-rates uses"
    )
    options = parser.parse_args(arguments)
    if options.ship:
        path = Path(budget.__file__).with_name(SHIPPED_RATES)
        text = shipped_rates().model_dump_json(indent=1)
        path.write_text(text + "\n", encoding="utf-8")
        print(f"{machine()}; wrote {path}")
        return
    scenes = [scene for scene in SCENES if scene[1] <= options.most]
    if not (options.files or scenes):
        least = min(scene[1] for scene in SCENES)
        parser.error(f"--most must be at least {least:,}; found {options.most:,}.")
    model = cost_model(recalibrate=options.recalibrate)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = options.files or generated_scenes(folder, scenes, seed=SEED)
        rows = [row for file in files for row in measured(file, folder, model, options)]
    print(f"{machine()}; {options.clock} seconds, the fastest of {options.runs} runs\n")
    print(report(rows))


def shipped_rates() -> CostModel:
    """Measure scenes of all sizes in full, and what a calibration measures, without a prior."""
    trials = [
        Trial(preset=preset, kind=kind, count=count, sh_degree=degree, rho=rho, **images(preset))
        for preset, ratios in SHIPPED_RATIOS.items()
        for kind, count, degree in SCENES
        for rho in ratios
        if count <= MOST_WITH_IMAGES or not images(preset)
    ]
    trials += TRIALS
    kind, count, degree = SCENES[1]
    trials.append(
        Trial(preset="high", kind=kind, count=count, sh_degree=degree, rho=0.01, **images("high"))
    )
    model = calibrate(
        measured_seconds("cpu"), prior=CostModel(rates={}), trials=trials, cpu=lambda: 0.0
    )
    of_calibrations = {trial.name: model.trials[trial.name] for trial in TRIALS}
    return model.model_copy(update={"trials": of_calibrations})


def images(preset: str) -> dict[str, int]:
    """Return number and size of a preset's images, and its steps; nothing if it uses none."""
    config = cvtgs.SimplifyConfig.from_preset(preset)
    seen, refine = config.visibility, config.refine
    return {"views": seen.views, "size": seen.size, "steps": refine.steps} if seen.views else {}


def measured(file: Path, folder: Path, model: CostModel, options: argparse.Namespace) -> list[Row]:
    """Measure every preset and ratio on one file."""
    scene = cvtgs.load(file)
    rows = []
    for rho in options.rho:
        work = Work.of(scene, cvtgs.target_count(len(scene), rho))
        for preset in options.presets:
            task = Task(preset=preset, rho=rho)
            runs = [run_task(file, task, folder).report.stages for _ in range(options.runs)]
            seconds = [sum(map(CLOCKS[options.clock], stages)) for stages in runs]
            rows.append(
                Row(
                    scene=file.stem,
                    preset=preset,
                    rho=rho,
                    predicted=model.seconds(work, cvtgs.SimplifyConfig.from_preset(preset)),
                    measured=min(seconds),
                )
            )
    return rows


def report(rows: Sequence[Row]) -> str:
    """Return the table and its summary."""
    lines = [
        "| scene | rho | preset | predicted s | measured s | error |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.scene} | {row.rho:g} | {row.preset} | {row.predicted:.2f} | {row.measured:.2f} "
        f"| {row.error:+.0%} |"
        for row in rows
    ]
    within = sum(abs(row.error) <= LIMIT for row in rows)
    worst = max(rows, key=lambda row: abs(row.error))
    median = statistics.median(abs(row.error) for row in rows)
    lines += [
        "",
        f"{within} of {len(rows)} predictions are within {LIMIT:.0%}; the median error is "
        f"{median:.0%}, the largest {worst.error:+.0%} ({worst.preset} on {worst.scene}).",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
