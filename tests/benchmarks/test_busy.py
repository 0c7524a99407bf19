"""Time beside programs that use the same cores."""

import json
import sys
from types import SimpleNamespace

import psutil
import pytest

import cvtgs
from benchmarks import busy
from cvtgs.synthetic import demo_scene


def loops_now() -> int:
    return sum("while True: pass" in child.cmdline() for child in psutil.Process().children())


def test_loops_run_only_meanwhile():
    with busy.endless_loops(2):
        assert loops_now() == 2
    assert loops_now() == 0


@pytest.mark.long
def test_every_operation_is_measured(tmp_path, monkeypatch):
    cvtgs.save(demo_scene(500, seed=0), tmp_path / "scene.ply")
    monkeypatch.setattr(busy, "warm_up", lambda: None)
    found = busy.measure(tmp_path / "scene.ply", 2)
    assert {"`standard` at 0.01", "save as `.sog`"} <= found.keys()
    assert all(len(seconds) == 2 and min(seconds) > 0 for seconds in found.values())


def test_a_quiet_run_is_compared_with_one_beside_loops(monkeypatch, capsys):
    loops = []

    def run_python(*words: str) -> SimpleNamespace:
        loops.append(loops_now())
        return SimpleNamespace(output=json.dumps({"save": [1.0 + loops[-1]]}))

    monkeypatch.setattr(busy, "run_python", run_python)
    monkeypatch.setattr(sys, "argv", ["busy", "scene.ply", "--loops", "1", "--runs", "1"])
    busy.main()
    assert loops == [0, 1]
    assert "| save | 1.00 (1.00-1.00) | 2.00 (2.00-2.00) |" in capsys.readouterr().out
