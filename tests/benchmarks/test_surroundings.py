"""Objects in generated rooms and under generated skies."""

import pytest
import torch

import cvtgs
from benchmarks import surroundings
from benchmarks.cameras import cameras_beside
from cvtgs.rendering import render
from cvtgs.synthetic import scene as make


def test_files_and_cameras_are_written(tmp_path):
    cvtgs.save(make("object", 500, sh_degree=1, seed=3), tmp_path / "thing.ply")
    words = ["--object", str(tmp_path / "thing.ply"), "--kind", "faces6", "street"]
    surroundings.main([str(tmp_path / "new"), *words])
    for kind in ("faces6", "street"):
        path = tmp_path / "new" / f"{kind}-thing.ply"
        assert cvtgs.load(path).sh_degree == 1
        wanted = surroundings.cameras(kind).viewmats
        torch.testing.assert_close(cameras_beside(path).viewmats, wanted)


@pytest.mark.parametrize("kind", ["faces6", "faces600", "room280", "room9000"])
def test_rooms_are_closed(kind):
    """Every camera sees walls wherever it looks, or a sky through their windows."""
    scene = surroundings.scene_of(kind, make("object", 3000, sh_degree=0, seed=3))
    images = render(scene, surroundings.cameras(kind).fitted(64))
    assert float(images.alpha.amin()) > 0.3  # between Gaussians of the sky
    assert float(images.alpha.mean()) > 0.95


def test_the_object_stands_on_the_floor():
    thing = make("object", 3000, sh_degree=0, seed=3)
    scene = surroundings.scene_of("sky200", thing)
    assert len(scene) == 3000 + 8000 + 200
    center = scene.select(torch.arange(3000))
    lowest = float(center.means[:, 1].double().quantile(0.98))  # y points down
    assert lowest == pytest.approx(surroundings.FLOOR, abs=0.02)
