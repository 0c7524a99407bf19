"""Goals on the command line: valid combinations, time budgets, and printed notes."""

import argparse
import json
import re
import shutil
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

import pytest

import cvtgs
from cvtgs.budget import CostModel, Found
from cvtgs.budget.calibrate import CANDIDATES
from cvtgs.budget.costs import FEATURES
from cvtgs.cli.cameras import own_cameras, read_cameras
from cvtgs.cli.display import target_note
from cvtgs.cli.goals import (
    STARTED,
    SearchViews,
    check_goals,
    choose_preset,
    search_target,
    views_of_search,
)
from cvtgs.cli.main import build_parser, main
from cvtgs.errors import GoalError, InvalidArgumentError
from cvtgs.progress import silent
from cvtgs.report import SimplifyReport
from cvtgs.text import counted

MODEL = CostModel(rates={"check": {"in": 1e-6}, "refine": {"look_pixels": 2.5e-7}})


def options(*words: str) -> argparse.Namespace:
    words = ("in.ply", "out.ply", "--device", "cpu", *words)
    known = build_parser().parse_args(["simplify", *words])
    known.begun, known.output = STARTED, Path("out.ply")
    return known


@pytest.fixture(scope="module")
def scene() -> cvtgs.GaussianScene:
    return cvtgs.synthetic.scene("object", 300, sh_degree=0, seed=0)


@pytest.fixture
def measured(monkeypatch) -> list[bool]:
    """Replace the calibration; the list records for each call whether it was to recalibrate."""
    asked: list[bool] = []

    def known(device, *, recalibrate, listener):
        asked.append(recalibrate)
        return MODEL

    monkeypatch.setattr(cvtgs.budget, "cost_model", known)
    monkeypatch.setattr("cvtgs.budget.calibrate.is_calibrated", lambda device: len(asked) > 0)
    monkeypatch.setattr("cvtgs.cli.goals.time.perf_counter", lambda: STARTED)
    return asked


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("20s", 20.0),
        ("20", 20.0),
        (" 2m", 120.0),
        ("1.5min", 90.0),
        ("0.5h", 1800.0),
        (" 30 S", 30.0),
        ("500ms", 0.5),
    ],
)
def test_times_are_read_in_seconds(text, seconds):
    assert options("--rho", "0.1", "--time-budget", text).time_budget == seconds
    assert options("--rho", "0.1", "--refine", text).refine == seconds


@pytest.mark.parametrize("option", ["--time-budget", "--refine"])
@pytest.mark.parametrize("text", ["", "s", "-3s", "20 parsecs", "nan", "inf", "1:30", "1.2.3s"])
def test_invalid_times_are_refused(option, text, capsys):
    with pytest.raises(SystemExit):
        options("--rho", "0.1", f"{option}={text}")
    assert f"{option}: must be a time in ms, s, min or h, for" in capsys.readouterr().err


def test_some_options_exclude_each_other(capsys):
    for words in (
        ["--rho", "0.1", "--target-psnr", "30"],
        ["--target-psnr", "3", "--count", "5"],
        ["--rho", "0.1", "--time-budget", "2m", "--shipped-rates", "--recalibrate"],
    ):
        with pytest.raises(SystemExit):
            options(*words)
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            ["--rho", "0.1", "--time-budget", "0s"],
            "--time-budget must be above 0 and finite, found 0 s.",
        ),
        (["--rho", "0.1", "--recalibrate"], "--recalibrate needs --time-budget."),
        (["--rho", "0.1", "--shipped-rates"], "--shipped-rates needs --time-budget."),
        (
            ["--rho", "0.1", "--time-budget", "2m", "--preset", "fast", "--refine", "3"],
            "--time-budget chooses the preset and cannot be used with --preset, --refine.",
        ),
        (
            ["--rho", "0.1", "--time-budget", "2m", "--refine-steps", "3"],
            "--time-budget chooses the preset and cannot be used with --refine-steps.",
        ),
        (
            ["--target-psnr", "30", "--time-budget", "2m"],
            "--time-budget chooses the preset and cannot be used with --target-psnr.",
        ),
        (
            ["--rho", "0.1", "--time-budget", "1e400"],
            "--time-budget must be above 0 and finite, found inf s.",
        ),
    ],
)
def test_invalid_combinations_of_goals_are_refused(words, text):
    with pytest.raises(InvalidArgumentError) as caught:
        check_goals(options(*words))
    assert str(caught.value).startswith(text)


