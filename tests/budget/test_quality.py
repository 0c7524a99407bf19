"""The smallest count that reaches a quality."""

import math
import warnings
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

import cvtgs
from cvtgs.analysis import analyze
from cvtgs.budget import find_count
from cvtgs.budget.count import (
    CLOSE,
    HELDOUT_SEED,
    Target,
    heldout_quality,
    heldout_scorer,
    smallest_enough,
)
from cvtgs.errors import DroppedDataWarning, GoalError, InvalidArgumentError, InvalidSceneError
from cvtgs.progress import silent
from cvtgs.views import automatic_views
from scenes import random_scene, same_bits


def search(values, wanted: float, most: int) -> list[tuple[int, float]]:
    return list(smallest_enough(values, wanted, most=most))


def answer(tried: list[tuple[int, float]], wanted: float) -> int | None:
    return min((count for count, value in tried if value >= wanted), default=None)


def test_no_heldout_camera_is_refused():
    scene = cvtgs.synthetic.scene("object", 50, sh_degree=0)
    none = automatic_views(scene, 1, width=32, height=24).select(torch.arange(0))
    with pytest.raises(InvalidArgumentError, match="heldout must hold at least one camera, found"):
        find_count(scene, psnr=20.0, heldout=none)


def test_cameras_that_miss_the_scene_are_refused():
    scene = cvtgs.synthetic.scene("object", 50, sh_degree=0)
    views = automatic_views(scene, 2, width=32, height=24)
    away = views.viewmats.clone()
    away[:, 0, 3] += 1e4
    means, logits = scene.means.clone(), scene.logit_opacities.clone()
    means[0] = away[0, :3, :3].T @ (torch.tensor([0.0, 0.0, 3.0]) - away[0, :3, 3])
    logits[0] = -8.0  # before a camera, but too faint to be drawn
    scene = scene.with_tensors(means=means, logit_opacities=logits)
    with pytest.raises(InvalidArgumentError, match="must see the scene, found nothing of it"):
        find_count(scene, psnr=20.0, heldout=replace(views, viewmats=away))


def test_a_goal_that_is_nearly_reached_has_more_digits():
    assert Target("psnr", 55.734).missed(55.731) == ("55.734 dB", "55.731 dB")
    assert Target("psnr", 40.0).missed(31.2) == ("40.00 dB", "31.20 dB")
    assert Target("ssim", 0.9999999).missed(0.9983) == ("SSIM 0.9999999", "SSIM 0.9983000")
    assert Target("psnr", 100 / 3).missed(31.2) == ("33.33 dB", "31.20 dB")


def test_an_empty_scene_is_named(views):
    with pytest.raises(InvalidSceneError, match="must have at least one Gaussian, found none"):
        find_count(random_scene(2)[:0], psnr=30.0, heldout=views)


@pytest.mark.parametrize("wanted", [3.0, 17.0, 25.0, 31.4, 44.0])
@pytest.mark.parametrize("most", [100, 9_000, 900_000])
@pytest.mark.parametrize(
    "curve",
    [
        lambda share: 50 + 8 * math.log10(share),
        lambda share: 60 * share**0.3,
        lambda share: 60 * (1 - math.exp(-40 * share)),
    ],
    ids=["straight", "bent", "saturating"],
)
def test_the_smallest_count_is_found_within_3_percent_in_few_tries(wanted, most, curve):
    def reach(count: int) -> float:
        return curve(count / most)

    tried = search(reach, wanted, most)
    found = answer(tried, wanted)
    assert found is not None
    assert found == 1 or reach(max(1, math.floor(found / CLOSE) - 1)) < wanted
    assert len(tried) <= 16
    assert len({count for count, _ in tried}) == len(tried)


def test_the_search_handles_extreme_curves_and_ranges():
    assert answer(search(lambda count: 1.0, 1.0, 1000), 1.0) == 1
    assert answer(search(lambda count: 0.0, 1.0, 1000), 1.0) is None
    assert search(lambda count: 0.0, 1.0, 1) == [(1, 0.0)]
    assert answer(search(float, 2.0, 2), 2.0) == 2


