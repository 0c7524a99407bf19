"""The page in a real browser: its script, its layout on a phone, and no network requests."""

import math
import re
import subprocess
from dataclasses import replace

import pytest
import torch

import cvtgs
from browser_cases import (
    BROWSER,
    QUIET,
    attribute,
    browse,
    dom,
    layout_on_a_phone,
    needs_browser,
    text_of,
)
from cvtgs.evaluation import EvaluationSettings, compare, write_comparison
from cvtgs.evaluation.scorer import Score
from cvtgs.views import automatic_views

pytestmark = needs_browser


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    scene = cvtgs.synthetic.scene("object", 1000, sh_degree=0, seed=0)
    simplifier = cvtgs.Simplifier(device="cpu")
    small = {f"small_{rho:g}.ply": simplifier.simplify(scene, rho) for rho in (0.1, 0.01)}
    comparison = compare(
        scene,
        small | {"a_scene_with_a_name_that_is_too_long_for_any_phone.ply": scene},
        automatic_views(scene, 3, width=64, height=48),
        reference_name="full.ply",
        sizes={"full.ply": 68_000, "small_0.1.ply": 6_800},
        settings=EvaluationSettings(lpips="off"),
    )
    folder = tmp_path_factory.mktemp("page")
    write_comparison(comparison, folder)
    return folder / "index.html", comparison.evaluation


@pytest.mark.slow
def test_the_script_runs_and_shows_the_first_view(page):
    path, evaluation = page
    html = dom(path)
    assert attribute(html, "ready") == "yes"
    chosen = [attribute(html, name) for name in ("view", "small", "split", "error")]
    assert chosen == ["1", "1", "50", "0"]
    assert text_of(html, "title") == "full.ply"
    assert "1,000 Gaussians · 68.0 kB" in text_of(html, "lead")
    assert text_of(html, "view-name") == "view 1"
    first = evaluation.scenes[0]
    score = f"PSNR {first.psnr.views[0]:.2f} dB · SSIM {first.ssim.views[0]:.3f}"
    alpha = f" · Alpha error {first.alpha_error.views[0]:.4f} · Alpha bias "
    assert text_of(html, "score").startswith(score + alpha)
    assert "10\u00d7 fewer" in html
    assert "100 Gaussians · 6.8 kB · small_0.1.ply" in html


@pytest.mark.slow
def test_the_address_chooses_scene_view_and_divider(page):
    path, evaluation = page
    html = dom(path, "#view=2&small=2&split=30")
    chosen = [attribute(html, name) for name in ("view", "small", "split", "error")]
    assert chosen == ["2", "2", "30", "0"]
    assert "--split: 30" in re.search(r"<html[^>]*>", html).group(0)
    assert text_of(html, "view-name") == "view 2"
    assert f"PSNR {evaluation.scenes[1].psnr.views[1]:.2f} dB" in text_of(html, "score")
    assert text_of(html, "views-title") == "Per view of small_0.01.ply"
    assert re.search(r'<img id="small"[^>]*alt="view 2 of small_0.01.ply, 10 Gaussians"', html)


@pytest.mark.slow
def test_colour_errors_and_equal_scenes_are_shown(page):
    path, _ = page
    html = dom(path, "#view=3&small=3&error=1")
    assert attribute(html, "error") == "1"
    assert "PSNR equal · SSIM 1.000 · Alpha error 0.0000 · Alpha bias 0.0000" in text_of(
        html, "score"
    )
    assert re.search(r'id="differences"[^>]*aria-pressed="true"', html)
    assert not re.search(r'id="scale"[^>]* hidden', html)
    assert "Where colours of a_scene_with" in html


@pytest.mark.slow
def test_alpha_errors_have_their_own_map_and_scale(page):
    path, _ = page
    html = dom(path, "#view=3&small=2&error=2")
    assert attribute(html, "error") == "2"
    assert re.search(r'id="alpha"[^>]*aria-pressed="true"', html)
    assert re.search(r'id="differences"[^>]*aria-pressed="false"', html)
    assert re.search(r'id="scale"[^>]* hidden', html)
    assert not re.search(r'id="alpha-scale"[^>]* hidden', html)
    assert "Where small_0.01.ply covers less or more than the full scene in view 3" in html


@pytest.mark.slow
def test_numbers_out_of_range_are_clamped(page):
    path, _ = page
    html = dom(path, "#view=99&small=-1&split=400&error=x")
    chosen = [attribute(html, name) for name in ("view", "small", "split", "error")]
    assert chosen == ["3", "1", "100", "0"]


@pytest.mark.slow
def test_the_page_fits_a_phone(page):
    path, _ = page
    assert layout_on_a_phone(path) == "390/390 390"


@pytest.mark.slow
def test_the_page_loads_nothing_from_the_network(page):
    """Its policy allows only embedded images, and Chromium reports no violation of it."""
    path, _ = page
    content = path.read_text(encoding="utf-8")
    assert "default-src 'none'; img-src data:" in content
    assert not re.search(r"https?://", content)
    done = subprocess.run(
        [
            str(BROWSER),
            *QUIET,
            f"--user-data-dir={path.parent / 'profile'}",
            "--virtual-time-budget=3000",
            "--enable-logging=stderr",
            "--dump-dom",
            path.as_uri(),
        ],
        capture_output=True,
        timeout=120,
        check=True,
    )
    console = [line for line in done.stderr.decode().splitlines() if "CONSOLE" in line]
    assert console == []
    assert 'data-ready="yes"' in done.stdout.decode()


@pytest.mark.slow
def test_ratios_of_other_sizes_are_told_apart(tmp_path):
    scene = cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=0)
    cameras, settings = (
        automatic_views(scene, 1, width=32, height=24),
        EvaluationSettings(lpips="off"),
    )
    small = scene.select(torch.arange(50))
    others = {"larger": scene, "hardly smaller": small.select(torch.arange(49)), "one": scene[:1]}
    write_comparison(compare(small, others, cameras, settings=settings), tmp_path)
    html = dom(tmp_path / "index.html")
    assert "<b>6\u00d7 more</b>" in html
    assert "<b>1.02\u00d7 fewer</b>" in html
    assert "1 Gaussian \u00b7 one" in html


@pytest.mark.slow
def test_a_screenshot_shows_both_scenes(page):
    path, _ = page
    shot = path.parent / "shot.png"
    browse(path, "#split=50", "--window-size=1000,900", f"--screenshot={shot}")
    assert shot.stat().st_size > 10_000


@pytest.mark.slow
def test_a_mean_over_some_equal_views_is_that_of_the_others(tmp_path):
    scene = cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=0)
    views = automatic_views(scene, 3, width=64, height=48)
    comparison = compare(scene, {"a": scene}, views, settings=EvaluationSettings(lpips="off"))
    (same,) = comparison.evaluation.scenes
    mixed = same.model_copy(update={"psnr": Score.of([20.0, math.inf, 31.0])})
    evaluation = comparison.evaluation.model_copy(update={"scenes": (mixed,)})
    write_comparison(replace(comparison, evaluation=evaluation), tmp_path)
    assert dom(tmp_path / "index.html").count("25.50 dB, 1 equal") == 2  # the choice and the table
