"""The table and the plot of ``benchmarks.compare``."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean
from typing import Literal

from benchmarks.scoring import MEAN, Quality
from cvtgs.plots import Panel, Series, line_chart

Clock = Literal["wall", "cpu"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What one run of one method gave.

    Attributes:
        quality: Against the full scene.
        wall_seconds: From the start of the process to its end.
        cpu_seconds: Processor time outside the kernel.
        count: Gaussians that it wrote.
        wanted: Gaussians that it should have written.
    """

    quality: Quality
    wall_seconds: float
    cpu_seconds: float
    count: int
    wanted: int

    def seconds(self, clock: Clock) -> float:
        """Return the time on a clock."""
        return self.wall_seconds if clock == "wall" else self.cpu_seconds


Row = Sequence[Result | None]
Table = Mapping[str, Mapping[str, Row]]

METRICS: Mapping[str, tuple[Callable[[Result], float | None], str]] = {
    "PSNR": (lambda result: result.quality.psnr, ".2f"),
    "SSIM": (lambda result: result.quality.ssim, ".4f"),
    "LPIPS": (lambda result: result.quality.lpips, ".4f"),
}


def markdown(
    table: Table, ratios: Sequence[float], *, means_only: bool = False, clock: Clock = "wall"
) -> str:
    """Return a Markdown table: the mean first, then scene by scene.

    A mean is over all scenes; a dash stands where a run failed or nothing was measured. There are
    no columns for LPIPS if nobody measured it.
    """
    metrics = {**METRICS, "s": (lambda result: result.seconds(clock), ".1f")}
    everything = [found for rows in table.values() for row in rows.values() for found in row]
    if all(found is None or found.quality.lpips is None for found in everything):
        del metrics["LPIPS"]
    heads = [f"{name} at {rho:g}" for rho in ratios for name in metrics]
    lines = [f"| scene | method | {' | '.join(heads)} |", "|---" * (len(heads) + 2) + "|"]
    groups = {MEAN: list(table.values())}
    if not means_only:
        groups |= {scene: [rows] for scene, rows in table.items()}
    for group, scenes in groups.items():
        for method in scenes[0]:
            cells = [
                cell([found and value(found) for found in column], form)
                for column in zip(*(rows[method] for rows in scenes), strict=True)
                for value, form in metrics.values()
            ]
            lines.append(f"| {group} | {method} | {' | '.join(cells)} |")
    return "\n".join(lines)


def cell(values: Sequence[float | None], form: str) -> str:
    """Return the text of a mean, or a dash if a value is missing."""
    known = [value for value in values if value is not None]
    return f"{mean(known):{form}}" if len(known) == len(values) else "-"


def wrong_counts(table: Table, ratios: Sequence[float]) -> str:
    """Name the runs that did not give exactly M Gaussians; quality is not comparable there."""
    lines = [
        f"- {method}, {scene}, {rho:g}: {found.count:,} instead of {found.wanted:,}"
        for scene, rows in table.items()
        for method, row in rows.items()
        for rho, found in zip(ratios, row, strict=True)
        if found is not None and found.count != found.wanted
    ]
    return "\n".join(["Not the number of Gaussians that was asked for:\n", *lines] if lines else [])


def failures(table: Table, ratios: Sequence[float]) -> str:
    """Name the runs that failed."""
    lines = [
        f"- {method}, {scene}, {rho:g}"
        for scene, rows in table.items()
        for method, row in rows.items()
        for rho, found in zip(ratios, row, strict=True)
        if found is None
    ]
    return "\n".join(["Failed:\n", *lines] if lines else [])


def chart(table: Table, ratios: Sequence[float], *, clock: Clock = "wall") -> bytes | None:
    """Draw mean PSNR over mean seconds, a line per method and a point per ratio.

    Points with a failure in any scene are left out; None if there are no others.
    """
    series = []
    for method in next(iter(table.values())):
        columns = zip(*(rows[method] for rows in table.values()), strict=True)
        complete = [[found for found in column if found] for column in columns if all(column)]
        if complete:
            line = Series(
                name=method,
                x=[max(mean(each.seconds(clock) for each in column), 1e-3) for column in complete],
                y=[mean(each.quality.psnr for each in column) for column in complete],
                markers=True,
            )
            series.append(line)
    if not series:
        return None
    shares = ", ".join(f"{rho:g}" for rho in sorted(ratios, reverse=True))
    panel = Panel(
        series=series,
        title=f"Share of Gaussians kept: {shares} (from above)",
        x_label="seconds, reading and writing included",
        y_label="PSNR, dB",
        log_x=True,
    )
    return line_chart([panel], width=1000, height=700)
