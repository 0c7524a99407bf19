"""What every preset costs and gives on one scene."""

import csv
import io
from collections.abc import Mapping

import pydantic

from cvtgs.evaluation.scores import Evaluation
from cvtgs.report import SimplifyReport


class _Record(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")


class TradeoffResult(_Record):
    """What one run of one preset cost and gave.

    Attributes:
        name: Preset and ratio, for example ``fast 0.01``; the name in the evaluation, too.
        preset: Name of the preset.
        rho: Ratio that was asked for.
        count: Gaussians that came out.
        bytes: Size of the file that came out.
        seconds: Wall-clock seconds of the whole process, from its start to its end.
        peak_memory_bytes: Its largest resident size; 0 where the system does not tell.
        psnr: Mean over the views, dB; infinite if images are equal.
        ssim: Mean over the views.
        lpips: Mean over the views; None if it was not measured.
        fronts: Metrics by which no other run of this ratio beats it: ``psnr``, ``ssim``, ``lpips``.
        report: What was done, with seconds and peak memory per stage.
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
    fronts: tuple[str, ...] = ()
    report: SimplifyReport

    @property
    def stage_seconds(self) -> Mapping[str, float]:
        """Wall-clock seconds by stage, in the order of the stages."""
        return {stage.stage: stage.seconds for stage in self.report.stages}


class Failure(_Record):
    """A run that failed.

    Attributes:
        name: Preset and ratio.
        reason: Why, one sentence.
    """

    name: str
    reason: str


class Tradeoff(_Record):
    """What every preset costs and gives on one scene.

    Attributes:
        source: Name of the file of the full scene.
        source_count: Its Gaussians.
        source_bytes: Its size.
        start_seconds: What every process costs before it reads: Python, torch and cvtgs start.
        machine: Where this was measured.
        evaluation: From where images were taken, and the scores per view.
        results: One per ratio and preset, ratio by ratio.
        failures: Runs that gave nothing.
    """

    source: str
    source_count: int
    source_bytes: int
    start_seconds: float
    machine: str
    evaluation: Evaluation
    results: tuple[TradeoffResult, ...]
    failures: tuple[Failure, ...] = ()

    @property
    def ratios(self) -> tuple[float, ...]:
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
        """Return what is left of a run beyond start and stages: reading and writing.

        Args:
            result: One of the results.

        Returns:
            Seconds, at least 0.
        """
        return max(0.0, result.seconds - self.start_seconds - sum(result.stage_seconds.values()))

    def to_json(self) -> str:
        """Return everything as indented JSON; infinite numbers are the string ``Infinity``.

        Returns:
            JSON text that ends with a line break.
        """
        return self.model_dump_json(indent=2) + "\n"

    def to_csv(self) -> str:
        """Return one line per run, with seconds per stage.

        Returns:
            Comma-separated values under a line of headings; what was not measured is empty.
        """
        rows = [self._row(result) for result in self.results]
        file = io.StringIO()
        writer = csv.DictWriter(file, list(rows[0]) if rows else ["preset"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return file.getvalue()

    def _row(self, result: TradeoffResult) -> dict[str, str | int | float | None]:
        seconds = {f"{name}_seconds": result.stage_seconds.get(name) for name in self.stages}
        return {
            "preset": result.preset,
            "rho": result.rho,
            "count": result.count,
            "bytes": result.bytes,
            "seconds": result.seconds,
            "start_seconds": self.start_seconds,
            **seconds,
            "read_write_seconds": self.rest_seconds(result),
            "peak_memory_bytes": result.peak_memory_bytes,
            "psnr": result.psnr,
            "ssim": result.ssim,
            "lpips": result.lpips,
            "fronts": " ".join(result.fronts),
        }
