"""Time budgets: the seconds of writing the output file count."""

import argparse
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest

import cvtgs
from camera_files import inria, write_json
from cvtgs.budget import CostModel
from cvtgs.cli.goals import ChosenPreset, _seconds_to_write, choose_preset
from cvtgs.cli.main import build_parser, main
from cvtgs.errors import GoalError
from cvtgs.progress import silent

MODEL = CostModel(rates={"plan": {"once": 0.0}, "refine": {"look_pixels": 2.5e-7}})


@pytest.fixture
def scene() -> cvtgs.GaussianScene:
    return cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=0)


def options(name: str = "out.ply") -> argparse.Namespace:
    words = ["simplify", "in.ply", name, "--rho", "0.1", "--time-budget", "8s", "--device", "cpu"]
    known = build_parser().parse_args(words)
    known.begun, known.output = time.perf_counter(), Path(name)
    return known


def test_a_time_budget_leaves_time_for_writing(
    scene: cvtgs.GaussianScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 8 s, `high` takes 4; a file that takes 5 leaves too little for it."""
    monkeypatch.setattr(cvtgs.budget, "cost_model", lambda *_, **__: MODEL)
    monkeypatch.setattr("cvtgs.budget.calibrate.is_calibrated", lambda _: True)
    chosen = {}
    for seconds in (0.0, 5.0):
        monkeypatch.setattr("cvtgs.cli.goals._seconds_to_write", lambda *_, s=seconds: s)
        chosen[seconds] = choose_preset(options(), scene, {}, silent)
        assert chosen[seconds].reason.endswith(f"and writing takes about {seconds:.1f} s.")
    assert chosen[0.0].name == "high"
    assert chosen[5.0].name != "high"
    monkeypatch.setattr("cvtgs.cli.goals._seconds_to_write", lambda *_: 8.0)
    with pytest.raises(GoalError, match=r"no preset fits into 8 s: .* writing takes about 8\.0 s"):
        choose_preset(options(), scene, {}, silent)


def test_a_run_whose_file_takes_too_long_says_so(
    scene: cvtgs.GaussianScene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def slowly(*given: Any, **named: Any) -> None:
        monkeypatch.setattr(time, "perf_counter", lambda: clock() + 10.0)
        save(*given, **named)

    save, clock = cvtgs.io.save, time.perf_counter
    save(scene, tmp_path / "in.ply")
    chosen = ChosenPreset("draft", "a reason.", 10.0, "advice")
    monkeypatch.setattr("cvtgs.cli.simplify.choose_preset", lambda *_, **__: chosen)
    words = ["simplify", str(tmp_path / "in.ply"), str(tmp_path / "out.ply"), "--overwrite"]
    words += ["--rho", "0.1", "--time-budget", "8s"]
    assert main(words) == 0
    assert "Simplifying and writing" not in capsys.readouterr().out
    monkeypatch.setattr("cvtgs.io.save", slowly)
    assert main(words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Simplifying and writing took 10." in said
    assert "where 10.0 s were left; advice." in said


def test_a_time_budget_counts_the_cameras_that_are_given_or_found(
    scene: cvtgs.GaussianScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def note(*given: Any, cameras: cvtgs.Cameras | None, **named: Any) -> ChosenPreset:
        counts.append(None if cameras is None else len(cameras))
        return ChosenPreset("draft", "a reason.", 10.0, "advice")

    counts: list[int | None] = []
    monkeypatch.setattr("cvtgs.cli.simplify.choose_preset", note)
    source, other = tmp_path / "a" / "in.ply", tmp_path / "other.json"
    source.parent.mkdir()
    cvtgs.io.save(scene, source)
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.1", "--overwrite"]
    words += ["--time-budget", "8s", "--quiet"]
    assert main(words) == 0
    write_json(source.parent / "cameras.json", inria())
    assert main(words) == 0
    write_json(other, inria()[:4])
    assert main([*words, "--cameras", str(other)]) == 0
    assert counts == [None, 10, 4]


def test_few_cameras_leave_time_for_a_better_preset(
    scene: cvtgs.GaussianScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each image takes 0.1 s: the 72 of `high` do not fit, ten do."""
    rates = {"plan": {"once": 0.0}, "visibility": {"views_in": 0.1 / len(scene)}}
    monkeypatch.setattr(cvtgs.budget, "cost_model", lambda *_, **__: CostModel(rates=rates))
    monkeypatch.setattr("cvtgs.budget.calibrate.is_calibrated", lambda _: True)
    cameras = cvtgs.views.automatic_views(scene, 10, width=32, height=24)
    assert choose_preset(options(), scene, {}, silent).name == "matched"
    assert choose_preset(options(), scene, {}, silent, cameras=cameras).name == "high"


@pytest.mark.parametrize("name", ["out.ply", "out.sog"])
def test_the_seconds_of_writing_follow_from_a_sample(
    scene: cvtgs.GaussianScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A second for libraries, 0.01 for a file, and 0.001 for each Gaussian."""

    def timed(part: cvtgs.GaussianScene, *given: Any, **named: Any) -> None:
        save(part, *given, **named)
        now[0] += (1.0 if now[0] == 0.0 else 0.0) + 0.009 + 0.001 * len(part)

    save, now = cvtgs.io.save, [0.0]
    monkeypatch.setattr("cvtgs.io.save", timed)
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    assert _seconds_to_write(options(name), scene, 30_000) == pytest.approx(30.0, rel=0.01)
    first, none = scene.means.clone(), scene.with_tensors({"means": scene.means * math.nan})
    first[0] = math.nan
    partly = scene.with_tensors({"means": first})
    assert _seconds_to_write(options(name), partly, 30_000) == pytest.approx(30.0, rel=0.01)
    assert _seconds_to_write(options(name), none, 30_000) == 0.0
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    assert _seconds_to_write(options(name), scene, 30_000) == 0.0
