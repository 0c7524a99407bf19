"""Parts of a tradeoff: the front, processes, tables, and files, on made-up results."""

import csv
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from importlib import import_module

import pytest
import torch

import cvtgs
from browser_cases import attribute, dom, in_frame, layout_on_a_phone, needs_browser
from cvtgs.errors import ConfigError, InvalidArgumentError, RunError
from cvtgs.evaluation import Evaluation, EvaluationSettings, SceneScores, Score, compare
from cvtgs.tradeoff import (
    Failure,
    Measured,
    Tradeoff,
    TradeoffResult,
    measure_tradeoff,
    write_tradeoff,
)
from cvtgs.tradeoff.files import (
    cells,
    heading,
    how_measured,
    page_summary,
    ticks,
    tradeoff_chart,
)
from cvtgs.tradeoff.measure import Run, tasks_of
from cvtgs.tradeoff.process_cost import WARNING, ProcessCost, pass_warnings_on, run_process
from cvtgs.tradeoff.results import on_front, with_fronts
from cvtgs.views import automatic_views
from tradeoff_cases import result


def scores(name: str) -> SceneScores:
    one = Score.of([30.0])
    return SceneScores(name=name, count=50, psnr=one, ssim=one)


def tradeoff(*results: TradeoffResult, failures: tuple[Failure, ...] = ()) -> Tradeoff:
    return Tradeoff(
        source="a<b>.ply",
        source_count=500,
        source_bytes=42_000,
        start_seconds=1.0,
        machine="abacus",
        evaluation=Evaluation(
            reference="a<b>.ply",
            reference_count=500,
            views=("view 1",),
            width=64,
            height=48,
            backend="torch",
            lpips_note="not asked for",
            scenes=tuple(scores(one.name) for one in results),
        ),
        results=tuple(with_fronts(results)),
        failures=failures,
    )


MADE = (
    result("draft", 2.0, 20.0, stages={"merge": 0.5}),
    result("fast", 3.0, 19.0, stages={"merge": 0.5}),
    result("high", 9.0, 25.0, stages={"visibility": 5.0, "merge": 0.5}),
    result("draft", 1.9, 15.0, 0.01),
)


def test_the_pareto_front_equals_that_by_hand():
    assert on_front([1, 2, 3, 3], [5, 4, 6, 7]) == (True, False, False, True)
    assert on_front([1, 1], [2, 2]) == (True, True)
    assert on_front([1, 2], [float("nan"), 1.0]) == (False, True)
    assert on_front([], []) == ()


def test_each_ratio_has_its_own_front():
    assert [one.fronts for one in with_fronts(MADE)] == [
        ("psnr", "ssim"),
        (),
        ("psnr", "ssim"),
        ("psnr", "ssim"),
    ]


def test_a_lower_lpips_is_better():
    both = [result("a", 1.0, 20.0, lpips=0.3), result("b", 2.0, 20.0, lpips=0.1)]
    assert [one.fronts for one in with_fronts(both)] == [("psnr", "ssim", "lpips"), ("lpips",)]


def test_stages_of_all_runs_are_in_one_order():
    made = tradeoff(*MADE)
    assert made.stages == ("check", "visibility", "merge")
    assert made.rest_seconds(made.results[0]) == pytest.approx(2.0 - 1.0 - 0.25 - 0.5)
    assert made.rest_seconds(result("slow start", 0.5, 20.0)) == 0.0


def test_csv_has_a_line_per_run_and_seconds_per_stage():
    rows = list(csv.DictReader(io.StringIO(tradeoff(*MADE).to_csv())))
    assert [row["preset"] for row in rows] == ["draft", "fast", "high", "draft"]
    assert rows[2]["visibility_seconds"] == "5.0"
    assert rows[0]["visibility_seconds"] == ""
    assert rows[0]["fronts"] == "psnr ssim"
    with_alpha = tradeoff(result("draft", 2.0, 20.0, alpha_error=0.5, alpha_bias=-0.25)).to_csv()
    (row,) = csv.DictReader(io.StringIO(with_alpha))
    assert (row["alpha_error"], row["alpha_bias"]) == ("0.5", "-0.25")
    assert float(rows[3]["rho"]) == 0.01


