"""Speed: stages on one core against all."""

import math
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import cvtgs
from benchmarks import render, speed
from cvtgs.devices import core_count
from cvtgs.synthetic import demo_scene


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    cvtgs.save(demo_scene(2000, seed=0), tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def test_the_seconds_of_all_stages_are_their_sum(scene_file):
    seconds = speed.stage_seconds(scene_file, 0.1, "fast")
    total = seconds.pop("all")
    assert total == pytest.approx(sum(seconds.values()))
    assert {"plan", "tessellate", "merge"} <= seconds.keys()


def with_an_invalid_row(path: Path) -> Path:
    scene = demo_scene(2000, seed=0)
    scene.means[5] = math.nan
    cvtgs.save(scene, path)
    return path


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
def test_rows_with_nan_are_left_out(tmp_path):
    file = with_an_invalid_row(tmp_path / "scene.ply")
    assert speed.stage_costs(file, 0.1, "draft")["floor"] > 0
    options = SimpleNamespace(files=[file], device="cpu", views=1, size=16, child="torch")
    assert render.costs(options)["first"] > 0


@pytest.mark.skipif(core_count() < 2, reason="needs two cores")
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be given")
def test_one_core_is_compared_with_all(monkeypatch, capsys):
    """One core takes three times as long as all; afterwards all are available again."""
    before = core_count()

    def run_child(what: str, arguments: list[str]) -> dict[str, float]:
        assert (what, arguments[0]) == ("wall", "scene.ply")
        return {"merge": 3.0 if core_count() == 1 else 1.0}

    monkeypatch.setattr(speed, "run_child", run_child)
    monkeypatch.setattr(speed, "measure_processes", lambda *arguments: None)
    monkeypatch.setattr(speed, "measure_stages", lambda *arguments: None)
    monkeypatch.setattr(sys, "argv", ["speed", "scene.ply", "--runs", "2"])
    speed.main()
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == "| merge | 3.00 (3.00-3.00) | 1.00 (1.00-1.00) | 3.00 |"
    assert core_count() == before
