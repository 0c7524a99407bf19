"""Results as words, for tables on a terminal and on a page."""

from collections.abc import Mapping

from cvtgs.evaluation.labels import megabytes
from cvtgs.tradeoff.results import Tradeoff, TradeoffResult

MARK = "*"

MARK_MEANS = "* no other preset is as good in less time, with as many Gaussians"


def cells(tradeoff: Tradeoff, result: TradeoffResult) -> Mapping[str, str]:
    """Write a result as words."""
    stages = {f"{name}, s": _seconds(result.stage_seconds.get(name)) for name in tradeoff.stages}
    measured = tradeoff.evaluation.lpips_network is not None
    distance = {"LPIPS": _score(result, "lpips", result.lpips, 4)} if measured else {}
    return {
        "preset": result.preset,
        "start, s": _seconds(tradeoff.start_seconds),
        **stages,
        "read, write, s": _seconds(tradeoff.rest_seconds(result)),
        "all, s": _seconds(result.seconds),
        "PSNR, dB": _score(result, "psnr", result.psnr, 2),
        "SSIM": _score(result, "ssim", result.ssim, 4),
        **distance,
        "file": megabytes(result.bytes),
        "memory": megabytes(result.peak_memory_bytes) if result.peak_memory_bytes else "",
    }


def heading(tradeoff: Tradeoff, rho: float) -> str:
    """Name a ratio and what it means."""
    count = max(result.count for result in tradeoff.results if result.rho == rho)
    return f"rho {rho:g}: {count:,} of {tradeoff.source_count:,} Gaussians"


def how_measured(tradeoff: Tradeoff) -> str:
    """Report where and how this was measured."""
    seen = tradeoff.evaluation
    return (
        f"{len(seen.views)} views of {seen.width} x {seen.height} pixels, rendered by "
        f"{seen.backend}. Every run is a process of its own on {tradeoff.machine}. "
        f"{seen.lpips_sentence}"
    ).rstrip()


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _score(result: TradeoffResult, metric: str, value: float | None, digits: int) -> str:
    if value is None:
        return ""
    return f"{value:.{digits}f}{MARK if metric in result.fronts else ' '}"