def test_json_reads_back():
    made = tradeoff(*MADE, result("same", 3.0, float("inf"), 1.0))
    assert Tradeoff.model_validate_json(made.to_json()) == made
    stages = json.loads(made.to_json())["results"][0]["report"]["stages"]
    assert all(stage["peak_memory_bytes"] > 0 for stage in stages)


def test_the_texts_of_the_table():
    made = tradeoff(*MADE)
    texts = {
        "preset": "draft",
        "all, s": "2.00",
        "PSNR, dB": "20.00*",
        "SSIM": "0.2000*",
        "alpha error": "",
        "alpha bias": "",
        "file": "4.2 kB",
        "memory": "300.0 MB",
        "start, s": "1.00",
        "check, s": "0.25",
        "visibility, s": "",
        "merge, s": "0.50",
        "read, write, s": "0.25",
    }
    assert list(cells(made, made.results[0]).items()) == list(texts.items())
    covered = result("draft", 2.0, 20.0, alpha_error=0.0123, alpha_bias=-0.01)
    assert cells(made, covered)["alpha error"] == "0.0123"
    assert cells(made, covered)["alpha bias"] == "-0.0100"
    assert heading(made, 0.01) == "rho 0.01: 50 of 500 Gaussians"
    assert "1 view of 64 x 48 pixels" in how_measured(made)
    assert how_measured(made).endswith(" on abacus.")
    network = made.evaluation.model_copy(update={"lpips_network": "vgg", "lpips_note": ""})
    named = made.model_copy(update={"evaluation": network})
    assert how_measured(named).endswith(" on abacus. LPIPS with the network vgg.")


def test_repeated_warnings_of_processes_are_issued_once():
    errors = f"{WARNING}dropped 3 rows.\nsome noise\n{WARNING}dropped 3 rows.\n"
    with pytest.warns(UserWarning, match=r"^dropped 3 rows\.$") as caught:
        pass_warnings_on(errors, set())
    assert len(caught) == 1


def test_the_page_escapes_texts_and_names_failures():
    made = tradeoff(
        *MADE, failures=(Failure(name="max 0.1", preset="max", rho=0.1, reason="a < b."),)
    )
    html = page_summary(made, None)
    assert "<img" not in html
    assert "max 0.1 failed: a &lt; b." in html
    assert html.count('class="best"') == 6
    assert "hollow" not in html
    html = page_summary(made, b"png")
    assert 'src="data:image/png;base64,' in html
    assert "(other points of the chart are hollow)." in html


def test_ticks_are_round_numbers():
    assert ticks(0.9, 1.1) == [0.7, 1.0, 2.0]
    assert ticks(2.0, 20.0) == [2.0, 3.0, 5.0, 7.0, 10.0, 20.0]
    assert ticks(0.06, 150.0)[:5] == [0.05, 0.1, 0.2, 0.5, 1.0]
    assert ticks(0.06, 900.0) == [0.01, 0.1, 1.0, 10.0, 100.0, 1000.0]


@pytest.mark.slow
def test_the_chart_is_a_png():
    pytest.importorskip("matplotlib")
    assert tradeoff_chart(tradeoff(*MADE))[1:4] == b"PNG"


@pytest.fixture
def measured() -> Measured:
    scene = cvtgs.synthetic.scene("object", 500, sh_degree=0, seed=0)
    small = {one.name: scene.select(torch.arange(50)) for one in MADE}
    comparison = compare(
        scene,
        small,
        automatic_views(scene, 2, width=32, height=24),
        settings=EvaluationSettings(lpips="off"),
    )
    return Measured(tradeoff(*MADE), comparison)