@pytest.fixture
def source(scene, tmp_path) -> Path:
    path = tmp_path / "in.ply"
    cvtgs.save(scene, path)
    return path


@pytest.fixture
def shown(monkeypatch) -> set[str]:
    """The stages whose progress is shown."""
    stages: set[str] = set()
    listeners = nullcontext(lambda event: stages.add(event.stage))
    monkeypatch.setattr("cvtgs.cli.simplify.progress_bars", lambda **_: listeners)
    return stages


def simplified(source: Path, *words: str) -> cvtgs.GaussianScene:
    output = source.with_name("out.ply")
    assert main(["simplify", str(source), str(output), "--preset", "draft", *words]) == 0
    return cvtgs.load(output)


def test_without_goals_no_notes_are_printed(source, capsys, shown):
    check_goals(options("--rho", "0.1"))
    assert len(simplified(source, "--rho", "0.1")) == 30
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Seconds: check ")
    assert len(lines) <= 4
    assert "tessellate" in shown


@pytest.mark.usefixtures("measured")
def test_a_time_budget_chooses_a_preset_and_explains_it(scene):
    chosen = choose_preset(options("--rho", "0.1", "--time-budget", "8s"), scene, {}, silent)
    assert chosen.name == "high"
    assert chosen.reason.startswith("Preset high, the best that fits into 8 s: expected to take 4")
    assert chosen.left == 8.0
    assert chosen.advice == "--recalibrate measures this machine again"


@pytest.mark.parametrize(
    ("words", "settings", "preset"),
    [
        ([], {}, "fast"),
        ([], {"merge.network": "false"}, "standard"),
        (["--ckpt", "none"], {}, "standard"),
        (["--ckpt", "none"], {"refine.seconds": "2"}, "standard"),
        (["--ckpt", "none"], {"refine.seconds": "200"}, None),
    ],
)
def test_a_time_budget_accounts_for_the_other_settings(scene, monkeypatch, words, settings, preset):
    rates = {"network": {"once": 9.0}, "visibility": {"once": 999.0}, "refine": {"images_in": 0.0}}
    model = CostModel(rates=rates)
    monkeypatch.setattr(cvtgs.budget, "cost_model", lambda *_, **__: model)
    monkeypatch.setattr("cvtgs.budget.calibrate.is_calibrated", lambda device: True)
    monkeypatch.setattr("cvtgs.cli.goals.time.perf_counter", lambda: STARTED)
    budget = options("--rho", "0.1", "--time-budget", "5s", *words)
    check_goals(budget)
    if preset is None:
        ended = r"takes about 200 s .* Of 5 s, starting and reading took 0\.0 s, and writing .*\.$"
        with pytest.raises(GoalError, match=ended):
            choose_preset(budget, scene, settings, silent)
    else:
        assert choose_preset(budget, scene, settings, silent).name == preset


def test_the_machine_is_measured_once_or_on_request(scene, measured, capsys):
    words = ["--rho", "0.1", "--time-budget", "5s"]
    choose_preset(options(*words), scene, {}, silent)
    assert capsys.readouterr().err == (
        "cvtgs: measuring this machine once, about 10 seconds (--shipped-rates skips this)\n"
    )
    choose_preset(options(*words), scene, {}, silent)
    assert capsys.readouterr().err == ""
    choose_preset(options(*words, "--recalibrate", "--quiet"), scene, {}, silent)
    assert capsys.readouterr().err == ""
    assert measured == [True, False, True]


@pytest.mark.usefixtures("measured")
def test_a_budget_shorter_than_start_up_is_refused(scene, monkeypatch):
    monkeypatch.setattr("cvtgs.cli.goals.time.perf_counter", lambda: STARTED + 60)
    with pytest.raises(
        GoalError, match=r"fits into 5 s: starting and reading took 60\.0 s, and writing"
    ):
        choose_preset(options("--count", "10", "--time-budget", "5s"), scene, {}, silent)


