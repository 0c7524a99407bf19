"""The comparison from end to end on a tiny scene, and how its tables and plots are made."""

import json
import math
import re
import shutil
import sys
from dataclasses import replace

import pytest
import torch

import cvtgs
import lpips_cases
from benchmarks import compare, compare_tables, quality
from benchmarks.baselines import BASELINES, baseline
from benchmarks.measuring import Cost, names_of, run
from cvtgs.evaluation import EvaluationSettings
from cvtgs.evaluation.images import as_bytes, encode
from cvtgs.views import automatic_views

pytestmark = pytest.mark.slow

COPY = """
import json
import re
import sys

import torch

import cvtgs

full = cvtgs.load(sys.argv[1])
rows = torch.arange(int(sys.argv[3]) + int(sys.argv[4]))
cvtgs.save(full.select(rows), sys.argv[2], overwrite=True)
"""


@pytest.fixture(autouse=True)
def _small_images(monkeypatch):
    monkeypatch.setattr(quality, "VIEWS", 2)
    monkeypatch.setattr(quality, "SIZE", 48)


@pytest.fixture
def file(tmp_path):
    cvtgs.save(cvtgs.synthetic.scene("object", 1000, sh_degree=0, seed=0), tmp_path / "thing.ply")
    return tmp_path / "thing.ply"