def test_steps_never_leave_the_range():
    tried = search(lambda count: float(count == 900), 1.0, 900)
    assert all(1 <= count <= 900 for count, _ in tried)
    assert answer(tried, 1.0) == 900


@pytest.mark.parametrize("high", [1e3, 1.001])
def test_every_try_between_two_bounds_leaves_at_most_85_percent_of_them(high):
    """A step from 0 to ``high`` at 70,000: straight lines point to an end of the range."""
    tried = search(lambda count: high * (count >= 70_000), 1.0, 900_000)
    widths, bounds = [], [0, 900_001]
    for count, value in tried:
        bounds[value > 0] = count
        if bounds[0] > 0 and bounds[1] <= 900_000:
            widths.append(math.log(bounds[1] / bounds[0]))
    assert widths[-1] <= math.log(CLOSE)
    assert len(widths) > 8
    for before, after in pairwise(widths):
        assert after < 0.851 * before


@pytest.fixture(scope="module")
def full() -> cvtgs.GaussianScene:
    return cvtgs.synthetic.scene("object", 600, sh_degree=0, seed=2)


@pytest.fixture(scope="module")
def views(full) -> cvtgs.Cameras:
    return automatic_views(full, 2, width=40, height=30, seed=HELDOUT_SEED)


@pytest.fixture(scope="module")
def simplifier() -> cvtgs.Simplifier:
    return cvtgs.Simplifier(config="draft", device="cpu")


@pytest.mark.parametrize("goal", [{"psnr": 22.0}, {"ssim": 0.8}])
def test_the_goal_is_reached_and_smaller_tries_miss_it(full, views, simplifier, goal):
    found = find_count(full, **goal, simplifier=simplifier, heldout=views)
    (metric, wanted), *_ = goal.items()
    assert getattr(found, metric) >= wanted
    assert len(found.scene) == found.report.output_count < len(full)
    below = [one for one in found.tried if one.count < len(found.scene)]
    assert below
    assert all(getattr(one, metric) < wanted for one in below)
    largest = max(one.count for one in below)
    assert len(found.scene) <= max(CLOSE * largest, largest + 1)
    mine = next(one for one in found.tried if one.count == len(found.scene))
    assert (mine.psnr, mine.ssim) == (found.psnr, found.ssim)


def test_the_goal_is_reached_by_what_is_written(full, views, simplifier):
    """The result is not rounded: saving it does that."""

    def written(scene: cvtgs.GaussianScene) -> cvtgs.GaussianScene:
        return scene.with_tensors({"sh0": scene.sh0.round(decimals=0)})

    found = find_count(full, psnr=20.0, simplifier=simplifier, heldout=views, written=written)
    scorer = heldout_scorer(full, views, listener=silent)
    quality = heldout_quality(scorer, written(found.scene), count=len(found.scene))
    assert quality.psnr == found.psnr >= 20.0
    unrounded = find_count(full, psnr=20.0, simplifier=simplifier, heldout=views)
    assert len(unrounded.scene) < len(found.scene)
    assert same_bits(found.scene, simplifier.simplify(full, count=len(found.scene)))


def test_the_scores_match_an_evaluation(full, views, simplifier):
    small = simplifier.simplify(full, 0.2)
    scorer = heldout_scorer(full, views, listener=silent)
    quality = heldout_quality(scorer, small, count=len(small))
    settings = cvtgs.evaluation.EvaluationSettings(lpips="off")
    wanted = cvtgs.evaluation.evaluate(full, {"small": small}, views, settings=settings).scenes[0]
    assert quality.psnr == pytest.approx(wanted.psnr.mean, abs=1e-4)
    assert quality.ssim == pytest.approx(wanted.ssim.mean, abs=1e-5)
    assert quality.alpha_error == pytest.approx(wanted.alpha_error.mean, abs=1e-6)
    assert quality.alpha_bias == pytest.approx(wanted.alpha_bias.mean, abs=1e-6)


def test_the_full_scene_is_rendered_once(full, views, simplifier, monkeypatch):
    from cvtgs.evaluation import scorer  # noqa: PLC0415 (patched below)

    sizes = []

    def counting(scene, camera, **choices):
        sizes.append(len(scene))
        return cvtgs.rendering.render(scene, camera, **choices)

    monkeypatch.setattr(scorer, "render", counting)
    find_count(full, psnr=22.0, simplifier=simplifier, heldout=views)
    assert sizes.count(len(full)) == len(views)


