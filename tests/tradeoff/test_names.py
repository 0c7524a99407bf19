"""Scenes and folders with unusual names, and results with the name of the scene."""

import json
import sys
from pathlib import Path

import pytest

import cvtgs
from cvtgs import GaussianScene
from cvtgs.errors import InvalidArgumentError
from cvtgs.tradeoff import measure_tradeoff
from cvtgs.tradeoff.measure import Task, check_results, run_task
from cvtgs.views import automatic_views

TASK = Task(preset="draft", rho=0.1)


@pytest.fixture
def scene():
    return cvtgs.synthetic.scene("object", 300, sh_degree=0)


def look(scene):
    return automatic_views(scene, 1, width=24, height=16)


def test_a_result_does_not_replace_the_scene_that_later_presets_read(tmp_path, scene):
    file = tmp_path / TASK.file_name
    cvtgs.save(scene, file)
    before = file.read_bytes()
    with pytest.raises(InvalidArgumentError, match=r"draft_0\.1\.ply: a result must not replace"):
        measure_tradeoff(file, presets=["fast", "draft"], rhos=[0.1], cameras=look, folder=tmp_path)
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]


def test_a_scene_is_not_replaced_through_a_link_to_its_folder(
    tmp_path: Path, scene: GaussianScene
) -> None:
    (tmp_path / "scenes").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "scenes")
    file = tmp_path / "scenes" / TASK.file_name
    cvtgs.save(scene, file)
    with pytest.raises(InvalidArgumentError, match=r"draft_0\.1\.ply: a result must not replace"):
        check_results(file, tmp_path / "link", [TASK])
    check_results(file, tmp_path, [TASK])


def test_arguments_of_another_kind_are_named(tmp_path: Path, scene: GaussianScene) -> None:
    cvtgs.save(scene, tmp_path / "in.ply")
    for changes, text in (
        ({"cameras": look(scene)}, "cameras must be a function that returns the views"),
        ({"listener": None}, "listener must be"),
        ({"presets": "draft"}, "presets must be a list of names, found 'draft'"),
        ({"presets": 3}, "presets must be a list of names, found 3"),
    ):
        with pytest.raises(InvalidArgumentError, match=text):
            measure_tradeoff(tmp_path / "in.ply", **({"presets": ["draft"]} | changes))


@pytest.mark.long
def test_names_may_begin_with_a_dash(tmp_path, scene, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cvtgs.save(scene, "-in.ply")
    Path("-out").mkdir()
    run = run_task("-in.ply", TASK, Path("-out"))
    assert (run.path, run.report.output_count) == (Path("-out/draft_0.1.ply"), 30)


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_a_name_that_is_not_utf8_is_escaped(tmp_path, scene):
    file = tmp_path / "in\udcff.ply"
    cvtgs.save(scene, file)
    found = measure_tradeoff(file, presets=["draft"], rhos=[0.1], cameras=look).tradeoff
    assert found.source == found.evaluation.reference == "in\\udcff.ply"
    assert json.loads(found.to_json())["source"] == found.source
