"""``cvtgs tradeoff``: presets in separate processes, tables and files."""

import csv
import json
from pathlib import Path

import pytest

import cvtgs
from cvtgs.cli.main import main

LOOK = ["--views", "2", "--size", "48", "--lpips", "off"]


@pytest.fixture
def source(tmp_path) -> Path:
    path = tmp_path / "in.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 400, sh_degree=0, seed=3), path)
    return path


@pytest.mark.long
def test_the_table_is_printed_and_the_files_are_written(source, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    words = ["tradeoff", str(source), "--presets", "draft,standard", "--rho", "0.1", *LOOK]
    assert main([*words, "-o", str(tmp_path / "out"), "--save"]) == 0
    printed = capsys.readouterr()
    assert "rho 0.1: 40 of 400 Gaussians" in printed.out
    for row in ("preset", "tessellate, s", "all, s", "PSNR, dB", "SSIM", "memory"):
        assert row in printed.out
    assert f"Open {tmp_path / 'out' / 'index.html'} in a browser." in printed.out
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    files = ["index.html", "tradeoff.csv", "tradeoff.json", "tradeoff.png"]
    assert names == sorted([*files, "draft_0.1.ply", "standard_0.1.ply"])
    found = json.loads((tmp_path / "out" / "tradeoff.json").read_text())
    assert [one["count"] for one in found["results"]] == [40, 40]
    assert all(one["report"]["stages"] for one in found["results"])
    assert main([*words, "-o", str(tmp_path / "out")]) == 1
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.long
def test_a_failed_run_is_reported_and_the_others_continue(source, tmp_path, capsys, monkeypatch):
    from cvtgs.tradeoff import measure  # noqa: PLC0415 (patched below)

    real = measure.run_process

    def fails_once(command):
        if "draft" in command:
            raise cvtgs.errors.RunError("the disk is full.")
        return real(command)

    monkeypatch.setattr(measure, "run_process", fails_once)
    words = ["tradeoff", str(source), "--rho", "0.1", *LOOK, "-o", str(tmp_path / "out")]
    assert main([*words, "--presets", "draft,fast", "--quiet"]) == 1
    assert capsys.readouterr().err == (
        "cvtgs: warning: draft 0.1 failed: the disk is full.\n"
        f"cvtgs: error: 1 of 2 runs failed; {tmp_path / 'out'} has the others.\n"
    )
    found = json.loads((tmp_path / "out" / "tradeoff.json").read_text())
    (failure,) = found["failures"]
    reason = "the disk is full."
    assert failure == {"name": "draft 0.1", "preset": "draft", "rho": 0.1, "reason": reason}
    lines = csv.DictReader((tmp_path / "out" / "tradeoff.csv").read_text().splitlines())
    told = [(line["preset"], line["failure"], bool(line["psnr"])) for line in lines]
    assert told == [("fast", "", True), ("draft", reason, False)]
    assert main([*words, "--presets", "draft", "--overwrite"]) == 1
    error = "cvtgs: error: every run failed; draft 0.1: the disk is full.\n"
    assert capsys.readouterr().err == error


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--presets", "best"], "preset must be one of "),
        (["--views", "0"], "--views must be from 1 to 10,000, found 0."),
        (["--views", "10001"], "--views must be from 1 to 10,000, found 10,001."),
    ],
)
def test_invalid_arguments_are_refused_in_one_sentence(source, tmp_path, capsys, words, text):
    assert main(["tradeoff", str(source), "-o", str(tmp_path / "out"), *words]) == 1
    errors = capsys.readouterr().err
    assert errors.startswith(f"cvtgs: error: {text}")
    assert errors.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "words",
    [["--size", "1"], ["--backend", "gsplat", "--device", "cpu"], ["--cameras", "far.json"]],
)
def test_what_cannot_be_scored_is_found_before_the_runs(source, tmp_path, monkeypatch, words):
    def started(*_, **__):
        raise AssertionError("a run was started")

    monkeypatch.setattr("cvtgs.tradeoff.measure.run_process", started)
    monkeypatch.chdir(tmp_path)
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -1e6], [0, 0, 0, 1]]
    frames = [{"file_path": "0.png", "transform_matrix": pose}]
    Path("far.json").write_text(json.dumps({"w": 48, "h": 36, "fl_x": 40.0, "frames": frames}))
    line = ["tradeoff", str(source), "-o", "out", "--rho", "0.1", "--presets", "draft"]
    assert main([*line, "--lpips", "off", *words]) == 1


def test_a_missing_scene_is_found_before_the_runs(tmp_path, capsys):
    assert main(["tradeoff", str(tmp_path / "no.ply"), "-o", str(tmp_path / "out")]) == 1
    assert "no.ply: " in capsys.readouterr().err