def test_the_scene_is_analysed_once(full, views, simplifier, monkeypatch):
    looks = []

    def counting(scene, *arguments, **choices):
        looks.append(len(scene))
        return analyze(scene, *arguments, **choices)

    monkeypatch.setattr("cvtgs.prepared.analyze", counting)
    found = find_count(full, psnr=22.0, simplifier=simplifier, heldout=views)
    assert looks == [len(full)]
    assert len(found.tried) > 2
    assert same_bits(found.scene, simplifier.simplify(full, count=len(found.scene)))


def test_the_stages_are_those_of_all_tries(full, views, simplifier):
    """Scoring is a stage, too, and each stage occurs once."""
    found = find_count(full, psnr=20.0, simplifier=simplifier, heldout=views)
    assert len(found.tried) > 1
    names = [cost.stage for cost in found.report.stages]
    assert (names[0], names[1], names[-1]) == ("check", "plan", "score")
    assert len(names) == len(set(names))
    again = simplifier.prepare(full)
    runs = [again.run(count=one.count).report.stages for one in found.tried]
    peaks = [max(cost.peak_memory_bytes for cost in costs) for costs in runs]
    assert max(cost.peak_memory_bytes for cost in found.report.stages) <= max(peaks)
    assert {cost.stage for costs in runs for cost in costs} == set(names) - {"score"}


def test_a_goal_out_of_reach_is_an_error(full, views, simplifier):
    with pytest.raises(GoalError) as caught:
        find_count(full, psnr=60.0, simplifier=simplifier, heldout=views)
    text = str(caught.value)
    wanted = "no simplified scene reaches 60.00 dB: the best one tried, with 540 of 600"
    assert text.startswith(wanted)
    assert text.endswith(" dB.")


@pytest.mark.parametrize(
    ("goal", "text"),
    [
        ({}, "give either psnr or ssim, found both or neither."),
        ({"psnr": 30.0, "ssim": 0.9}, "give either psnr or ssim, found both or neither."),
        (
            {"psnr": 30.0, "listener": 3},
            "listener must be a function of a progress event, found 3.",
        ),
        ({"psnr": 0.0}, "the PSNR to reach must be above 0 and at most 60 dB, found 0.0."),
        ({"psnr": math.nan}, "the PSNR to reach must be above 0 and at most 60 dB, found nan."),
        ({"psnr": "30"}, "the PSNR to reach must be above 0 and at most 60 dB, found '30'."),
        (
            {"psnr": 30.0, "simplifier": "fast"},
            "simplifier must be of type Simplifier or None, found str.",
        ),
        (
            {"psnr": 30.0, "heldout": "fast"},
            "heldout must be of type Cameras or None, found str.",
        ),
        ({"ssim": 1.0}, "the SSIM to reach must be above 0 and below 1, found 1.0."),
    ],
)
def test_invalid_goals_are_refused(full, goal, text):
    with pytest.raises(InvalidArgumentError) as caught:
        find_count(full, **goal)
    assert str(caught.value) == text


def test_no_count_above_nine_tenths_of_the_valid_gaussians_is_tried(full, views, simplifier):
    means = full.means.clone()
    means[::2] = torch.nan
    with pytest.warns(DroppedDataWarning), pytest.raises(GoalError, match=" with 270 of 600 "):
        find_count(
            full.with_tensors({"means": means}), psnr=60.0, simplifier=simplifier, heldout=views
        )


def test_invalid_rows_are_warned_about_once(full, views, simplifier):
    means = full.means.clone()
    means[:3] = torch.nan
    bad = full.with_tensors({"means": means}, {})
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        find_count(bad, psnr=20.0, simplifier=simplifier, heldout=views)
    assert [one.category for one in heard] == [DroppedDataWarning]


def test_a_listener_is_told_of_every_try(full, views, simplifier):
    heard = []
    found = find_count(full, psnr=22.0, simplifier=simplifier, heldout=views, listener=heard.append)
    notes = [event.note for event in heard if event.note]
    assert len(notes) == len(found.tried)
    assert notes[0].startswith("54: ")
