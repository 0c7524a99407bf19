"""Refinement as a whole: gains, unchanged parts, limits, progress and reports."""

import math
from dataclasses import replace
from importlib import import_module
from typing import Any

import pytest
import torch

import cvtgs
from cvtgs import Cameras
from cvtgs.config import Rates, SimplifyConfig
from cvtgs.errors import DeviceError, InvalidArgumentError, InvalidSceneError
from cvtgs.progress import ProgressEvent
from cvtgs.refinement import RefineConfig, refine
from cvtgs.refinement.images import RefineViews, generated_views, split_views
from cvtgs.refinement.refine import join_reports
from pretended_device import pretended_cuda
from refine_cases import discolored, full_scene, quick, ring, small_scene
from scenes import same_bits

WILD = Rates(means=50, quats=5, log_scales=5, logit_opacities=50, sh0=50, shN=50)


@pytest.mark.slow
def test_wrong_colours_are_corrected():
    full = full_scene()
    refined = refine(discolored(full), full, steps=40, config=quick())
    report = refined.report
    assert report.gain > 1
    assert report.psnr_after == pytest.approx(report.psnr_before + report.gain)
    assert (report.steps, report.stopped, report.heldout) == (40, "steps", 4)
    assert 0 < report.changed_count <= 500
    before, after = (
        (scene.sh0 - full.sh0).abs().mean() for scene in (discolored(full), refined[0])
    )
    assert after < before


@pytest.mark.long
def test_a_simplified_scene_improves_on_unseen_views():
    full = full_scene(2000, degree=0)
    small = small_scene(full, 0.02)
    refined = refine(small, full, steps=80, config=quick(size=48))
    views = cvtgs.views.automatic_views(full, 6, width=64, height=64, seed=5)
    before, after = (
        cvtgs.evaluation.psnr(cvtgs.render(scene, views).rgb, cvtgs.render(full, views).rgb).mean()
        for scene in (small, refined.scene)
    )
    assert refined.report.gain > 0
    assert after > before


@pytest.mark.slow
def test_count_degree_layout_comments_and_extras_stay():
    full = full_scene()
    small = small_scene(full)
    extras = {"label": torch.arange(len(small))}
    small = small.with_tensors({}, extras)
    object.__setattr__(small, "comments", ("made by hand", "SplatRenderMode: mip"))
    object.__setattr__(small, "layout", (("x", "f4"),))
    scene, report = refine(discolored(small), full, steps=20, config=quick())
    assert report.changed_count > 0
    assert (len(scene), scene.sh_degree, scene.dtype) == (len(small), 1, torch.float32)
    assert (scene.comments, scene.layout) == (small.comments, small.layout)
    assert torch.equal(scene.extras["label"], extras["label"])
    lengths = torch.linalg.vector_norm(scene.quats, dim=1)
    torch.testing.assert_close(lengths, torch.ones(len(small)))


@pytest.mark.slow
def test_the_input_scenes_are_not_changed():
    full = full_scene()
    small = small_scene(full)
    copies = [scene.select(torch.arange(len(scene))) for scene in (small, full)]
    refine(small, full, steps=10, config=quick())
    assert same_bits(small, copies[0])
    assert same_bits(full, copies[1])


@pytest.mark.slow
def test_the_result_is_never_worse_than_the_input():
    """Steps so long that every scene but the first is nonsense."""
    full = full_scene()
    small = small_scene(full)
    refined = refine(small, full, steps=20, config=quick(rates=WILD, half_after=10**9))
    assert refined.scene is small
    assert (refined.report.gain, refined.report.changed_count) == (0, 0)


def test_it_stops_when_held_out_views_do_not_improve():
    full = full_scene()
    config = quick(rates=WILD, half_after=10**9, patience=3, check_every=2)
    report = refine(small_scene(full), full, steps=500, config=config).report
    assert (report.steps, report.stopped) == (6, "patience")


@pytest.mark.slow
def test_the_same_steps_give_the_same_bits_and_another_seed_others():
    full = full_scene()
    small = discolored(small_scene(full))
    first, again, other = (
        refine(small, full, steps=12, config=quick(), seed=seed, device="cpu") for seed in (0, 0, 1)
    )
    assert first.report.gain > 0
    assert same_bits(first.scene, again.scene)
    assert first.report.gain == again.report.gain
    assert not same_bits(first.scene, other.scene)


