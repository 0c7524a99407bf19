"""``cvtgs simplify``: options, files, reports and invalid input."""

import json
import math
import weakref
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs.cli.main import main


@pytest.fixture
def source(tmp_path) -> Path:
    path = tmp_path / "in.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 500, sh_degree=1, seed=3), path)
    return path


def test_the_count_is_exact_and_printed(source, tmp_path, capsys):
    output = tmp_path / "out.ply"
    assert main(["simplify", str(source), str(output), "--rho", "0.07"]) == 0
    assert len(cvtgs.load(output)) == 35
    printed = capsys.readouterr()
    assert "500 -> 35 Gaussians, " in printed.out
    assert printed.err == ""


def test_count_sets_the_number_of_gaussians(source, tmp_path):
    output = tmp_path / "out.ply"
    assert main(["simplify", str(source), str(output), "--count", "123"]) == 0
    assert len(cvtgs.load(output)) == 123


def test_rho_1_writes_an_identical_file(source, tmp_path):
    output = tmp_path / "out.ply"
    assert main(["simplify", str(source), str(output), "--rho", "1"]) == 0
    assert output.read_bytes() == source.read_bytes()


def test_quiet_prints_nothing(source, tmp_path, capsys):
    main(["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.1", "--quiet"])
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")


def test_the_report_is_json_with_counts_costs_and_configuration(source, tmp_path):
    report = tmp_path / "report.json"
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.1"]
    assert main([*words, "--preset", "paper", "--report", str(report)]) == 0
    facts = json.loads(report.read_text())
    assert (facts["input_count"], facts["output_count"]) == (500, 50)
    assert facts["config"]["preset"] == "paper"
    stages = [stage["stage"] for stage in facts["stages"]]
    middle = ["filter", "weigh", "tessellate", "allocate"]
    assert stages == ["check", "plan", *middle, "merge", "network"]
    assert facts["checkpoint"] == "paper"
    assert all(stage["seconds"] >= 0 for stage in facts["stages"])


def test_settings_override_the_file_which_overrides_the_preset(source, tmp_path):
    config = tmp_path / "config.toml"
    config.write_text('preset = "paper"\n[cvt]\niterations = 2\ncolor = 0.2\n')
    report = tmp_path / "report.json"
    words = ["simplify", str(source), str(tmp_path / "out.ply"), "--rho", "0.1"]
    words += ["--config", str(config), "--set", "cvt.iterations=3", "--report", str(report)]
    assert main(words) == 0
    used = json.loads(report.read_text())["config"]
    assert (used["preset"], used["cvt"]["iterations"], used["cvt"]["color"]) == ("paper", 3, 0.2)
    assert used["merge"]["opacity"] == "union"


def test_an_existing_output_is_replaced_only_when_asked(source, tmp_path, capsys):
    output = tmp_path / "out.ply"
    output.write_text("precious")
    words = ["simplify", str(source), str(output), "--rho", "0.1"]
    assert main(words) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert output.read_text() == "precious"
    assert main([*words, "--overwrite"]) == 0
    assert len(cvtgs.load(output)) == 50


def test_a_scene_may_replace_itself(source):
    assert main(["simplify", str(source), str(source), "--rho", "0.1", "--overwrite"]) == 0
    assert len(cvtgs.load(source)) == 50


def test_invalid_rows_are_dropped_and_counted(tmp_path, capsys):
    scene = cvtgs.synthetic.scene("object", 100, sh_degree=0, seed=0)
    means = scene.means.clone()
    means[:3, 1] = math.nan
    source, output = tmp_path / "in.ply", tmp_path / "out.ply"
    cvtgs.save(scene.with_tensors({"means": means}, {}), source)
    assert main(["simplify", str(source), str(output), "--count", "98"]) == 0
    captured = capsys.readouterr()
    assert captured.err == (
        "cvtgs: warning: dropped 3 of 100 Gaussians with NaN, infinite or zero values (means 3).\n"
    )
    assert "Fewer than the requested 98: only 97 of 100 Gaussians are valid." in captured.out
    assert captured.out.count("\n") <= 5
    assert len(cvtgs.load(output)) == 97


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            ["--count", "501"],
            "count must be a whole number between 1 and the 500 Gaussians of the scene; ",
        ),
        (
            ["--rho", "0.1", "--preset", "best"],
            "preset must be one of draft, fast, standard, matched, high, paper; found 'best'.",
        ),
        (
            ["--rho", "0.1", "--set", "cvt.iterations"],
            "--set needs KEY=VALUE, for example cvt.iterations=10; found 'cvt.iterations'.",
        ),
        (["--rho", "0.1", "--set", "cvt.speed=1"], "cvt.speed: is not a known setting."),
        (["--rho", "0.1", "--device", "abacus"], "device 'abacus' cannot be used here: "),
    ],
)
def test_invalid_arguments_print_one_sentence_and_write_nothing(
    source, tmp_path, capsys, words, text
):
    output = tmp_path / "out.ply"
    assert main(["simplify", str(source), str(output), *words]) == 1
    errors = capsys.readouterr().err
    assert errors.startswith(f"cvtgs: error: {text}")
    assert errors.count("\n") == 1
    assert not output.exists()


def test_a_missing_folder_is_found_before_the_work(source, tmp_path, capsys):
    output = tmp_path / "nowhere" / "out.ply"
    assert main(["simplify", str(source), str(output), "--rho", "0.1"]) == 1
    assert str(output) in capsys.readouterr().err


def test_a_damaged_file_leaves_no_output(source, tmp_path, capsys):
    source.write_bytes(source.read_bytes()[:-10])
    output = tmp_path / "out.ply"
    assert main(["simplify", str(source), str(output), "--rho", "0.1"]) == 1
    errors = capsys.readouterr().err
    assert str(source) in errors
    assert errors.count("\n") == 1
    assert not output.exists()


def test_the_full_scene_takes_no_memory_while_the_result_is_written(source, tmp_path, monkeypatch):
    read, alive = [], []

    def load(path: Path, **options: object) -> cvtgs.GaussianScene:
        scene = load_scene(path, **options)
        read.append(weakref.ref(scene.means))
        return scene

    def save(scene: cvtgs.GaussianScene, path: Path, **options: object) -> None:
        alive.extend(means() is not None for means in read)
        save_scene(scene, path, **options)

    load_scene, save_scene = cvtgs.io.load, cvtgs.io.save
    monkeypatch.setattr(cvtgs.io, "load", load)
    monkeypatch.setattr(cvtgs.io, "save", save)
    assert main(["simplify", str(source), str(tmp_path / "small.sog"), "--rho", "0.5"]) == 0
    assert alive == [False]


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_gives_the_same_count(source, tmp_path):
    output = tmp_path / "out.ply"
    assert main(["simplify", str(source), str(output), "--rho", "0.1", "--device", "cuda"]) == 0
    assert len(cvtgs.load(output)) == 50
