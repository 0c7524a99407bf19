"""The plot: seconds against quality, a line per ratio."""

import math
from collections.abc import Sequence

from cvtgs.plots import Panel, Series, line_chart
from cvtgs.tradeoff.results import Tradeoff, TradeoffResult

WIDTH, HEIGHT = 1200, 560

DIGITS = ((1, 2, 3, 5, 7), (1, 2, 5), (1,))
MOST_TICKS = 12
"""More numbers run into each other."""

METRICS = (("psnr", "PSNR", "PSNR, dB"), ("ssim", "SSIM", "SSIM"))


def tradeoff_chart(tradeoff: Tradeoff) -> bytes:
    """Draw PSNR and SSIM over seconds, a line per ratio through the runs that none beats."""
    return line_chart(_panels(tradeoff), width=WIDTH, height=HEIGHT)


def _panels(tradeoff: Tradeoff) -> list[Panel]:
    seconds = [result.seconds for result in tradeoff.results]
    return [
        Panel(
            series=[_series(tradeoff, rho, metric) for rho in tradeoff.ratios],
            title=title,
            x_label="seconds of the whole process",
            y_label=label,
            x_ticks=ticks(min(seconds), max(seconds)),
            log_x=True,
        )
        for metric, title, label in METRICS
    ]


def _series(tradeoff: Tradeoff, rho: float, metric: str) -> Series:
    results = [result for result in tradeoff.results if result.rho == rho]
    results.sort(key=lambda result: result.seconds)
    return Series(
        name=f"rho {rho:g}",
        x=[max(result.seconds, 1e-3) for result in results],
        y=[_value(result, metric) for result in results],
        markers=True,
        labels=[result.preset for result in results],
        aside=[metric not in result.fronts for result in results],
    )


def _value(result: TradeoffResult, metric: str) -> float:
    return result.psnr if metric == "psnr" else result.ssim


def ticks(low: float, high: float) -> Sequence[float]:
    """Return round numbers for a logarithmic axis: 1, 2, 3, 5, 7 and their tenfolds, or fewer."""
    for digits in DIGITS:
        found = _round_numbers(max(low, 1e-3), max(high, 1e-3), digits)
        if len(found) <= MOST_TICKS:
            break
    return found


def _round_numbers(low: float, high: float, digits: Sequence[int]) -> Sequence[float]:
    decades = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1)
    steps = [float(f"{digit}e{decade}") for decade in decades for digit in digits]
    first = max((step for step in steps if step <= low), default=steps[0])
    last = min((step for step in steps if step >= high), default=steps[-1])
    return [step for step in steps if first <= step <= last]