@pytest.mark.long
def test_a_target_is_searched_and_reported(source, capsys, shown):
    report = source.with_name("report.json")
    small = simplified(source, "--target-psnr", "15", "--report", str(report))
    search = SimplifyReport.model_validate_json(report.read_bytes()).search
    assert search is not None
    assert (search.metric, search.target) == ("psnr", 15)
    assert search.psnr >= 15
    assert len(small) in [one.count for one in search.tried]
    lines = capsys.readouterr().out.splitlines()
    text = " ".join(" ".join(lines).split())
    assert f"300 -> {counted(len(small), 'Gaussian')}, " in text
    assert len(small) < 300
    assert "over automatic views; found in" in text
    assert "tessellate" not in shown


@pytest.mark.long
def test_a_target_is_measured_over_the_views_of_evaluate(source, capsys):
    simplified(source, "--target-psnr", "15")
    found = re.search(r"PSNR ([\d.]+) dB, SSIM ([\d.]+)", capsys.readouterr().out)
    scenes = [str(source), str(source.with_name("out.ply"))]
    assert main(["evaluate", *scenes, "--lpips", "off"]) == 0
    assert "  ".join(found.groups()) in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "beside", "given", "views"),
    [
        (["draft"], 0, 0, (0, None, "automatic views")),
        (["draft"], 12, 0, (12, 8, "8 cameras found in {beside}")),
        (["draft"], 12, 3, (3, 3, "the given cameras")),
        (["high"], 0, 0, (0, None, "automatic views that")),
        (["high"], 12, 0, (12, None, "automatic views that")),
        (["high"], 32, 0, (28, 4, "4 test cameras of {beside}, which")),
        (["high"], 80, 0, (70, 8, "8 test cameras of {beside}, which")),
        (["high"], 0, 3, (3, None, "automatic views that")),
        (["high"], 80, 90, (78, 12, "12 test cameras of {given}, which")),
        (["high", "--split", "train"], 0, 90, (78, 12, "12 test cameras of {given}, which")),
        (["high", "--split", "test"], 0, 90, (12, None, "automatic views that")),
    ],
)
def test_a_target_is_measured_over_views_that_no_preset_was_fitted_to(
    source: Path, scene: cvtgs.GaussianScene, words: list[str], beside: int, given: int, views: Any
) -> None:
    """These are automatic views unless cameras have a test split of at least four."""
    folders = {"beside": source.parent, "given": source.parent / "given"}
    asked = options("--target-psnr", "30", "--preset", *words)
    asked.input = source
    asked.cameras = write_cameras(folders["given"], given) if given else None
    write_cameras(folders["beside"], beside)
    cameras = read_cameras(asked)
    own = own_cameras(asked, scene, source) if cameras is None else None
    cameras = cameras if own is None else own.cameras
    found = views_of_search(asked, cvtgs.SimplifyConfig(preset=asked.preset), cameras, own)
    fitted, heldout, name = views
    assert len(found.cameras or ()) == fitted
    assert (found.heldout and len(found.heldout)) == heldout
    name = name.format(**{key: folder.resolve() for key, folder in folders.items()})
    assert found.name == name + " it was not fitted to" * name.endswith(("that", "which"))
    if found.heldout is not None and not given:
        assert (found.heldout.width, found.heldout.height) == (640, 480)
    if asked.preset == "high" and found.heldout is not None:
        assert not set(found.heldout.names) & set(found.cameras.names)


