"""What the chart of a tradeoff shows."""

import math
from collections.abc import Sequence

import pytest

from cvtgs.evaluation import Evaluation
from cvtgs.plots import Panel
from cvtgs.tradeoff.files import HEIGHT, WIDTH, tradeoff_chart
from cvtgs.tradeoff.results import Tradeoff, TradeoffResult, with_fronts
from tradeoff_cases import result

MADE = (
    result("high", 9.0, 25.0, ssim=0.8),
    result("draft", 2.0, 20.0, ssim=0.7),
    result("fast", 3.0, 19.0, ssim=0.75),
    result("draft", 0.0, 15.0, 0.01, ssim=0.5),
)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Panel]:
    panels: list[Panel] = []

    def draw(given: Sequence[Panel], *, width: int, height: int) -> bytes:
        assert (width, height) == (WIDTH, HEIGHT)
        panels.extend(given)
        return b"png"

    monkeypatch.setattr("cvtgs.tradeoff.files.line_chart", draw)
    return panels


def tradeoff(*results: TradeoffResult) -> Tradeoff:
    evaluation = Evaluation(
        reference="a", reference_count=500, views=(), width=8, height=8, backend="torch", scenes=()
    )
    return Tradeoff(
        source="a.ply",
        source_count=500,
        source_bytes=9,
        start_seconds=1.0,
        machine="abacus",
        evaluation=evaluation,
        results=tuple(with_fronts(results)),
    )


def test_a_line_of_a_ratio_has_its_presets_by_seconds(drawn: list[Panel]) -> None:
    assert tradeoff_chart(tradeoff(*MADE)) == b"png"
    (psnr, _), (ssim, least) = (panel.series for panel in drawn)
    assert [psnr.name, least.name] == ["rho 0.1", "rho 0.01"]
    assert [panel.title for panel in drawn] == ["PSNR", "SSIM"]
    assert psnr.labels == ssim.labels == ["draft", "fast", "high"]
    assert psnr.x == ssim.x == [2.0, 3.0, 9.0]
    assert (psnr.y, ssim.y) == ([20.0, 19.0, 25.0], [0.7, 0.75, 0.8])
    assert (psnr.hollow, ssim.hollow) == ([False, True, False], [False] * 3)
    assert least.x == [1e-3]  # a logarithmic axis has no 0


def test_an_infinite_psnr_is_told_instead_of_drawn(drawn: list[Panel]) -> None:
    same, other = result("draft", 2.0, math.inf, 1.0), result("fast", 3.0, 20.0)
    tradeoff_chart(tradeoff(same, other))
    assert [panel.title for panel in drawn] == ["PSNR (infinite for 1 run, not shown)", "SSIM"]
    drawn.clear()
    tradeoff_chart(tradeoff(same))
    assert [panel.title for panel in drawn] == ["SSIM, rho 1.0"]
