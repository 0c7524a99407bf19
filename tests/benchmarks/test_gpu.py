"""The benchmark of devices: its page, at tiny sizes, on the CPU and on the pretended device."""

import sys
from pathlib import Path

import pytest
import torch

from benchmarks import gpu
from pretended_device import pretended_cuda

TINY = ["--counts", "300", "--rho", "0.1", "--runs", "1", "--size", "24", "--steps", "3"]


def page_at(tmp_path: Path) -> Path:
    page = tmp_path / "gpu.md"
    page.write_text(Path("docs/gpu.md").read_text(encoding="utf-8"), encoding="utf-8")
    return page


@pytest.mark.slow
def test_the_page(tmp_path, monkeypatch, capsys):
    page = page_at(tmp_path)
    monkeypatch.setattr(gpu, "HIGH", quick_high())
    monkeypatch.setattr(gpu, "CASE_COUNT", 400)
    words = ["gpu", "--device", "cpu", "--page", str(page), *TINY]
    monkeypatch.setattr(sys, "argv", words)
    gpu.main()
    text = page.read_text(encoding="utf-8")
    assert text.startswith(Path("docs/gpu.md").read_text(encoding="utf-8").partition("<!--")[0])
    for stage in ("copy", "check", "plan", "filter", "tessellate", "merge", "network", "all"):
        assert f"| 300 | {stage} | " in text
    assert "300: runs give the same bits; 0 of 30 Gaussians differ" in text
    assert "| gsplat | not here: " in text
    for name in ("torch", "numba", "scene", "local"):
        assert f"\n| {name} | " in text
    assert capsys.readouterr().out.strip() in text


def quick_high() -> dict[str, object]:
    changes = {"steps": 2, "check_every": 2, "size": 32, "heldout": 4, "batch": 4}
    return {"preset": "high", "refine": changes, "visibility": {"views": 4, "size": 32}}


@pytest.mark.slow
def test_stages_on_the_pretended_device():
    with pretended_cuda():
        lines = gpu.stage_table(torch.device("cuda"), [300], rho=0.1, runs=1)
    assert any(line.startswith("| 300 | network | ") for line in lines)
    assert "300: runs give the same bits; 0 of 30 Gaussians differ" in lines[-2]
