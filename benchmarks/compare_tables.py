"""Results of a comparison, as a JSON file, Markdown tables and a chart."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean
from typing import Literal

from pydantic_core import to_json

from benchmarks.quality import Quality, markdown_rows, mean_or_none
from cvtgs.plots import Panel, Series, line_chart

Clock = Literal["wall", "cpu"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Quality and cost of one run of one method.

    Attributes:
        quality: Scores against the full scene.
        wall_seconds: Wall-clock time of the process from start to end.
        cpu_seconds: User CPU time.
        count: Number of Gaussians in the output.
        wanted: Number of Gaussians that the output should have.
        judge: How the quality was measured; empty if unknown.
        source: SHA-256 of the file of the scene, or the size of a generated one; empty if unknown.
        system: The machine and the version of cvtgs that took the seconds; empty if unknown.
    """

    quality: Quality
    wall_seconds: float
    cpu_seconds: float
    count: int
    wanted: int
    judge: str = ""
    source: str = ""
    system: str = ""

    def seconds(self, clock: Clock) -> float:
        """Return the wall-clock or the CPU time."""
        return self.wall_seconds if clock == "wall" else self.cpu_seconds


Table = Mapping[str, Mapping[str, Mapping[float, Result | None]]]
"""Results by scene, method and ratio; None for a failed run, missing if not run."""


def joined(first: Table, second: Table) -> Table:
    """Merge two tables; results of the second take precedence."""
    scenes = dict.fromkeys([*first, *second])
    found: dict[str, dict[str, dict[float, Result | None]]] = {name: {} for name in scenes}
    for table in (first, second):
        for scene, rows in table.items():
            for method, row in rows.items():
                found[scene].setdefault(method, {}).update(row)
    return found


def results_json(table: Table) -> str:
    """Return results as JSON text; as in reports, infinity is the string ``Infinity``."""
    records = [
        {"scene": scene, "method": method, "rho": rho, "result": result and asdict(result)}
        for scene, rows in table.items()
        for method, row in rows.items()
        for rho, result in row.items()
    ]
    return to_json(records, indent=1, inf_nan_mode="strings").decode() + "\n"


def read_results(path: Path) -> Table:
    """Read a file of :func:`results_json`; return an empty table if there is no file."""
    table: dict[str, dict[str, dict[float, Result | None]]] = {}
    for record in json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []:
        found = record["result"]
        if found:
            scores = found["quality"]
            quality = Quality(**{**scores, "psnr": float(scores["psnr"])})  # infinity is a text
            found = Result(**{**found, "quality": quality})
        row = table.setdefault(record["scene"], {}).setdefault(record["method"], {})
        row[record["rho"]] = found
    return table


def results_of(table: Table) -> list[Result]:
    """Return all results of runs that did not fail."""
    found = (result for rows in table.values() for row in rows.values() for result in row.values())
    return [result for result in found if result is not None]


def judges_of(table: Table) -> list[str]:
    """Return how the results were scored, as far as is known."""
    return [judge for judge in dict.fromkeys(one.judge for one in results_of(table)) if judge]


def systems_of(table: Table) -> str:
    """Return the machines and versions of cvtgs that took the seconds."""
    systems = dict.fromkeys(one.system for one in results_of(table))
    return "; ".join(system or "an unknown machine" for system in systems)


def methods_of(table: Table) -> list[str]:
    """Return the names of all methods, in their order."""
    return list(dict.fromkeys(method for rows in table.values() for method in rows))


METRICS: Mapping[str, tuple[Callable[[Result], float | None], str]] = {
    "PSNR": (lambda result: result.quality.psnr, ".2f"),
    "SSIM": (lambda result: result.quality.ssim, ".4f"),
    "LPIPS": (lambda result: result.quality.lpips, ".4f"),
    "alpha error": (lambda result: result.quality.alpha_error, ".4f"),
    "alpha bias": (lambda result: result.quality.alpha_bias, "+.4f"),
}


def markdown(
    table: Table, ratios: Sequence[float], *, means_only: bool = False, clock: Clock = "wall"
) -> str:
    """Return two Markdown tables per ratio: means over all scenes, then scene by scene.

    A dash marks a run that failed or is missing, and a score that was not measured. A metric
    without any value has no column.
    """
    parts = []
    for rho in ratios:
        parts.append(f"Ratio {rho:g}, means over {len(table)} scenes:\n")
        parts.append(means_table(table, rho, clock))
        if not means_only:
            parts.append(f"Ratio {rho:g}, PSNR / SSIM of each scene:\n")
            parts.append(scenes_table(table, rho))
    return "\n".join(parts)


def means_table(table: Table, rho: float, clock: Clock) -> str:
    """Return a Markdown table of means over all scenes, a row per method."""
    metrics = {
        name: metric
        for name, metric in METRICS.items()
        if any(metric[0](result) is not None for result in results_of(table))
    }
    metrics["s"] = (lambda result: result.seconds(clock), ".1f")
    rows = []
    for method in methods_of(table):
        column = [rows_of.get(method, {}).get(rho) for rows_of in table.values()]
        cells = [
            _cell([None if result is None else value(result) for result in column], form)
            for value, form in metrics.values()
        ]
        rows.append([method, *cells])
    return markdown_rows(["method", *metrics], rows)


def scenes_table(table: Table, rho: float) -> str:
    """Return a Markdown table of PSNR and SSIM, a row per method and a column per scene."""
    rows = []
    for method in methods_of(table):
        found = [scene.get(method, {}).get(rho) for scene in table.values()]
        rows.append(
            [
                method,
                *(
                    f"{one.quality.psnr:.1f} / {one.quality.ssim:.3f}" if one else "-"
                    for one in found
                ),
            ]
        )
    return markdown_rows(["method", *table], rows)


def _cell(values: Sequence[float | None], form: str) -> str:
    """Format the mean of values, or return a dash if a value is missing."""
    found = mean_or_none(values)
    return "-" if found is None else f"{found:{form}}"


def wrong_counts(table: Table) -> str:
    """List the runs without exactly M Gaussians, whose quality is not comparable."""
    lines = [
        f"- {method}, {scene}, {rho:g}: {found.count:,} instead of {found.wanted:,}"
        for scene, rows in table.items()
        for method, row in rows.items()
        for rho, found in row.items()
        if found is not None and found.count != found.wanted
    ]
    return "\n".join(
        ["Runs with another number of Gaussians than requested:\n", *lines] if lines else []
    )


def failures(table: Table) -> str:
    """List the runs that failed."""
    lines = [
        f"- {method}, {scene}, {rho:g}"
        for scene, rows in table.items()
        for method, row in rows.items()
        for rho, found in row.items()
        if found is None
    ]
    return "\n".join(["Failed:\n", *lines] if lines else [])


def chart(table: Table, ratios: Sequence[float], *, clock: Clock = "wall") -> bytes | None:
    """Plot mean PSNR over mean seconds, a line per method and a point per ratio.

    Points that lack a result of any scene are left out; return None if no points remain.
    """
    series = []
    for method in methods_of(table):
        columns = [[rows.get(method, {}).get(rho) for rows in table.values()] for rho in ratios]
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
