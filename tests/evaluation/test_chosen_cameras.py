"""Cameras of an evaluation to which none are given."""

import json

import pytest
import torch

import cvtgs
from camera_files import inria, write_json
from cvtgs.cli.main import main
from cvtgs.errors import InvalidArgumentError
from cvtgs.evaluation import EvaluationSettings, compare, evaluate
from cvtgs.views import automatic_views, find_own_cameras

OFF = EvaluationSettings(lpips="off")


@pytest.fixture(scope="module")
def scene():
    return cvtgs.synthetic.scene("object", 2000, sh_degree=0, seed=0)


@pytest.fixture(scope="module")
def small(scene):
    return {"small": cvtgs.simplify(scene, 0.05, preset="fast")}


@pytest.mark.long
@pytest.mark.parametrize("score", [evaluate, compare])
def test_a_scene_in_memory_is_scored_from_automatic_views(scene, small, score):
    found, wanted = (
        score(scene, small, settings=OFF),
        score(scene, small, automatic_views(scene), settings=OFF),
    )
    if score is compare:
        found, wanted = found.evaluation, wanted.evaluation
    assert found == wanted
    assert len(found.views) == 8


@pytest.mark.long
def test_a_file_is_scored_as_the_command_does(scene, small, tmp_path, capsys):
    full, other = tmp_path / "full.ply", tmp_path / "small.ply"
    cvtgs.save(scene, full)
    cvtgs.save(small["small"], other)
    write_json(tmp_path / "cameras.json", inria())
    found = evaluate(full, {"small.ply": other}, reference_name="full.ply", settings=OFF)
    main(["evaluate", str(full), str(other), "--lpips", "off", "--json"])
    assert json.loads(found.to_json()) == json.loads(capsys.readouterr().out)
    own = find_own_cameras(scene, full)
    assert own is not None
    assert found.views == own.cameras.spread(8).view_names
    assert (found.width, found.height) == (640, 480)


def test_photographs_need_their_cameras(scene, small):
    with pytest.raises(InvalidArgumentError, match="photographs need the cameras that took them"):
        evaluate(scene, small, photographs=torch.zeros(8, 480, 640, 3), settings=OFF)


@pytest.mark.long
def test_gaussians_that_are_not_drawn_are_told(scene, small):
    means = scene.means.clone()
    means[:3] = torch.nan
    broken = scene.with_tensors(means=means)
    with pytest.warns(UserWarning, match="^full has 3 Gaussians with NaN, infinite or zero values"):
        found = evaluate(broken, small, settings=OFF)
    assert found.reference_count == 2000
