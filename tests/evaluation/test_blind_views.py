"""Views that show nothing of a scene, in which every result looks perfect."""

import math
import warnings

import pytest
import torch

from cvtgs import Cameras, GaussianScene, Simplifier, SimplifyConfig, evaluate, refine
from cvtgs.budget import find_count
from cvtgs.config import MatchConfig, RefineConfig
from cvtgs.errors import InvalidArgumentError, InvalidSceneError
from cvtgs.evaluation import EvaluationSettings, compare
from cvtgs.matching import match_views
from cvtgs.rendering import observe
from cvtgs.synthetic import scene as make
from cvtgs.views import automatic_views

SETTINGS = EvaluationSettings(lpips="off")
TURNED = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    return make("object", 2000, sh_degree=0, seed=2)


@pytest.fixture(scope="module")
def small(scene: GaussianScene) -> GaussianScene:
    return Simplifier(preset="fast", device="cpu").simplify(scene, 0.05)


def views_of(scene: GaussianScene, blind: int) -> tuple[Cameras, Cameras]:
    """Return four views, and the same with as many others that look away before them."""
    good = automatic_views(scene, 4, width=48, height=36, seed=5).to("cpu")
    away = TURNED.to(good.viewmats) @ good.viewmats[:blind]
    return good, Cameras(
        viewmats=torch.cat([away, good.viewmats]),
        Ks=torch.cat([good.Ks[:blind], good.Ks]),
        width=48,
        height=36,
    )


@pytest.mark.slow
@pytest.mark.parametrize("blind", [0, 1, 3])
def test_blind_views_do_not_count_in_means(scene, small, blind):
    good, both = views_of(scene, blind)
    (alone,) = evaluate(scene, {"small": small}, good, settings=SETTINGS).scenes
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        evaluation = evaluate(scene, {"small": small}, both, settings=SETTINGS)
    assert evaluation.blind == tuple(range(blind))
    (found,) = evaluation.scenes
    texts = [str(one.message) for one in caught]
    assert texts == ([f"{blind} of {4 + blind} views show nothing of full, so they do not count in "
                      f"mean scores."] if blind else [])  # fmt: skip
    assert found.means() == alone.means()
    assert found.psnr.views == (*[math.inf] * blind, *alone.psnr.views)
    assert found.ssim.views == (*[1.0] * blind, *alone.ssim.views)


def test_a_view_of_something_tiny_counts():
    """One Gaussian of a few pixels in a large image."""
    one = make("object", 1, sh_degree=0)
    tensors = {
        "means": torch.tensor([[0.0, 0.0, 5.0]]),
        "log_scales": torch.full((1, 3), -6.0),
        "logit_opacities": torch.tensor([4.0]),
    }
    tiny = one.with_tensors(tensors)
    intrinsics = torch.tensor([[[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]])
    camera = Cameras(viewmats=torch.eye(4)[None], Ks=intrinsics, width=320, height=240)
    darker = tiny.with_tensors({"sh0": tiny.sh0 - 0.5})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (found,) = evaluate(tiny, {"darker": darker}, camera, settings=SETTINGS).scenes
    assert math.isfinite(found.psnr.mean)


@pytest.mark.slow
def test_a_search_does_not_measure_blind_views(scene):
    good, both = views_of(scene, 3)
    simplifier = Simplifier(preset="fast", device="cpu")
    with pytest.warns(UserWarning, match="^3 of 7 views show nothing of the scene, so quality is"):
        found = find_count(scene, psnr=24.0, simplifier=simplifier, heldout=both)
    alone = find_count(scene, psnr=24.0, simplifier=simplifier, heldout=good)
    assert (found.psnr, len(found.scene)) == (alone.psnr, len(alone.scene))


@pytest.mark.parametrize("score", [evaluate, compare])
def test_a_scene_without_gaussians_is_refused(scene, score):
    good, _ = views_of(scene, 0)
    with pytest.raises(InvalidSceneError, match="full must have at least one Gaussian, found no"):
        score(scene[:0], {"small": scene}, good)


@pytest.mark.parametrize("first", [0, 1])
def test_a_refinement_needs_two_cameras_that_see_the_scene(scene, small, first):
    """The held-out one of two would be perfect from the start, or the other teach nothing."""
    good, both = views_of(scene, 1)
    rows = [[0, 1], [1, 0]][first]
    text = "at least 2 cameras that see {}, one of them to be held out; found 1 of 2"
    with pytest.raises(InvalidArgumentError, match=text.format("the full scene")):
        refine(small, scene, cameras=both[rows], config=RefineConfig(steps=1))
    config = SimplifyConfig(refine=RefineConfig(steps=1))
    with pytest.raises(InvalidArgumentError, match=text.format("the scene")):
        Simplifier(config=config, device="cpu").run(scene, 0.1, cameras=both[rows])
    report = refine(small, scene, cameras=good[:2], config=RefineConfig(steps=1)).report
    assert report.stopped != "perfect"


@pytest.mark.parametrize("seeing", [1, 2])
def test_images_of_nothing_do_not_decide_in_matching(scene, small, seeing):
    good, _ = views_of(scene, 0)
    away = TURNED.to(good.viewmats) @ good.viewmats.repeat(2, 1, 1)
    viewmats = torch.cat([good.viewmats[:seeing], away])
    both = Cameras(
        viewmats=viewmats, Ks=good.Ks[:1].repeat(len(viewmats), 1, 1), width=48, height=36
    )
    config = MatchConfig(opacity_rounds=0, color_iterations=5)
    targets = torch.zeros(len(small))
    alone = match_views(small, observe(scene, good[:seeing]), targets, config=config)
    found = match_views(small, observe(scene, both), targets, config=config)
    assert found.report.heldout == seeing
    assert found.report.psnr_before == pytest.approx(alone.report.psnr_before)
    assert found.report.psnr_after == pytest.approx(alone.report.psnr_after)
    assert found.report.psnr_after > found.report.psnr_before
