"""Scenes of 2DGS: Gaussians without a third scale, in and out."""

from importlib import import_module

import cvtgs
from cvtgs import GaussianScene, Simplifier, SimplifyConfig
from cvtgs.scene import FLAT_LOG_SCALE
from scenes import random_scene


def simplified(scene: GaussianScene, flat: str) -> cvtgs.Simplified:
    config = SimplifyConfig.from_mapping({"effects": {"flat": flat}})
    return Simplifier(config=config, device="cpu").run(scene, 0.1)


def surfels(count: int) -> GaussianScene:
    """A scene as it is read from a file without ``scale_2``."""
    scene = random_scene(count)
    log_scales = scene.log_scales.clone()
    log_scales[:, 2] = FLAT_LOG_SCALE
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9))]
    names += ["opacity", "scale_0", "scale_1", *(f"rot_{i}" for i in range(4))]
    layout = tuple((name, "float") for name in names)
    return GaussianScene(**{**scene.tensors(), "log_scales": log_scales}, layout=layout)


def test_surfels_stay_surfels():
    flat, thick = (simplified(surfels(400), flat) for flat in ("auto", "off"))
    assert flat.report.plan.flat.active
    assert bool((flat.scene.log_scales[:, 2] == FLAT_LOG_SCALE).all())
    assert float(thick.scene.log_scales[:, 2].median()) > FLAT_LOG_SCALE / 2
    assert flat.scene.log_scales[:, :2].equal(thick.scene.log_scales[:, :2])


def test_surfels_are_written_without_a_third_scale(tmp_path):
    """Warnings are errors here: nothing was left out."""
    scene = surfels(400)
    cvtgs.save(simplified(scene, "auto").scene, tmp_path / "small.ply")
    again = cvtgs.load(tmp_path / "small.ply")
    assert again.layout == scene.layout
    assert bool((again.log_scales[:, 2] == FLAT_LOG_SCALE).all())


def test_flat_gaussians_of_a_file_with_three_scales_may_become_thick():
    """That is closer to what they were."""
    scene = GaussianScene(**surfels(400).tensors())
    small, report = simplified(scene, "auto")
    assert not report.plan.flat.active
    assert float(small.log_scales[:, 2].median()) > FLAT_LOG_SCALE / 2


def test_thick_gaussians_stay_thick(monkeypatch):
    monkeypatch.setattr(import_module("cvtgs.analysis.analyze"), "FLAT_LOG_SCALE", None)
    simplified(random_scene(400), "auto")
