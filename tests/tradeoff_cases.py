"""Made-up results of a tradeoff."""

from typing import Any

from cvtgs import SimplifyConfig, SimplifyReport
from cvtgs.clock import StageCost
from cvtgs.tradeoff import TradeoffResult


def result(
    preset: str, seconds: float, psnr: float, rho: float = 0.1, **more: Any
) -> TradeoffResult:
    stages = tuple(
        StageCost(stage=name, seconds=part, cpu_seconds=part, peak_memory_bytes=2**28)
        for name, part in {"check": 0.25, **more.pop("stages", {})}.items()
    )
    return TradeoffResult(
        name=f"{preset} {rho:g}",
        preset=preset,
        rho=rho,
        count=50,
        bytes=4200,
        seconds=seconds,
        peak_memory_bytes=300_000_000,
        psnr=psnr,
        ssim=more.pop("ssim", psnr / 100),
        report=SimplifyReport(
            input_count=500,
            output_count=50,
            target_count=50,
            rho=rho,
            stages=stages,
            config=SimplifyConfig(),
        ),
        **more,
    )
