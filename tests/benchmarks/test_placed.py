"""Captured objects on captured ground, under a generated sky."""

import numpy as np
import pytest
import torch

import cvtgs
from benchmarks import placed, yards
from cvtgs import edit
from cvtgs.synthetic import scene as make
from cvtgs.views.layout import find_layout


@pytest.mark.slow
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (90.0, 0.0, 0.0), (180.0, 0.0, 0.0)])
def test_scenes_are_turned_upright(angles):
    """Whichever way up a scene is, its up points to -y afterwards."""
    scene = edit.move(make("courtyard", 4000, sh_degree=0, seed=2), edit.Motion.of_angles(angles))
    turned = placed.upright(scene, radius=2.0, level=0.5)
    up = find_layout(turned).up.double()
    torch.testing.assert_close(up, torch.tensor(placed.UP).double(), atol=1e-2, rtol=0)


def test_far_surroundings_leave_room_in_the_middle():
    far = yards.far_surroundings(20_000, from_radius=1.4, seed=1)
    away = torch.linalg.vector_norm(far.means[:, [0, 2]], dim=1)
    on_the_ground = far.means[:, 1].abs() < 0.2
    assert int(on_the_ground.sum()) > 3000
    is_near = on_the_ground & (away < 1.3)  # a few floaters, no ground
    assert int(is_near.sum()) < 50
    assert float(torch.linalg.vector_norm(far.means, dim=1).max()) > 100


def test_an_object_stands_on_the_ground(tmp_path):
    """Files and cameras are written, and the object is centred above the ground."""
    ground, thing = (
        make("courtyard", 4000, sh_degree=0, seed=2),
        make("object", 3000, sh_degree=1, seed=3),
    )
    paths = [tmp_path / "ground.ply", tmp_path / "thing.ply"]
    for scene, path in zip((ground, thing), paths, strict=True):
        cvtgs.save(scene, path)
    placed.main([*map(str, paths), "-o", str(tmp_path)])
    scene = cvtgs.load(tmp_path / "placed-thing.ply")
    assert (tmp_path / "placed-thing.cameras.json").is_file()
    assert scene.sh_degree == 1
    center = scene.select(torch.arange(3000))
    heights = -center.means[:, 1].double().numpy()  # y points down
    assert np.quantile(heights, 0.02) == pytest.approx(0.0, abs=0.02)
    assert torch.median(center.means[:, [0, 2]], dim=0).values.abs().max() < 0.01
    assert cvtgs.analysis.analyze(scene, cvtgs.SimplifyConfig()).plan.unbounded.active
    assert float(find_layout(center).frame.radius) == pytest.approx(0.5, rel=1e-3)