@pytest.mark.slow
def test_files_are_written_completely_and_replaced_only_when_asked(measured, tmp_path):
    pytest.importorskip("matplotlib")
    paths, note = write_tradeoff(measured, tmp_path / "new")
    names = ["tradeoff.csv", "tradeoff.json", "tradeoff.png", "index.html"]
    assert [path.name for path in paths] == names
    assert note == ""
    page = paths[-1].read_text(encoding="utf-8")
    assert 'id="tradeoff"' in page
    assert ": comparison of presets</title>" in page
    assert '"named":true' in page, "cards are headed by presets, which share their ratios"
    assert "sheet.png" not in page
    with pytest.raises(cvtgs.errors.OutputExistsError):
        write_tradeoff(measured, tmp_path / "new")
    write_tradeoff(measured, tmp_path / "new", overwrite=True)


@pytest.mark.slow
def test_without_matplotlib_only_the_plot_is_missing(measured, tmp_path, monkeypatch):
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / "tradeoff.png").write_bytes(b"of an earlier run")
    paths, note = write_tradeoff(measured, tmp_path, overwrite=True)
    assert [path.name for path in paths] == ["tradeoff.csv", "tradeoff.json", "index.html"]
    assert not (tmp_path / "tradeoff.png").exists()
    assert 'pip install "cvtgs[plots]"' in note


def test_time_and_memory_of_a_process_are_measured():
    cost = run_process([sys.executable, "-c", "print('done'); x = bytearray(80_000_000)"])
    assert cost.output == "done\n"
    assert cost.wall_seconds > 0
    if cost.peak_memory_bytes:
        assert 80_000_000 < cost.peak_memory_bytes < 200_000_000


@pytest.mark.parametrize(
    ("code", "text"),
    [
        ("import sys; sys.exit('cvtgs: error: no such scene.')", "no such scene."),
        ("import sys; sys.exit(3)", "it ended with exit code 3."),
        pytest.param(
            "import os; os.kill(os.getpid(), 9)",
            "it was ended by signal 9; 9 often means that",
            marks=pytest.mark.skipif(sys.platform == "win32", reason="signals are those of POSIX"),
        ),
    ],
)
def test_a_failed_process_is_explained_in_one_sentence(code, text):
    with pytest.raises(RunError) as caught:
        run_process([sys.executable, "-c", code])
    assert str(caught.value).startswith(text)


def test_a_missing_program_is_an_error():
    with pytest.raises(RunError, match="no-such-program could not be started"):
        run_process(["no-such-program"])


def test_presets_and_ratios_are_checked():
    names = [task.name for task in tasks_of(None, torch.tensor([0.1234567]))]
    assert names == [f"{preset} 0.1234567" for preset in cvtgs.PRESETS]
    with pytest.raises(ConfigError, match="found 'best'"):
        tasks_of(["best"], [0.1])
    with pytest.raises(InvalidArgumentError, match=r"rho must be above 0 and at most 1; found 2\."):
        tasks_of(None, [2.0])
    with pytest.raises(InvalidArgumentError, match=r"given once, found standard 0\.1 twice"):
        tasks_of(["standard"], [0.1, 0.10])
    with pytest.raises(InvalidArgumentError, match=r"given once, found draft 0\.3 twice"):
        tasks_of(["draft"], [0.3, 0.1 + 0.2])  # their files would have one name
    with pytest.raises(InvalidArgumentError, match="at least one preset and one ratio"):
        tasks_of([], [0.1])


