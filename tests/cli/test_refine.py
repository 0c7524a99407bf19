"""``cvtgs simplify --refine``: options, report, summary and interrupts."""

import io
import json
import re
import signal
from importlib import import_module
from pathlib import Path

import pytest

import cvtgs
from cvtgs.cli.display import progress_bars
from cvtgs.cli.main import main
from cvtgs.progress import ProgressEvent


@pytest.fixture
def source(tmp_path) -> Path:
    path = tmp_path / "in.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 400, sh_degree=1, seed=3), path)
    return path


@pytest.mark.long
def test_steps_are_in_the_report_and_the_summary(source, tmp_path, capsys):
    output, report = tmp_path / "out.ply", tmp_path / "report.json"
    words = ["simplify", str(source), str(output), "--rho", "0.1", "--report", str(report)]
    assert main([*words, "--refine-steps", "5"]) == 0
    facts = json.loads(report.read_text())
    assert facts["stages"][-1]["stage"] == "refine"
    assert facts["refinement"]["steps"] == 5
    assert facts["refinement"]["gain"] >= 0
    assert facts["output_count"] == len(cvtgs.load(output)) == 40
    assert cvtgs.load(output).sh_degree == 1
    printed = capsys.readouterr().out
    assert re.search(r"Refined in 5 steps: \+[\d.]+ dB on held-out images\.", printed)
    assert " refine " in " ".join(printed.split())


@pytest.mark.long
def test_steps_of_the_option_are_not_multiplied_for_few_gaussians(source, tmp_path):
    report = tmp_path / "report.json"
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.1"]
    words += ["--preset", "matched", "--refine-steps", "5", "--report", str(report)]
    assert main(words) == 0
    assert json.loads(report.read_text())["refinement"]["steps"] == 5


@pytest.mark.slow
def test_refine_stops_at_its_time_limit_or_earlier(source, tmp_path):
    report = tmp_path / "report.json"
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.1"]
    assert main([*words, "--refine", "1", "--report", str(report)]) == 0
    assert json.loads(report.read_text())["refinement"]["stopped"] in ("time", "patience")


def test_refinement_is_off_by_default(source, tmp_path):
    report = tmp_path / "report.json"
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.1"]
    assert main([*words, "--report", str(report)]) == 0
    assert json.loads(report.read_text())["refinement"] is None


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            ["--refine-steps", "-2"],
            "--refine-steps must be at least 0, found -2.",
        ),
        *(
            (
                ["--refine", seconds, "--refine-steps", steps],
                "--refine and --refine-steps must both be above 0, or one of them be left out: 0 "
                f"turns refinement off; found {seconds} and {steps}.",
            )
            for seconds, steps in (("0", "5"), ("2.5", "0"))
        ),
    ],
)
def test_invalid_limits_are_refused_before_the_work(tmp_path, capsys, words, text):
    missing = str(tmp_path / "missing.ply")
    assert main(["simplify", missing, str(tmp_path / "out.ply"), "--rho", "0.1", *words]) == 1
    assert capsys.readouterr().err == f"cvtgs: error: {text}\n"


@pytest.mark.slow
def test_an_interrupt_leaves_no_output(source, tmp_path, capsys, monkeypatch):
    module = import_module("cvtgs.refinement.optimize")
    honest, calls = module.relative_loss, []

    def interrupted(image, target, **weights):
        calls.append(1)
        if len(calls) == 3:
            signal.raise_signal(signal.SIGINT)
        return honest(image, target, **weights)

    monkeypatch.setattr(module, "relative_loss", interrupted)
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.1"]
    words += ["--report", str(tmp_path / "report.json"), "--refine-steps", "50"]
    assert main(words) == 130
    assert len(calls) == 3
    assert capsys.readouterr().err == "cvtgs: interrupted; no incomplete file is left.\n"
    assert [path.name for path in tmp_path.iterdir()] == ["in.ply"]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_progress_bar_shows_the_gain(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr", Terminal())
    with progress_bars(quiet=False) as listener:
        for done, note in ((0, ""), (1, "+0.50 dB"), (2, "+1.25 dB"), (2, "")):
            listener(ProgressEvent(stage="refine", done=done, total=2, note=note))
        import sys  # noqa: PLC0415 (after sys.stderr is patched)

        stream = sys.stderr
    assert "refine +1.25 dB" in stream.getvalue()
