"""The files of a tradeoff: machine-readable tables, a plot and a page."""

import base64
import math
import os
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from cvtgs.counts import written
from cvtgs.errors import MissingDependencyError
from cvtgs.evaluation.comparison_files import PAGE, comparison_page, render_template
from cvtgs.io.atomic import check_outputs, write_atomically
from cvtgs.plots import Panel, Series, line_chart
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.text import counted, size_text
from cvtgs.tradeoff.measure import Measured
from cvtgs.tradeoff.results import Tradeoff, TradeoffResult

CSV, JSON, PLOT = "tradeoff.csv", "tradeoff.json", "tradeoff.png"
STAGE = "write pages"

WIDTH, HEIGHT = 1200, 560  # pixels of the plot

DIGITS = ((1, 2, 3, 5, 7), (1, 2, 5), (1,))
MOST_TICKS = 12  # largest number of tick labels that do not overlap

MARK = "*"
MARK_MEANS = "* no other preset is as good in less time with the same number of Gaussians"


class Written(NamedTuple):
    """The files that were written.

    Attributes:
        paths: The files.
        note: Which file is missing and why; empty if none is missing.
    """

    paths: tuple[Path, ...]
    note: str


def check_tradeoff_files(
    folder: str | os.PathLike[str], *, more: tuple[str, ...] = (), overwrite: bool = False
) -> None:
    """Make the folder and check that the files can be written, before the work starts."""
    check_outputs(folder, (CSV, JSON, PLOT, PAGE, *more), overwrite=overwrite)


def write_tradeoff(
    measured: Measured,
    folder: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    listener: ProgressListener = silent,
) -> Written:
    """Write ``tradeoff.csv``, ``.json``, ``.png`` and ``index.html``, each atomically.

    Without matplotlib there is no plot, and one of an earlier run is removed.

    Args:
        measured: The measurements.
        folder: The output folder; created if missing.
        overwrite: Whether existing files may be replaced.
        listener: Called after each file.

    Returns:
        The paths of the files, and a note on a missing one.

    Raises:
        OutputExistsError: A file exists and may not be replaced.
        OutputError: A file cannot be written.
    """
    check_tradeoff_files(folder, overwrite=overwrite)
    tradeoff = measured.tradeoff
    chart, note = None, ""
    try:
        chart = tradeoff_chart(tradeoff)
    except MissingDependencyError as error:
        note = str(error)
    page = comparison_page(
        measured.comparison,
        summary=page_summary(tradeoff, chart),
        topic="Comparison of presets",
        is_named=True,
    )
    contents = {
        CSV: tradeoff.to_csv().encode(),
        JSON: tradeoff.to_json().encode(),
        PLOT: chart,
        PAGE: page.encode(),
    }
    kept = {Path(folder) / name: content for name, content in contents.items() if content}
    if chart is None:
        (Path(folder) / PLOT).unlink(missing_ok=True)  # of other results
    for done, (path, content) in enumerate(kept.items(), start=1):
        write_atomically(path, content, overwrite=overwrite)
        listener(ProgressEvent(stage=STAGE, done=done, total=len(kept)))
    return Written(tuple(kept), note)


def tradeoff_chart(tradeoff: Tradeoff) -> bytes:
    """Plot finite PSNR and SSIM over seconds, a line per ratio through the runs on the front."""
    seconds = [result.seconds for result in tradeoff.results]
    endless = sum(math.isinf(result.psnr) for result in tradeoff.results)
    only = f", rho {written(tradeoff.rhos[0])}" if len(tradeoff.rhos) == 1 else ""
    panels = []
    for metric in ("psnr", "ssim"):
        title, series = f"{metric.upper()}{only}", []
        if metric == "psnr" and endless:
            title += f" (infinite for {counted(endless, 'run')}, not shown)"
        if metric == "psnr" and endless == len(seconds):
            continue
        for rho in tradeoff.rhos:
            results = [result for result in tradeoff.results if result.rho == rho]
            results.sort(key=lambda result: result.seconds)
            series.append(
                Series(
                    name=f"rho {written(rho)}",
                    x=[max(result.seconds, 1e-3) for result in results],
                    y=[result.psnr if metric == "psnr" else result.ssim for result in results],
                    markers=True,
                    labels=[result.preset for result in results],
                    hollow=[metric not in result.fronts for result in results],
                )
            )
        panels.append(
            Panel(
                series=series,
                title=title,
                x_label="seconds of the whole process",
                y_label="PSNR, dB" if metric == "psnr" else "SSIM",
                x_ticks=ticks(min(seconds), max(seconds)),
                log_x=True,
            )
        )
    return line_chart(panels, width=WIDTH, height=HEIGHT)