def rows_of(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def result(psnr: float, *, seconds: float = 2.0, lpips: float | None = None, count: int = 10):
    found = quality.Quality(psnr=psnr, ssim=0.5, lpips=lpips)
    return compare_tables.Result(
        quality=found, wall_seconds=seconds, cpu_seconds=1.0, count=count, wanted=10
    )


@pytest.mark.long
def test_methods_and_a_tool_are_run_judged_and_reported(file, tmp_path, capsys):
    (tmp_path / "first_rows.py").write_text(COPY)
    tool = f"copy={sys.executable} {tmp_path / 'first_rows.py'} {{IN}} {{OUT}} {{COUNT}} 1"
    out = tmp_path / "new"
    methods = ["standard, no network", "mass pruning"]
    compare.main(
        [str(file), "--rho", "0.05", "--methods", *methods, "--tool", tool, "-o", str(out)]
    )
    text = capsys.readouterr().out
    head, _, *rows = rows_of(text)
    assert head == ["method", "PSNR", "SSIM", "alpha error", "alpha bias", "s"]
    assert [row[0] for row in rows] == [*methods, "copy", "method", "---", *methods, "copy"]
    assert all(5 < float(row[1]) < 60 and 0 < float(row[2]) <= 1 for row in rows[:3])
    assert all(abs(float(row[4])) <= float(row[3]) < 1 for row in rows[:3])
    assert all(0 < float(row[5]) < 100 for row in rows[:3])
    assert rows[3] == ["method", "thing"]
    assert rows[5][1].startswith(f"{float(rows[0][1]):.1f} / ")
    assert "- copy, thing, 0.05: 51 instead of 50" in text
    assert "Failed" not in text
    assert (out / "compare.md").read_text().strip() == text.strip()
    assert (out / "compare.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.long
@pytest.mark.parametrize("background", ["black", "white"])
def test_the_table_has_the_scores_of_the_baseline(file, capsys, background):
    arguments = [str(file), "--rho", "0.1", "--methods", "mass pruning"]
    compare.main([*arguments, "--background", background])
    full, settings = (
        cvtgs.load(file),
        EvaluationSettings(background=quality.BACKGROUNDS[background], lpips="off"),
    )
    small = {"pruned": baseline("mass pruning")(full, 100)}
    views = automatic_views(full, 2, width=48, height=48)
    (found,) = cvtgs.evaluate(full, small, views, settings=settings).scenes
    text = capsys.readouterr().out
    assert rows_of(text)[2][1:4] == [
        f"{found.psnr.mean:.2f}",
        f"{found.ssim.mean:.4f}",
        f"{found.alpha_error.mean:.4f}",
    ]
    assert f"renderer, 2 automatic views of 48 x 48 pixels, over {background}. " in text


@pytest.mark.long
def test_a_failing_tool_does_not_stop_the_others(file, tmp_path, capsys):
    broken = f"broken={sys.executable} -c raise({{COUNT}}) {{IN}} {{OUT}}"
    silent = f"silent={sys.executable} -c pass {{IN}} {{OUT}}"
    missing = "missing=/no/such/tool {IN} {OUT}"
    tools = [part for tool in (broken, silent, missing) for part in ("--tool", tool)]
    arguments = ["--rho", "0.1", "--methods", "opacity pruning", *tools, "-o", str(tmp_path)]
    compare.main([str(file), *arguments])
    text = capsys.readouterr().out
    assert [row[1:] for row in rows_of(text)[3:6]] == [["-"] * 5] * 3
    assert [row[1:] for row in rows_of(text)[-3:]] == [["-"]] * 3
    assert float(rows_of(text)[2][1]) > 5
    assert "Failed:\n\n- broken, thing, 0.1\n- silent, thing, 0.1\n- missing, thing, 0.1" in text


@pytest.mark.long
def test_another_judge_and_lpips(file, tmp_path, capsys):
    torch.save(dict(lpips_cases.random_state("alex")), tmp_path / "weights.pth")
    weights = str(tmp_path / "weights.pth")
    arguments = [str(file), "--rho", "0.1", "--methods", "opacity pruning", "--means"]
    compare.main([*arguments, "--lpips", weights])
    head, _, row = rows_of(capsys.readouterr().out)
    assert head[3] == "LPIPS"
    assert float(row[3]) > 0
    (tmp_path / "judge.py").write_text('print(\'[{"psnr": 7, "ssim": 1}]\')')
    compare.main([*arguments, "--scorer", f"{sys.executable} {tmp_path / 'judge.py'}"])
    text = capsys.readouterr().out
    assert rows_of(text)[0] == ["method", "PSNR", "SSIM", "s"]
    assert rows_of(text)[2][1:3] == ["7.00", "1.0000"]
    assert f"Judge: the command {sys.executable} " in text


def test_settings_reach_cvtgs_and_all_methods_run_by_default():
    options = compare.parser().parse_args(["--set", "cvt.iterations=1"])
    commands = compare.commands_of(options)
    own = [f"{name} (cvt.iterations=1)" for name in [*cvtgs.PRESETS, "standard, no network"]]
    assert list(commands) == [*own, *BASELINES]
    assert all("cvt.iterations=1" in commands[name] for name in own)
    assert commands["NanoGS"][1:4] == ["-m", "benchmarks.baselines", "NanoGS"]


@pytest.mark.parametrize("tool", ["name", "name=tool {IN}", "name=tool {OUT}"])
def test_a_tool_without_placeholders_is_refused(tool):
    with pytest.raises(SystemExit, match="NAME=COMMAND"):
        compare.commands_of(compare.parser().parse_args(["--tool", tool]))


def test_a_tool_must_have_a_unique_name():
    options = compare.parser().parse_args(["--tool", "NanoGS=other {IN} {OUT}"])
    with pytest.raises(SystemExit, match="'NanoGS' already"):
        compare.commands_of(options)


def test_nothing_to_compare_is_refused():
    with pytest.raises(SystemExit, match="at least one"):
        compare.main(["--methods"])


def test_results_are_shown_without_running_anything(tmp_path, capsys):
    kept = {"a": {"x": {0.1: result(20.0)}}}
    (tmp_path / "results.json").write_text(compare_tables.results_json(kept))
    compare.main(["--results", str(tmp_path / "results.json"), "--methods", "--rho", "0.1"])
    assert rows_of(capsys.readouterr().out)[2] == ["x", "20.00", "0.5000", "2.0"]


def test_placeholders_are_filled_and_other_braces_stay():
    places = {"{IN}": "{OUT}.ply", "{OUT}": "b", "{COUNT}": "12"}
    assert compare.filled("--x={COUNT},{other}{{}}", places) == "--x=12,{other}{{}}"
    assert compare.filled("{IN}:{OUT}", places) == "{OUT}.ply:b"


def test_means_are_over_scenes_and_a_failure_leaves_a_dash():
    table = {
        "a": {
            "x": {0.1: result(20.0, lpips=0.1), 0.01: result(30.0)},
            "y": {0.1: result(10.0), 0.01: None},
        },
        "b": {"x": {0.1: result(30.0, seconds=4.0), 0.01: result(30.0)}, "y": {0.1: result(11.0)}},
    }
    text = compare_tables.markdown(table, [0.1, 0.01], means_only=True)
    assert rows_of(text) == [
        ["method", "PSNR", "SSIM", "LPIPS", "s"],
        ["---"] * 5,
        ["x", "25.00", "0.5000", "-", "3.0"],
        ["y", "10.50", "0.5000", "-", "2.0"],
        ["method", "PSNR", "SSIM", "LPIPS", "s"],
        ["---"] * 5,
        ["x", "30.00", "0.5000", "-", "2.0"],
        ["y", "-", "-", "-", "-"],
    ]
    single = compare_tables.scenes_table(table, 0.01)
    assert rows_of(single)[2:] == [["x", "30.0 / 0.500", "30.0 / 0.500"], ["y", "-", "-"]]
    cpu = compare_tables.markdown(table, [0.1, 0.01], means_only=True, clock="cpu")
    assert rows_of(cpu)[2][-1] == "1.0"
    assert compare_tables.failures(table).splitlines()[2:] == ["- y, a, 0.01"]
    assert compare_tables.wrong_counts(table) == ""


def test_results_are_joined_and_read_back_from_their_file(tmp_path):
    first = {"a": {"x": {0.1: result(20.0)}, "y": {0.1: result(10.0, lpips=0.5)}}}
    equal = {0.1: result(1.0), 1.0: result(math.inf)}
    second = {"a": {"x": {0.1: None, 0.01: result(30.0)}}, "b": {"z": equal}}
    both = compare_tables.joined(first, second)
    assert both["a"]["x"] == {0.1: None, 0.01: result(30.0)}
    assert both["a"]["y"] == first["a"]["y"]
    assert compare_tables.methods_of(both) == ["x", "y", "z"]
    text = compare_tables.results_json(both)
    json.loads(text, parse_constant=pytest.fail)  # which JSON lacks
    (tmp_path / "results.json").write_text(text)
    assert compare_tables.read_results(tmp_path / "results.json") == both
    assert compare_tables.read_results(tmp_path / "none.json") == {}


@pytest.mark.long
def test_kept_files_are_not_made_again_and_results_accumulate(file, tmp_path, capsys):
    (tmp_path / "first_rows.py").write_text(COPY)
    common = [str(file), "--rho", "0.05", "--results", str(tmp_path / "results.json")]
    common += ["--outputs", str(tmp_path / "kept"), "--methods"]
    tool = f"copy={sys.executable} {tmp_path / 'first_rows.py'} {{IN}} {{OUT}} {{COUNT}} 0"
    compare.main([*common, "--tool", tool])
    first = rows_of(capsys.readouterr().out)[2]
    (tmp_path / "first_rows.py").write_text("raise SystemExit(1)")
    compare.main([*common, "opacity pruning", "--tool", tool])
    rows = rows_of(capsys.readouterr().out)
    assert rows[2] == first
    assert rows[3][0] == "opacity pruning"


def test_kept_files_of_another_scene_or_command_are_not_used(file, tmp_path):
    """Scenes of one name, and settings, gave each other's results."""
    output = tmp_path / "kept.ply"
    first = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[2])"
    command = [sys.executable, "-c", first, "{IN}", "{OUT}"]
    task = compare.Task(source=file, rho=0.1, count=100, output=output)
    made, cost = compare.attempt(command, task, keep=True)
    assert compare.attempt(command, task, keep=True)[1] == cost
    cvtgs.save(made[:500], file, overwrite=True)
    assert len(compare.attempt(command, task, keep=True)[0]) == 500
    fails = [sys.executable, "-c", "raise SystemExit(1)", "{IN}", "{OUT}"]
    assert compare.attempt(fails, task, keep=True) is None


def test_names_of_kept_files_have_no_folders_and_all_digits():
    assert compare.kept_name("a", 0.1234564, "my/tool") == "a 0.1234564 my-tool.ply"


def test_results_say_how_they_were_scored(file, tmp_path):
    scene, task = cvtgs.load(file), compare.Task(source=file, rho=0.1, count=9, output=tmp_path)
    cost = Cost(wall_seconds=1.0, user_seconds=2.0, peak_bytes=3, output="", system="m")
    rows = compare.judged(
        scene,
        {("x", task): (scene, cost)},
        score=lambda full, small: [result(5.0).quality],
        judge="j",
        source="s",
    )
    assert rows == {
        "x": {
            0.1: compare_tables.Result(
                quality=result(5.0).quality,
                wall_seconds=1.0,
                cpu_seconds=2.0,
                count=1000,
                wanted=9,
                judge="j",
                source="s",
                system="m",
            )
        }
    }


def test_results_of_another_judge_are_not_mixed(file, tmp_path):
    scored = {"thing": {"x": {0.1: replace(result(20.0), judge="another")}}}
    (tmp_path / "results.json").write_text(compare_tables.results_json(scored))
    arguments = [str(file), "--results", str(tmp_path / "results.json"), "--methods", "draft"]
    with pytest.raises(
        SystemExit, match="results of thing by another judge \\(another\\); this is cvtgs'"
    ):
        compare.main(arguments)
    assert compare_tables.judges_of(scored) == ["another"]


def test_results_of_another_scene_are_not_mixed(file, tmp_path):
    """Scenes of one name, and generated ones of different sizes, were."""
    for arguments, name in ([str(file)], "thing"), (["--count", "50"], "object"):
        scored = {name: {"x": {0.1: replace(result(20.0), source="other")}}}
        (tmp_path / "results.json").write_text(compare_tables.results_json(scored))
        words = [*arguments, "--results", str(tmp_path / "results.json"), "--methods", "draft"]
        with pytest.raises(SystemExit, match=f"results of {name} of another scene"):
            compare.main(words)


def test_seconds_are_of_the_machines_and_versions_that_took_them():
    rows = {0.1: replace(result(20.0), system="old, cvtgs 0.1"), 0.2: result(1.0), 0.3: None}
    options = compare.parser().parse_args(["--rho", "0.1"])
    text = compare.report({"a": {"x": rows}}, options)
    assert "writing included; old, cvtgs 0.1; an unknown machine.\n" in text
    assert run([sys.executable, "-c", ""]).system.endswith(f", cvtgs {cvtgs.__version__}")


def test_kept_files_of_another_version_are_not_used(file, tmp_path, monkeypatch):
    command = [sys.executable, "-m", "shutil", "{IN}", "{OUT}"]
    task = compare.Task(source=file, rho=0.1, count=100, output=tmp_path / "kept.ply")
    cost, runs = Cost(wall_seconds=1.0, user_seconds=2.0, peak_bytes=3, output=""), []

    def copied(words):
        runs.append(words)
        shutil.copy(words[3], words[4])
        return cost

    monkeypatch.setattr(compare, "run", copied)
    for version, count in ("1", 1), ("1", 1), ("2", 2):
        monkeypatch.setattr(cvtgs, "__version__", version)
        assert compare.attempt(command, task, keep=True)[1] == cost
        assert len(runs) == count


def test_a_wrong_scorer_is_found_before_anything_runs(file, monkeypatch):
    monkeypatch.setattr(compare, "attempt", None)
    with pytest.raises(SystemExit, match="--images needs the cameras"):
        compare.main([str(file), "--images", ".", "--methods", "draft"])


def test_scenes_of_one_name_are_told_apart(tmp_path):
    files = [tmp_path / part for part in ("a/x.ply", "b/x.ply", "b/x.spz", "b/y.ply")]
    assert names_of(files) == ["a-x.ply", "b-x.ply", "b-x.spz", "y"]
    models = [tmp_path / name / "point_cloud" / "point_cloud.ply" for name in ("a", "b")]
    assert names_of(models) == [f"{name}-point_cloud-point_cloud.ply" for name in ("a", "b")]
    with pytest.raises(SystemExit, match=r"x\.ply: is given 2 times\."):
        names_of([files[1], files[1]])


def test_the_plot_omits_what_failed_on_a_scene(monkeypatch):
    table = {
        "a": {
            "x": {0.1: result(20.0), 0.01: result(10.0)},
            "y": {0.1: result(9.0), 0.01: None},
            "z": {0.1: None},
        }
    }
    drawn = []
    monkeypatch.setattr(compare_tables, "line_chart", lambda panels, **_: drawn.extend(panels))
    compare_tables.chart(table, [0.1, 0.01])
    lines = {line.name: (line.x, line.y, line.markers) for line in drawn[0].series}
    assert lines == {"x": ([2.0, 2.0], [20.0, 10.0], True), "y": ([2.0], [9.0], True)}
    assert drawn[0].log_x
    assert compare_tables.chart({"a": {"z": {0.1: None}}}, [0.1]) is None


@pytest.mark.long
def test_photographs_judge_instead_of_the_full_scene(file, tmp_path, capsys):
    """The photographs are images of the copy that the tool makes, which is nearly perfect."""
    full = cvtgs.load(file)
    cameras = automatic_views(full, 2, width=48, height=36)
    folder = tmp_path / "capture"
    folder.mkdir()
    frames = []
    for number, camera in enumerate(cameras.singles()):
        pose = torch.linalg.inv(camera.viewmats[0].double())
        pose[:, 1:3] *= -1
        frames.append({"file_path": f"{number}.png", "transform_matrix": pose.tolist()})
        image = cvtgs.render(full.select(torch.arange(500)), camera).rgb[0]
        (folder / f"{number}.png").write_bytes(encode(as_bytes(image), "png"))
    told = {"w": 48, "h": 36, "fl_x": float(cameras.Ks[0, 0, 0]), "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(told))
    (tmp_path / "first_rows.py").write_text(COPY)
    tool = f"copy={sys.executable} {tmp_path / 'first_rows.py'} {{IN}} {{OUT}} {{COUNT}} 0"
    words = [str(file), "--rho", "0.5", "--methods", "mass pruning", "--tool", tool]
    words += ["--cameras", str(folder), "--images", str(folder)]
    compare.main(words)
    text = capsys.readouterr().out
    head, _, pruned, copied = rows_of(text)[:4]
    assert head == ["method", "PSNR", "SSIM", "s"]
    assert float(copied[1]) > 45 > float(pruned[1])
    assert f"the cameras of {folder} against the photographs in {folder}, over black" in text


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--images", "."], "--images needs the cameras of the photographs: --cameras."),
        (["--cameras", "."], "--cameras needs exactly one scene, found 0 scenes."),
    ],
)
def test_unusable_cameras_and_photographs_are_refused(words, text):
    with pytest.raises(SystemExit, match=re.escape(text)):
        compare.main([*words, "--count", "50", "--rho", "0.5", "--methods", "mass pruning"])
