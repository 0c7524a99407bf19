"""The results of a tradeoff: cost and quality of every preset on one scene."""

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cvtgs.config.base import Record
from cvtgs.evaluation import Evaluation
from cvtgs.report import SimplifyReport


class TradeoffResult(Record):
    """Cost and quality of one run of one preset.

    Attributes:
        name: Preset and ratio, for example ``fast 0.01``; also its name in the evaluation.
        preset: Name of the preset.
        rho: Requested ratio.
        count: Number of Gaussians in the result.
        bytes: Size of the output file.
        seconds: Wall-clock seconds of the whole process, from its start to its end.
        peak_memory_bytes: Its peak resident size; 0 where the system does not report it.
        psnr: Mean over the views, dB; infinite if images are equal.
        ssim: Mean over the views.
        lpips: Mean over the views; None if it was not measured.
        alpha_error: Mean absolute difference of accumulated alpha over the views.
        alpha_bias: Mean of accumulated alpha minus that of the full scene; negative if more of
            the background shows through.
        fronts: Metrics by which no run of this ratio beats it: of ``psnr``, ``ssim``, ``lpips``.
        report: The report of the simplification, with seconds and peak memory per stage.
    """

    name: str
    preset: str
    rho: float
    count: int
    bytes: int
    seconds: float
    peak_memory_bytes: int
    psnr: float
    ssim: float
    lpips: float | None = None
    alpha_error: float | None = None
    alpha_bias: float | None = None
    fronts: tuple[str, ...] = ()
    report: SimplifyReport

    @property
    def stage_seconds(self) -> Mapping[str, float]:
        """Wall-clock seconds by stage, in the order of the stages."""
        return {stage.stage: stage.seconds for stage in self.report.stages}


class Failure(Record):
    """A run that failed.

    Attributes:
        name: Preset and ratio.
        preset: Name of the preset.
        rho: Requested ratio.
        reason: Why it failed, one sentence.
    """

    name: str
    preset: str
    rho: float
    reason: str


class Tradeoff(Record):
    """Cost and quality of every preset on one scene.

    Attributes:
        source: Name of the file of the full scene.
        source_count: Number of Gaussians of the full scene.
        source_bytes: Its size on the disk, as :func:`cvtgs.io.scene_size` returns it.
        start_seconds: Start-up seconds of every process: Python and the imports of torch and cvtgs.
        machine: The machine of the measurement.
        evaluation: The views, and the scores per view.
        results: One per ratio and preset, ratio by ratio.
        failures: Runs that failed.
        held_out: Whether runs are fitted to a training split of the cameras beside the scene, and
            none of it scores.
    """

    source: str
    source_count: int
    source_bytes: int
    start_seconds: float
    machine: str
    evaluation: Evaluation
    results: tuple[TradeoffResult, ...]
    failures: tuple[Failure, ...] = ()
    held_out: bool = False

    @property
    def rhos(self) -> tuple[float, ...]:
        """The ratios, in the order of the results."""
        return tuple(dict.fromkeys(result.rho for result in self.results))

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of all stages of all runs, in an order that fits every run."""
        names: list[str] = []
        for result in self.results:
            place = 0
            for name in result.stage_seconds:
                if name not in names:
                    names.insert(place, name)
                place = names.index(name) + 1
        return tuple(names)

    def rest_seconds(self, result: TradeoffResult) -> float:
        """Return the seconds of a run outside start-up and stages: reading and writing."""
        return max(0.0, result.seconds - self.start_seconds - sum(result.stage_seconds.values()))

    def to_csv(self) -> str:
        """Return comma-separated values: a header, and a line per run; failed runs come last.

        Values not measured are empty.
        """
        rows: list[dict[str, Any]] = [
            {
                **result.model_dump(exclude={"name", "report"}),
                "fronts": " ".join(result.fronts),
                "start_seconds": self.start_seconds,
                **{f"{name}_seconds": result.stage_seconds.get(name) for name in self.stages},
                "read_write_seconds": self.rest_seconds(result),
                "failure": "",
            }
            for result in self.results
        ]
        rows += [
            {"preset": failure.preset, "rho": failure.rho, "failure": failure.reason}
            for failure in self.failures
        ]
        file = io.StringIO()
        writer = csv.DictWriter(file, list(rows[0]) if rows else ["preset"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return file.getvalue()


def on_front(costs: Sequence[float], gains: Sequence[float]) -> tuple[bool, ...]:
    """Return which choices no other beats, by costing no more and gaining no less (Pareto)."""
    pairs = list(zip(costs, gains, strict=True))
    return tuple(
        not math.isnan(gain)
        and not any(c <= cost and g >= gain and (c, g) != (cost, gain) for c, g in pairs)
        for cost, gain in pairs
    )


def with_fronts(results: Sequence[TradeoffResult]) -> Iterator[TradeoffResult]:
    """Yield the results with ``fronts`` set, from the Pareto fronts of each ratio."""
    fronts: dict[str, list[str]] = {result.name: [] for result in results}
    for rho in dict.fromkeys(result.rho for result in results):
        same = [result for result in results if result.rho == rho]
        seconds = [result.seconds for result in same]
        for metric, gains in (
            ("psnr", [result.psnr for result in same]),
            ("ssim", [result.ssim for result in same]),
            ("lpips", [-result.lpips for result in same if result.lpips is not None]),
        ):
            if len(gains) == len(same):
                for result, best in zip(same, on_front(seconds, gains), strict=True):
                    fronts[result.name] += [metric] * best
    for result in results:
        yield result.model_copy(update={"fronts": tuple(fronts[result.name])})