def test_without_time_for_a_step_the_scene_is_returned_unchanged():
    full = full_scene()
    small = small_scene(full)
    with pytest.warns(UserWarning, match=r"no step of the refinement fits into 0\.001 s, so the"):
        refined = refine(small, full, seconds=1e-3, config=quick())
    assert refined.scene is small
    assert (refined.report.steps, refined.report.stopped) == (0, "time")


def test_an_empty_scene_is_refused():
    full = full_scene()
    with pytest.raises(InvalidSceneError, match="none of the 0 of the simplified scene is valid"):
        refine(full[:0], full, steps=1, config=quick())


def test_results_are_not_part_of_a_graph():
    full = full_scene()
    small = small_scene(full)
    wanting = small.with_tensors(
        {name: tensor.clone().requires_grad_() for name, tensor in small.tensors().items()}
    )
    found = refine(wanting, full, steps=2, cameras=ring(4), config=quick(check_every=1)).scene
    assert found is not wanting
    assert not any(tensor.requires_grad for tensor in found.tensors().values())


@pytest.mark.slow
def test_a_time_limit_stops_before_all_steps():
    patient = quick(patience=10**6)
    full = full_scene()
    small = small_scene(full)
    setup = refine(small, full, steps=1, config=patient).report.cost.seconds  # machines differ
    limit = 1.0 + 2 * setup
    report = refine(small, full, seconds=limit, steps=10**9, config=patient).report
    assert report.stopped == "time"
    assert report.cost.seconds < 2 * limit


def test_the_configuration_sets_the_steps():
    full = full_scene()
    report = refine(discolored(full), full, config=quick(steps=3)).report
    assert report.steps == 3


def test_given_cameras_are_used():
    full = full_scene()
    report = refine(discolored(full), full, steps=20, cameras=ring(9), config=quick()).report
    assert (report.heldout, report.images) == (1, 8)
    assert report.gain > 0


@pytest.mark.slow
def test_every_step_is_reported_with_the_gain_so_far():
    events: list[ProgressEvent] = []
    full = full_scene()
    report = refine(discolored(full), full, steps=12, config=quick(), listener=events.append).report
    assert {event.stage for event in events} == {"refine"}
    assert [event.done for event in events] == [0, *range(1, 12), 11, 12]
    assert {event.total for event in events} == {12}
    notes = [event.note for event in events]
    assert notes[:2] == ["", "+0.00 dB"]
    assert notes[-2] == f"{report.gain:+.2f} dB"


def test_a_listener_can_interrupt_a_refinement():
    def stop(event: ProgressEvent) -> None:
        if event.done == 3:
            raise KeyboardInterrupt

    full = full_scene()
    with pytest.raises(KeyboardInterrupt):
        refine(discolored(full), full, steps=12, config=quick(), listener=stop)


@pytest.mark.slow
def test_reports_are_joined():
    full = full_scene()
    small, report = cvtgs.Simplifier(device="cpu").run(full, 0.1)
    refined = refine(discolored(small), full, steps=10, config=quick())
    joined = join_reports(report, refined)
    assert [stage.stage for stage in joined.stages][-2:] == ["network", "refine"]
    assert joined.refinement == refined.report
    assert joined.mass_out == float(refined.scene.masses.sum())
    assert joined.seconds == pytest.approx(report.seconds + refined.report.cost.seconds)
    assert type(joined).model_validate_json(joined.to_json()) == joined
    assert report.refinement is None
    assert joined.config == SimplifyConfig()


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"seconds": 0.0}, InvalidArgumentError, "above 0 and finite, found 0.0."),
        ({"seconds": math.nan}, InvalidArgumentError, "above 0 and finite, found nan."),
        ({"seconds": math.inf}, InvalidArgumentError, "above 0 and finite, found inf."),
        ({"seconds": "30"}, InvalidArgumentError, "above 0 and finite, found '30'."),
        ({"observed": 5}, InvalidArgumentError, "observed must be ObservedViews, as cvtgs.render"),
        ({"listener": 5}, InvalidArgumentError, "must be a function of a progress event, found 5"),
        ({"steps": 0}, InvalidArgumentError, "a whole number above 0, found 0."),
        ({"steps": 1, "frozen": -1}, InvalidArgumentError, "Gaussians, found -1."),
        ({"steps": 2.5}, InvalidArgumentError, "a whole number above 0, found 2.5."),
        ({"steps": True}, InvalidArgumentError, "a whole number above 0, found True."),
        ({"cameras": ring(1)}, InvalidArgumentError, "at least 2 cameras, one of them to be held"),
        ({"cameras": ring(0)}, InvalidArgumentError, "one of them to be held out; found 0."),
        ({"device": "abacus"}, DeviceError, "device 'abacus' cannot be used here"),
    ],
)
def test_bad_arguments_are_refused(options, error, text):
    full = full_scene(50)
    with pytest.raises(error) as caught:
        refine(full, full, **options)
    assert text in str(caught.value)