def ticks(low: float, high: float) -> Sequence[float]:
    """Return ticks for a logarithmic axis: 1, 2, 3, 5, 7 times powers of ten, or fewer."""
    low, high = max(low, 1e-3), max(high, 1e-3)
    decades = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1)
    for digits in DIGITS:
        steps = [float(f"{digit}e{decade}") for decade in decades for digit in digits]
        first = max((step for step in steps if step <= low), default=steps[0])
        last = min((step for step in steps if step >= high), default=steps[-1])
        found = [step for step in steps if first <= step <= last]
        if len(found) <= MOST_TICKS:
            break
    return found


def page_summary(tradeoff: Tradeoff, chart: bytes | None) -> str:
    """Return the plot and the table as HTML."""
    headings = list(cells(tradeoff, tradeoff.results[0]))
    groups = []
    for rho in tradeoff.rhos:
        rows = [cells(tradeoff, result) for result in tradeoff.results if result.rho == rho]
        texts = [[row[name].strip() for name in headings] for row in rows]
        groups.append((heading(tradeoff, rho), texts))
    template = files("cvtgs.tradeoff") / "summary.html"
    return render_template(
        template.read_text(encoding="utf-8"),
        chart=base64.b64encode(chart).decode() if chart else "",
        headings=headings,
        groups=groups,
        mark=MARK,
        mark_means=MARK_MEANS,
        how_measured=how_measured(tradeoff),
        failures=tradeoff.failures,
    )


def cells(tradeoff: Tradeoff, result: TradeoffResult) -> Mapping[str, str]:
    """Return the table cells of a result as text, by heading."""
    stages = {f"{name}, s": _seconds(result.stage_seconds.get(name)) for name in tradeoff.stages}
    measured = tradeoff.evaluation.lpips_network is not None
    distance = {"LPIPS": _score(result, "lpips", 4)} if measured else {}
    photograph = dict[str, str]()
    for found in tradeoff.evaluation.photographs:
        if found.name == result.name:
            photograph["photo PSNR, dB"] = f"{found.psnr.mean:.2f}"
            photograph["photo SSIM"] = f"{found.ssim.mean:.4f}"
            if found.lpips is not None:
                photograph["photo LPIPS"] = f"{found.lpips.mean:.4f}"
    return {
        "preset": result.preset,
        "all, s": _seconds(result.seconds),
        "PSNR, dB": _score(result, "psnr", 2),
        "SSIM": _score(result, "ssim", 4),
        **distance,
        **photograph,
        "alpha error": "" if result.alpha_error is None else f"{result.alpha_error:.4f}",
        "alpha bias": "" if result.alpha_bias is None else f"{result.alpha_bias:+.4f}",
        "file": size_text(result.bytes),
        "memory": size_text(result.peak_memory_bytes) if result.peak_memory_bytes else "",
        "start, s": _seconds(tradeoff.start_seconds),
        **stages,
        "read, write, s": _seconds(tradeoff.rest_seconds(result)),
    }


def heading(tradeoff: Tradeoff, rho: float) -> str:
    """Return the table heading of a ratio."""
    count = max(result.count for result in tradeoff.results if result.rho == rho)
    return f"rho {written(rho)}: {count:,} of {counted(tradeoff.source_count, 'Gaussian')}"


def how_measured(tradeoff: Tradeoff) -> str:
    """Return a text on where and how this was measured."""
    evaluation, source = tradeoff.evaluation, tradeoff.source
    sentences = [
        f"{counted(evaluation.view_count, 'view')} "
        f"of {evaluation.width} x {evaluation.height} pixels, rendered by {evaluation.backend}.",
        f"Every run is a separate process on {tradeoff.machine}.",
    ]
    results = [one for one in tradeoff.results if one.report.views.endswith("cameras")]
    if results:
        where = f"the training cameras beside {source}"
        if not tradeoff.held_out:
            where = f"cameras beside {source}, which favours them if these score"
        fitted = ", ".join(dict.fromkeys(one.preset for one in results))
        sentences.append(f"Fitted to {where}: {fitted}.")
    sentences += [
        f"The full scene has {full.psnr.mean:.2f} dB and an SSIM of {full.ssim.mean:.4f} "
        f"against the photographs."
        for full in evaluation.photographs
        if full.name == evaluation.reference
    ]
    return " ".join(filter(None, [*sentences, evaluation.lpips_sentence]))


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _score(result: TradeoffResult, metric: str, digits: int) -> str:
    value: float | None = getattr(result, metric)
    if value is None:
        return ""
    return f"{value:.{digits}f}{MARK if metric in result.fronts else ' '}"
