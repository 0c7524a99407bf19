"""The page of a tradeoff in a real browser."""

import re

import pytest

import cvtgs
from browser_cases import attribute, dom, layout_on_a_phone, needs_browser
from cvtgs.evaluation import EvaluationSettings
from cvtgs.tradeoff import measure_tradeoff, write_tradeoff
from cvtgs.views import automatic_views

pytestmark = needs_browser


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    pytest.importorskip("matplotlib")
    folder = tmp_path_factory.mktemp("tradeoff")
    cvtgs.save(cvtgs.synthetic.scene("object", 500, sh_degree=0, seed=0), folder / "full.ply")
    measured = measure_tradeoff(
        folder / "full.ply",
        presets=["draft", "fast"],
        ratios=[0.1],
        cameras=lambda scene: automatic_views(scene, 2, width=64, height=48),
        settings=EvaluationSettings(lpips="off"),
    )
    return write_tradeoff(measured, folder).paths[-1]


@pytest.mark.slow
def test_plot_table_and_slider_are_there(page):
    html = dom(page)
    assert attribute(html, "ready") == "yes"
    table = re.search(r'<table id="tradeoff">.*?</table>', html, re.DOTALL).group(0)
    assert "rho 0.1: 50 of 500 Gaussians" in table
    assert "<th>draft</th>" in table
    assert 'class="chart" src="data:image/png;base64,' in html
    assert "50 Gaussians" in html


@pytest.mark.slow
def test_it_fits_a_phone(page):
    """The wide table scrolls inside its own box."""
    assert layout_on_a_phone(page) == "390/390 390"


@pytest.mark.slow
def test_it_asks_for_nothing(page):
    assert not re.search(r"https?://", page.read_text(encoding="utf-8"))
