"""Warnings about given cameras, each of which a run gives once."""

import math
import warnings
from dataclasses import replace

import pytest

import cvtgs
from cvtgs import Cameras, GaussianScene, Simplifier, SimplifyConfig
from cvtgs.outofcore import simplify_file
from cvtgs.synthetic import scene as generated
from refine_cases import ring

SETTINGS = {
    "preset": "matched",
    "visibility": {"views": 6, "size": 48, "stride": 1},
    "refine": {"steps": 4, "size": 48, "images": 6, "check_every": 4},
}
FAR = "spans less than 1% of most images"
NEAR = "draw nothing nearer than"
BLIND = "cameras see nothing of"
SHRUNK = 0.0025  # the near plane hides a part of the scene


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    return generated("object", 2000, sh_degree=0, seed=4)


def views(case: str) -> Cameras:
    """Return cameras that are far away, nearer than the near plane, or mostly look away."""
    cameras = ring(10)
    viewmats = cameras.viewmats.clone()
    if case == BLIND:
        viewmats[:6, 0, 3] += 1e4
    else:
        viewmats[:, :3, 3] *= 1000.0 if case == FAR else SHRUNK
    return replace(cameras, viewmats=viewmats)


@pytest.mark.long
@pytest.mark.parametrize("blocks", [1, 3])
@pytest.mark.parametrize("case", [FAR, NEAR, BLIND])
def test_refinement_does_not_repeat_what_the_run_has_warned_of(scene, tmp_path, case, blocks):
    cameras = views(case)
    if case == NEAR:
        scene = scene.with_tensors(
            {"means": scene.means * SHRUNK, "log_scales": scene.log_scales + math.log(SHRUNK)}, {}
        )
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(SETTINGS), device="cpu")
    cvtgs.save(scene, tmp_path / "in.ply")
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        if blocks == 1:
            simplifier.simplify(scene, count=200, cameras=cameras)
        else:
            paths = tmp_path / "in.ply", tmp_path / "out.ply"
            simplify_file(*paths, count=200, blocks=blocks, simplifier=simplifier, cameras=cameras)
    texts = [str(one.message) for one in found]
    assert [text for text in texts if case in text] == texts
    assert len(texts) == 1


@pytest.mark.slow
def test_a_refinement_alone_warns_of_generated_views(scene):
    """No stage before it looks at images."""
    tiny = scene.with_tensors(
        {"means": scene.means * SHRUNK, "log_scales": scene.log_scales + math.log(SHRUNK)}, {}
    )
    settings = {"preset": "standard", "refine": SETTINGS["refine"]}
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(settings), device="cpu")
    with pytest.warns(UserWarning, match=NEAR):
        simplifier.simplify(tiny, count=200)
