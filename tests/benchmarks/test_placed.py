"""Captured objects on captured ground, under a generated sky."""

import math

import numpy as np
import pytest
import torch

import cvtgs
from benchmarks import placed, yards
from cvtgs.math.parameters import rotation_matrices
from cvtgs.synthetic import scene as make


@pytest.mark.parametrize(
    "direction", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.0, -0.8)]
)
def test_the_shortest_rotation_maps_one_vector_to_the_other(direction):
    start = torch.tensor(direction, dtype=torch.float64)
    end = torch.tensor(placed.UP, dtype=torch.float64)
    quat = torch.tensor([placed.turn_between(start, end)], dtype=torch.float64)
    assert torch.linalg.vector_norm(quat) == pytest.approx(1.0)
    torch.testing.assert_close(rotation_matrices(quat)[0] @ start, end, atol=1e-9, rtol=0)


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
    assert math.isclose(float(center.means.norm(dim=1).median()), 0.5, abs_tol=0.4)
