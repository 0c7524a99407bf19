"""The benchmarks of devices and of numerical errors, at tiny sizes."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from benchmarks import device_search, effects, gpu, numerics
from cvtgs.errors import InputNotFoundError
from hard_cases import CASES
from pretended_device import pretended_cuda

TINY = ["--counts", "300", "--rho", "0.1", "--runs", "1", "--size", "24", "--steps", "3"]


def page_at(tmp_path: Path) -> Path:
    page = tmp_path / "gpu.md"
    page.write_text(Path("docs/gpu.md").read_text(encoding="utf-8"), encoding="utf-8")
    return page


@pytest.mark.long
def test_the_page(tmp_path, monkeypatch, capsys):
    page = page_at(tmp_path)
    monkeypatch.setattr(gpu, "IMAGE_PRESETS", (quick_high(),))
    monkeypatch.setattr(gpu, "CASE_COUNT", 400)
    words = ["gpu", "--device", "cpu", "--page", str(page), *TINY]
    monkeypatch.setattr(sys, "argv", words)
    gpu.main()
    text = page.read_text(encoding="utf-8")
    assert text.startswith(Path("docs/gpu.md").read_text(encoding="utf-8").partition("<!--")[0])
    for stage in ("copy", "check", "plan", "filter", "tessellate", "merge", "network", "all"):
        assert f"| 300 | {stage} | " in text
    assert "300: runs give the same bits; PSNR of 4 images " in text
    assert text.count("\n| 300 | ") >= 10
    assert "| gsplat | not available: " in text
    for name in ("torch", "numba", "scene", "local"):
        assert f"\n| {name} | " in text
    assert capsys.readouterr().out.strip() in text


def quick_high() -> dict[str, object]:
    changes = {"steps": 2, "check_every": 2, "size": 32, "heldout": 4, "batch": 4}
    return {"preset": "high", "refine": changes, "visibility": {"views": 4, "size": 32}}


@pytest.mark.long
def test_the_page_of_the_pretended_device(tmp_path, monkeypatch):
    page = page_at(tmp_path)
    monkeypatch.setattr(gpu, "IMAGE_PRESETS", (quick_high(),))
    monkeypatch.setattr(gpu, "CASE_COUNT", 400)
    monkeypatch.setattr(gpu, "TRAININGS", ())  # tests/train trains there; views take a minute
    monkeypatch.setattr(sys, "argv", ["gpu", "--page", str(page), *TINY])
    with pretended_cuda():
        gpu.main()
    text = page.read_text(encoding="utf-8")
    assert "a pretended device; CPU: " in text
    assert "300: runs give the same bits; PSNR of 4 images " in text
    assert text.count("\n| 300 | ") >= 10
    for start in ("300 | network", "300, 300", "torch"):
        assert f"\n| {start} | " in text


def test_cpu_and_device_are_measured_by_the_same_rule(monkeypatch):
    """Medians after a warm-up, peaks over the stages, and no peak of the copy."""
    device, runs, seconds = torch.device("cpu"), [], iter([100.0, 1.0, 5.0, 3.0])
    repeat = gpu.repeat
    monkeypatch.setattr(gpu, "VIEWS", 1)
    monkeypatch.setattr(gpu, "seconds", lambda *_: next(seconds))
    monkeypatch.setattr(gpu, "repeat", lambda *a, **k: runs.append(k["runs"]) or repeat(*a, **k))
    assert gpu.color_table(device, [300], rho=0.1, runs=3)[2].startswith("| 300 | 3.000 | ")
    assert runs == [3, 3]
    monkeypatch.setattr(gpu, "seconds", lambda *_: 1.0)
    _, _, copy, *_ = gpu.stage_table(device, [300], rho=0.1, runs=1)
    assert copy == "| 300 | copy | 1.000 |  |  |  |"
    assert runs == [3, 3, 1, 1]
    peaks = gpu.stage_peaks([report_of(1, 8), report_of(4, 2)])
    assert peaks == {"filter": 4, "merge": 8, "all": 8}


def report_of(*peaks: int) -> SimpleNamespace:
    names = ("filter", "merge")
    stages = [
        SimpleNamespace(stage=name, seconds=1.0, peak_device_memory_bytes=peak)
        for name, peak in zip(names, peaks, strict=True)
    ]
    return SimpleNamespace(stages=stages)


def test_no_more_sites_than_points_are_searched(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["device_search", "--share", "2"])
    with pytest.raises(SystemExit):
        device_search.main()
    assert "--share must be above 0 and at most 1; found 2." in capsys.readouterr().err
    shares = []
    tables = ("stage", "files", "color", "preset", "renderer", "training")
    for name in tables:
        monkeypatch.setattr(gpu, f"{name}_table", lambda *_, **__: [])
    monkeypatch.setattr(gpu, "search_table", lambda *_, share, **__: shares.append(share) or [])
    monkeypatch.setattr(gpu, "around_tables", lambda *_, **__: ("", ""))
    monkeypatch.setattr(gpu, "renew_tables", lambda *_, **__: None)
    monkeypatch.setattr(sys, "argv", ["gpu", "--device", "cpu", "--rho", "0.25"])
    gpu.main()
    assert shares == [1.0]


@pytest.mark.parametrize("module", [effects, gpu, numerics])
def test_a_page_without_tables_is_refused_before_anything_is_measured(
    tmp_path, monkeypatch, module
):
    page = tmp_path / "page.md"
    name = module.__name__.partition(".")[2]
    words = ["--page", str(page), "--device", "cpu"] if module is gpu else ["-o", str(page)]
    monkeypatch.setattr(sys, "argv", [name, *words])
    for table in ("stage_table", "error_table", "effect_table"):
        monkeypatch.setattr(module, table, None, raising=False)
    with pytest.raises(InputNotFoundError):
        module.main()
    page.write_text(f"<!-- tables: python -m benchmarks.{name} -->")
    with pytest.raises(SystemExit, match=r"page\.md: must have the lines .* found none\."):
        module.main()


pytestmark = pytest.mark.slow

MARKS = "<!-- tables: python -m benchmarks.numerics -->", "<!-- end of tables -->"


@pytest.mark.slow
def test_errors_are_those_of_float32():
    found = numerics.figures(CASES["ball"], 200)
    assert 1 < found.condition < 1e4
    assert 0 < found.residual < 1e-13
    for value in (found.means, found.matrices, found.opacities, found.colors):
        assert 1e-9 < value < 1e-5
    assert found.images < 1e-4


def test_coarse_coordinates_increase_errors():
    near, far = (numerics.figures(CASES[name], 200).means for name in ("ball", "two_clusters"))
    assert far > 1000 * near


@pytest.mark.parametrize("name", ["nan_means", "one", "coincident", "tiny_world"])
def test_hard_cases_give_finite_figures(name):
    assert all(torch.isfinite(torch.tensor(numerics.figures(CASES[name], 60))))


def test_the_tables_of_a_page_are_updated(tmp_path, monkeypatch, capsys):
    page = tmp_path / "page.md"
    page.write_text(f"before\n{MARKS[0]}\nold\n{MARKS[1]}\nafter\n")
    words = ["numerics", "--case", "ball", "three", "--count", "60", "--timed", "0"]
    monkeypatch.setattr("sys.argv", [*words, "-o", str(page)])
    with pytest.raises(SystemExit):  # which would lose the other rows
        numerics.main()
    assert "old" in page.read_text()
    two = {name: CASES[name] for name in ("ball", "three")}
    monkeypatch.setattr(numerics, "catalogue", lambda: two)
    monkeypatch.setattr(numerics, "time_table", lambda *_: "")
    monkeypatch.setattr("sys.argv", ["numerics", "--count", "60", "-o", str(page)])
    numerics.main()
    text = page.read_text()
    assert text.startswith(f"before\n{MARKS[0]}\n\n| case | condition |")
    assert text.endswith(f"{MARKS[1]}\nafter\n")
    assert ("old" in text, text.count("| ball |"), text.count("| three |")) == (False, 1, 1)
    monkeypatch.setattr("sys.argv", words)
    numerics.main()
    assert "| three |" in capsys.readouterr().out


def test_times_are_compared_with_those_of_the_easy_scene():
    text = numerics.time_table({"coincident": CASES["coincident"]}, 300)
    assert "| case | standard | / ball | paper | / ball |" in text
    assert text.splitlines()[-1].startswith("| coincident |")
