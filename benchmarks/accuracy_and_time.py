"""Time against accuracy: every preset, and ``standard`` with one choice changed at a time.

``python -m benchmarks.accuracy_and_time --png FILE`` uses the scenes and scorers of
``benchmarks.quality``, prints the tables of ``docs/accuracy-and-time.md`` and draws its plot.
Seconds are CPU seconds of ``Simplifier.run``, without start-up, reading and writing, as a mean
over the scenes.
"""

import sys
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean

import cvtgs
from benchmarks.measuring import warm_up, write_file
from benchmarks.quality import (
    CHOICES,
    Quality,
    Simplify,
    cells_of,
    configuration,
    markdown_rows,
    means,
    measure,
    scoring_parser,
)
from cvtgs.errors import MissingDependencyError
from cvtgs.plots import Panel, Series, line_chart
from cvtgs.tradeoff.files import ticks

PRESETS: Mapping[str, Mapping[str, str]] = {name: {"preset": name} for name in cvtgs.PRESETS}

SWITCHES: Mapping[str, Mapping[str, str]] = {
    **{name: settings for name, settings in CHOICES.items() if name != "paper"},
    "no network": {"merge.network": "false"},
    "visibility from 16 views": {"visibility.views": "16"},
    "100 steps of refinement": {"refine.steps": "100"},
}

TABLES = {"presets": ("Presets", PRESETS), "choices": ("One choice at a time", SWITCHES)}


class Stopwatch:
    """A simplifier that records its CPU seconds by ratio."""

    def __init__(self, config: cvtgs.SimplifyConfig) -> None:
        self._simplifier = cvtgs.Simplifier(config=config)
        self._spent: dict[float, list[float]] = defaultdict(list)

    def __call__(self, scene: cvtgs.GaussianScene, rho: float) -> cvtgs.GaussianScene:
        """Simplify, and record the CPU seconds."""
        start = time.process_time()
        small = self._simplifier.simplify(scene, rho)
        self._spent[rho].append(time.process_time() - start)
        return small

    def seconds(self, rho: float) -> float:
        """Return the mean CPU seconds over the scenes."""
        return mean(self._spent[rho])


def table(
    watches: Mapping[str, Stopwatch],
    scores: Mapping[str, Sequence[Quality]],
    ratios: Sequence[float],
) -> str:
    """Return a Markdown table: seconds, PSNR, SSIM, LPIPS, alpha error by row and ratio."""
    columns = ("seconds", "PSNR", "SSIM", "LPIPS", "alpha error")
    heads = [f"{name} at {rho:g}" for rho in ratios for name in columns]
    rows = [
        [
            name,
            *(
                cell
                for rho, quality in zip(ratios, scores[name], strict=True)
                for cell in (f"{watches[name].seconds(rho):.2f}", *cells_of(quality))
            ),
        ]
        for name in watches
    ]
    return markdown_rows(["", *heads], rows)


def chart(
    watches: Mapping[str, Stopwatch],
    scores: Mapping[str, Sequence[Quality]],
    ratios: Sequence[float],
) -> bytes:
    """Plot PSNR and SSIM over seconds, one line per ratio and one point per preset."""
    seconds = [watch.seconds(rho) for watch in watches.values() for rho in ratios]
    marks = ticks(min(seconds), max(seconds))
    panels = []
    for label, metric in (("PSNR, dB", "psnr"), ("SSIM", "ssim")):
        series = []
        for number, rho in enumerate(ratios):
            names = sorted(watches, key=lambda name: watches[name].seconds(rho))
            series.append(
                Series(
                    name=f"rho {rho:g}",
                    x=[watches[name].seconds(rho) for name in names],
                    y=[getattr(scores[name][number], metric) for name in names],
                    labels=names,
                    hollow=[name == "paper" for name in names],
                    markers=True,
                )
            )
        panels.append(
            Panel(
                series=series,
                x_label="processor seconds",
                y_label=label,
                x_ticks=marks,
                log_x=True,
            )
        )
    return line_chart(panels, width=1200, height=500)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = scoring_parser(__doc__)
    parser.add_argument("--png", type=Path, help="draw the presets to this file")
    parser.add_argument("--table", choices=TABLES, help="print only this table")
    options = parser.parse_args(arguments)
    warm_up()
    for name in [options.table] if options.table else TABLES:
        title, rows = TABLES[name]
        watches = {name: Stopwatch(configuration(options, row)) for name, row in rows.items()}
        simplifiers: dict[str, Simplify] = dict(watches)
        *_, found = measure(simplifiers, options)
        scores = means(found)
        print(f"## {title}\n\n{table(watches, scores, options.rho)}", flush=True)
        if rows is PRESETS and options.png is not None:
            try:
                write_file(options.png, chart(watches, scores, options.rho))
            except MissingDependencyError as error:
                print(f"without a plot: {error}", file=sys.stderr)


if __name__ == "__main__":
    main()
