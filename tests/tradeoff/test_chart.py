"""What the chart of a tradeoff shows."""

from collections.abc import Sequence

import pytest

from cvtgs.evaluation import Evaluation
from cvtgs.plots import Panel
from cvtgs.tradeoff.files import HEIGHT, WIDTH, tradeoff_chart
from cvtgs.tradeoff.results import Tradeoff, with_fronts
from tradeoff_cases import result

MADE = (
    result("high", 9.0, 25.0, ssim=0.8),
    result("draft", 2.0, 20.0, ssim=0.7),
    result("fast", 3.0, 19.0, ssim=0.75),
    result("draft", 0.0, 15.0, 0.01, ssim=0.5),
)


def test_a_line_of_a_ratio_has_its_presets_by_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Panel] = []

    def draw(panels: Sequence[Panel], *, width: int, height: int) -> bytes:
        assert (width, height) == (WIDTH, HEIGHT)
        drawn.extend(panels)
        return b"png"

    evaluation = Evaluation(
        reference="a", reference_count=500, views=(), width=8, height=8, backend="torch", scenes=()
    )
    tradeoff = Tradeoff(
        source="a.ply",
        source_count=500,
        source_bytes=9,
        start_seconds=1.0,
        machine="abacus",
        evaluation=evaluation,
        results=tuple(with_fronts(MADE)),
    )
    monkeypatch.setattr("cvtgs.tradeoff.files.line_chart", draw)
    assert tradeoff_chart(tradeoff) == b"png"
    (psnr, _), (ssim, least) = (panel.series for panel in drawn)
    assert [psnr.name, least.name] == ["rho 0.1", "rho 0.01"]
    assert [panel.title for panel in drawn] == ["PSNR", "SSIM"]
    assert psnr.labels == ssim.labels == ["draft", "fast", "high"]
    assert psnr.x == ssim.x == [2.0, 3.0, 9.0]
    assert (psnr.y, ssim.y) == ([20.0, 19.0, 25.0], [0.7, 0.75, 0.8])
    assert (psnr.hollow, ssim.hollow) == ([False, True, False], [False] * 3)
    assert least.x == [1e-3]  # a logarithmic axis has no 0