def test_a_single_camera_is_refused_at_once_beside_existing_images():
    full = full_scene(50)
    observed = cvtgs.rendering.observe(full, ring(4))
    with pytest.raises(InvalidArgumentError, match="at least 2 cameras"):
        refine(full, full, cameras=ring(1), observed=observed)


def test_a_single_existing_image_is_not_used():
    full, cameras = full_scene(50), ring(2)
    options = {"steps": 2, "cameras": cameras, "config": quick(), "device": "cpu"}
    observed = cvtgs.rendering.observe(full, cameras.select([0]))
    found = refine(discolored(full), full, observed=observed, **options)
    assert same_bits(found.scene, refine(discolored(full), full, **options).scene)


@pytest.mark.slow
def test_images_and_cameras_may_be_on_other_devices_than_the_scene():
    full = full_scene(20, degree=0)
    observed = cvtgs.rendering.observe(full, ring(9))
    config = quick(images_per_step=4, steps_per_image=2)
    with pretended_cuda():
        options = {"observed": observed, "cameras": ring(20).to("cuda"), "config": config}
        scene, report = refine(discolored(full), full, steps=1, **options)
    assert (report.device, scene.device.type) == ("cuda:0", "cpu")
    assert report.images == 2


def test_cameras_that_miss_the_scene_are_refused():
    """As for scores: otherwise the scene would seem perfect, and nothing would be refined."""
    full, cameras = full_scene(200), ring(4)
    away = cameras.viewmats.clone()
    away[:, 0, 3] += 1e4  # the scene lies far to the right of every image
    elsewhere = replace(cameras, viewmats=away)
    simplifier = cvtgs.Simplifier(config="matched", device="cpu")
    for use in (
        lambda: refine(full, full, steps=1, cameras=elsewhere),
        lambda: simplifier.simplify(full, 0.1, cameras=elsewhere),
    ):
        with pytest.raises(InvalidArgumentError, match=r"must see .*, found nothing of it in any"):
            use()
    mixed = replace(cameras, viewmats=torch.cat([away[:2], cameras.viewmats[2:]]))
    assert refine(full, full, steps=1, cameras=mixed).report.heldout == 1


@pytest.mark.parametrize("which", ["simplified", "full"])
def test_a_scene_without_valid_rows_is_refused(which):
    full = full_scene(50)
    bad = full.with_tensors({"means": full.means * math.nan}, {})
    scenes = (bad, full) if which == "simplified" else (full, bad)
    with pytest.raises(InvalidSceneError) as caught:
        refine(*scenes, steps=1)
    assert f"none of the 50 of the {which} scene is valid." in str(caught.value)


def test_rates_of_zero_change_nothing():
    full = full_scene()
    still = Rates(means=0, quats=0, log_scales=0, logit_opacities=0, sh0=0, shN=0)
    small = discolored(full)
    refined = refine(small, full, steps=3, config=quick(rates=still))
    assert refined.scene is small
    assert RefineConfig().rates != still


def test_some_views_ignore_the_tag_mip():
    views = generated_views(full_scene(50), config=quick(heldout=3), seed=0)
    training = [next(views.training) for _ in range(6)]
    for some in (views.heldout, training):
        assert {camera.ignores_tag for camera in some} == {(False,), (True,)}


def test_some_given_cameras_ignore_the_tag_mip(monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[Cameras] = []

    def split(cameras: Cameras, **words: Any) -> RefineViews:
        used.append(cameras)
        return split_views(cameras, **words)

    monkeypatch.setattr(import_module("cvtgs.refinement.refine"), "split_views", split)
    full = full_scene(50)
    refine(full, full, steps=1, cameras=ring(8), config=quick())
    assert used[0].ignores_tag == ring(8).in_both_modes().ignores_tag
    assert set(used[0].ignores_tag) == {False, True}