def write_cameras(folder: Path, count: int) -> Path:
    """Write some cameras that look at the scene, if there are any; return their folder."""
    poses = [
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4 + row / count], [0, 0, 0, 1]]
        for row in range(count)
    ]
    frames = [{"file_path": f"{r:03d}.png", "transform_matrix": p} for r, p in enumerate(poses)]
    folder.mkdir(exist_ok=True)
    if count:
        document = {"w": 48, "h": 36, "fl_x": 40.0, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def test_a_psnr_at_its_limit_is_at_least_that(scene):
    found = Found(scene, None, 60.0, 1.0, 0.0, 0.0, tried=())
    assert target_note(found, "views").startswith("PSNR at least 60.00 dB, SSIM 1.0000")
    assert target_note(found._replace(psnr=59.994), "views").startswith("PSNR 59.99 dB")


def test_shipped_rates_need_no_measurement(scene, measured, capsys):
    words = ["--rho", "0.1", "--time-budget", "2m", "--shipped-rates"]
    chosen = choose_preset(options(*words), scene, {}, silent)
    assert chosen.name in CANDIDATES
    assert (measured, capsys.readouterr().err) == ([], "")
    model = cvtgs.budget.shipped_model()
    assert set(FEATURES) <= set(model.rates)
    work = cvtgs.budget.Work(count=1_000_000, target=10_000)
    presets = map(cvtgs.SimplifyConfig.from_preset, ("draft", "standard", "matched", "high"))
    seconds = [model.seconds(work, config) for config in presets]
    assert sorted(seconds) == seconds
    assert 1 < seconds[0] < seconds[-1] < 3600


def test_keep_needs_a_size():
    with pytest.raises(InvalidArgumentError, match=r"--keep needs --rho, --count or --max-count\."):
        check_goals(options("--target-psnr", "30", "--keep", "box.json"))


@pytest.mark.long
def test_several_scenes_measure_the_machine_once(source, tmp_path, measured):
    shutil.copy(source, tmp_path / "other.ply")
    words = ["--rho", "0.1", "--time-budget", "50s", "--recalibrate", "--quiet"]
    assert (
        main(
            [
                "simplify",
                str(source),
                str(tmp_path / "other.ply"),
                "-o",
                str(tmp_path / "out"),
                *words,
            ]
        )
        == 0
    )
    assert measured == [True, False]


@pytest.mark.long
def test_the_machine_is_measured_though_the_first_scene_fails(
    source, tmp_path, measured, monkeypatch
):
    monkeypatch.setattr("cvtgs.budget.calibrate.is_calibrated", lambda device: True)
    words = ["-o", str(tmp_path / "out"), "--rho", "0.1", "--time-budget", "50s", "--recalibrate"]
    assert main(["simplify", str(tmp_path / "none.ply"), str(source), *words, "--quiet"]) == 1
    assert measured == [True]


@pytest.mark.usefixtures("measured")
def test_a_preset_fits_into_what_start_and_reading_left(scene: cvtgs.GaussianScene) -> None:
    """Of 8 s, 6 s are over; the preset that takes 4 s would fit into 8 s."""
    known = options("--rho", "0.1", "--time-budget", "8s")
    known.begun = time.perf_counter() - 6.0
    assert choose_preset(known, scene, {}, silent).name != "high"


@pytest.mark.parametrize(("name", "is_read_back"), [("a.ply", False), ("a.splat", True)])
def test_a_target_is_measured_on_the_file_over_the_heldout_views(
    scene: cvtgs.GaussianScene, monkeypatch: pytest.MonkeyPatch, *, name: str, is_read_back: bool
) -> None:
    given: dict[str, Any] = {}

    def find_count(_: cvtgs.GaussianScene, **options: Any) -> Found:
        given.update(options)
        return Found(scene, cast("Any", None), 30.0, 0.9, 0.1, -0.1, tried=())

    monkeypatch.setattr("cvtgs.budget.find_count", find_count)
    known, views = options("--target-psnr", "20"), SearchViews("fitted", "scored", "ten of them")
    known.output = Path(name)
    simplifier = cvtgs.Simplifier(preset="matched", device="cpu")
    _, note = search_target(known, scene, simplifier, views=views, axes=None, listener=silent)
    assert (given["cameras"], given["heldout"]) == ("fitted", "scored")
    assert " over ten of them; found" in note
    assert (given["written"](scene) is not scene) == is_read_back


@pytest.mark.long
@pytest.mark.parametrize("words", [["--sh-degree", "0"], ["--effects", "sh=0"]])
def test_bands_that_are_dropped_count_in_the_quality_to_reach(tmp_path, capsys, words):
    full, small = tmp_path / "in.ply", tmp_path / "out.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 600, sh_degree=2, seed=1), full)
    simplify = ["simplify", str(full), str(small), "--preset", "fast", *words]
    assert main([*simplify, "--target-psnr", "60"]) == 1
    assert "no simplified scene reaches 60.00 dB" in capsys.readouterr().err
    assert main([*simplify, "--target-psnr", "20"]) == 0
    printed = capsys.readouterr().out
    found = cvtgs.load(small)
    assert not found.shN.any()
    assert found.sh_degree == (0 if "--sh-degree" in words else 2)  # effects keep the columns
    assert main(["evaluate", str(full), str(small), "--lpips", "off"]) == 0
    psnr = re.findall(r"PSNR (\d+\.\d+) dB", printed)[0]
    assert psnr in capsys.readouterr().out
    assert float(psnr) >= 20