def test_the_size_of_a_folder_is_that_of_its_scene(tmp_path, monkeypatch):
    def run(source, task, folder, **options):
        path = folder / task.file_name
        cvtgs.save(cvtgs.load(source), path)
        cost = ProcessCost(
            wall_seconds=1.0, user_seconds=1.0, peak_memory_bytes=0, output="", errors=""
        )
        return Run(task=task, path=path, cost=cost, report=MADE[0].report)

    module = import_module("cvtgs.tradeoff.measure")
    monkeypatch.setattr(module, "run_task", run)
    monkeypatch.setattr(module, "start_seconds", lambda: 0.0)
    file = tmp_path / "point_cloud.ply"
    cvtgs.save(cvtgs.synthetic.scene("object", 200, sh_degree=0, seed=0), file)
    found = measure_tradeoff(
        tmp_path,
        presets=["draft"],
        rhos=[0.1],
        cameras=lambda scene: automatic_views(scene, 1, width=32, height=24),
        settings=EvaluationSettings(lpips="off"),
    )
    assert found.tradeoff.source_bytes == file.stat().st_size


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="signals are those of POSIX")
@pytest.mark.parametrize("number", ["SIGINT", "SIGKILL"])
def test_the_child_process_ends_with_its_parent(tmp_path, number):
    note = tmp_path / "pid"
    inner = f"import os, pathlib, time; pathlib.Path({str(note)!r}).write_text(str(os.getpid()))"
    outer = "import signal, sys; from cvtgs.tradeoff.measure import run_process;"
    outer += (
        "signal.signal(signal.SIGINT, signal.default_int_handler);"  # ignored in the background
    )
    outer += "run_process("
    outer += f"[sys.executable, '-c', {inner + '; time.sleep(120)'!r}])"
    with subprocess.Popen([sys.executable, "-c", outer], stderr=subprocess.PIPE) as process:
        pid = wait_for(lambda: note.exists() and note.read_text())
        process.send_signal(getattr(signal, number))
        process.communicate(timeout=60)
    assert process.returncode != 0
    assert wait_for(lambda: not is_alive(int(pid)))


def wait_for(found):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        if value := found():
            return value
        time.sleep(0.05)
    raise TimeoutError


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    pytest.importorskip("matplotlib")
    folder = tmp_path_factory.mktemp("tradeoff")
    cvtgs.save(cvtgs.synthetic.scene("object", 500, sh_degree=0, seed=0), folder / "full.ply")
    measured = measure_tradeoff(
        folder / "full.ply",
        presets=["draft", "fast"],
        rhos=[0.1],
        cameras=lambda scene: automatic_views(scene, 2, width=64, height=48),
        settings=EvaluationSettings(lpips="off"),
    )
    return write_tradeoff(measured, folder).paths[-1]


@needs_browser
@pytest.mark.long
def test_the_page_has_plot_table_and_slider(page):
    html = dom(page)
    assert attribute(html, "ready") == "yes"
    table = re.search(r'<table id="tradeoff">.*?</table>', html, re.DOTALL).group(0)
    assert "rho 0.1: 50 of 500 Gaussians" in table
    assert '<th scope="row">draft</th>' in table
    assert 'class="chart" src="data:image/png;base64,' in html
    assert "50 Gaussians" in html
    assert "<b>draft 0.1</b>" in html
    assert "<b>fast 0.1</b>" in html


@needs_browser
@pytest.mark.long
def test_the_page_fits_a_phone(page):
    """The wide table scrolls in its own container."""
    assert layout_on_a_phone(page) == "390/390 390"


@needs_browser
@pytest.mark.long
def test_a_large_screen_shows_all_columns(measured, tmp_path):
    names = ("plan", "visibility", "weigh", "tessellate", "allocate", "merge", "network", "refine")
    runs = (result("high", 9.0, 31.0, stages=dict.fromkeys(names, 12.5)), MADE[0])
    scored = measured.tradeoff.model_copy(update={"results": runs})
    path = write_tradeoff(measured._replace(tradeoff=scored), tmp_path).paths[-1]
    table = "page.querySelector('#tradeoff').parentElement"
    assert in_frame(path, f"{table}.scrollWidth - {table}.clientWidth", width=1600) == "0"
    assert in_frame(path, f"{table}.clientWidth > 1016", width=1600) == "true"
    assert in_frame(path, "page.scrollWidth", width=1600) == "1600"
    assert in_frame(path, f"{table}.clientWidth", width=1080) == "1016"


@pytest.mark.long
def test_the_page_loads_nothing_from_the_network(page):
    assert not re.search(r"https?://", page.read_text(encoding="utf-8"))
