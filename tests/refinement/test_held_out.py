"""Held-out images: which they are, their size, and how they decide; what a step compares."""

from dataclasses import replace
from itertools import chain, repeat

import pytest
import torch

from cvtgs.analysis.analyze import visibility_cameras
from cvtgs.config import SimplifyConfig
from cvtgs.evaluation import scorer as scorer_module
from cvtgs.evaluation.scorer import BLACK, WHITE, Metrics, Scorer, render_views
from cvtgs.progress import silent
from cvtgs.refinement import RefineConfig, optimize
from cvtgs.refinement.images import (
    ImageBuffer,
    RefineViews,
    generated_views,
    shared_views,
    split_views,
)
from cvtgs.refinement.optimize import Limits
from cvtgs.rendering import observe
from refine_cases import discolored, full_scene, quick, ring


def test_the_middles_of_equal_parts_are_held_out():
    cameras = ring(16)
    views = split_views(cameras, config=RefineConfig(size=32, heldout=4, stride=1), seed=0)
    assert len(views.heldout) == 2
    for held, row in zip(views.heldout, (4, 12), strict=True):
        assert torch.equal(held.viewmats[0], cameras.viewmats[row])


def test_held_out_views_and_every_batch_have_seeds_of_their_own(monkeypatch):
    seeds = []

    def views(_positions, count, *, size, seed):
        seeds.append(seed)
        return ring(count, width=size, height=size)

    monkeypatch.setattr("cvtgs.refinement.images.find_view_positions", lambda full: None)
    monkeypatch.setattr("cvtgs.refinement.images.mixed_views", views)
    found = generated_views(full_scene(), config=RefineConfig(size=32, heldout=2, batch=4), seed=5)
    for _ in range(9):
        next(found.training)
    assert len(set(seeds)) == 4
    assert 5 not in seeds  # evaluations use it


def test_thinned_views_start_at_every_first_pixel_in_turn():
    held = split_views(ring(40), config=RefineConfig(size=32, stride=2), seed=0).heldout
    shifts = [tuple((one.Ks - held[0].Ks)[0, :2, 2].tolist()) for one in held]
    assert shifts == [(0, 0), (-0.5, 0), (0, -0.5), (-0.5, -0.5), (0, 0)]


@pytest.mark.slow
@pytest.mark.parametrize(("width", "side"), [(16, 22), (24, 24), (32, 32), (200, 32)])
def test_images_are_of_two_sizes(width, side):
    """About half are as sharp as larger ones, which steps then see fewer pixels of."""
    full, cameras = full_scene(50), ring(16, width=width, height=width)
    sizes = {"size": 32, "stride": 2, "fine_factor": 3}
    config = SimplifyConfig.from_mapping({"visibility": {"views": 8, **sizes}})
    for given, side_then in ((cameras, side), (None, 32)):
        seen = visibility_cameras(full, config, cameras=given)
        assert (seen.width, set(seen.strides)) == (side_then // 2, {2, 6})
        if given is None:
            views = generated_views(full, config=quick(**sizes), seed=0)
        else:
            views = split_views(given, config=quick(**sizes), seed=0)
        training = [next(views.training) for _ in range(8)]
        assert {camera.width for camera in training} == {side_then}
        assert {camera.strides for camera in training} == {(1,), (3,)}
        assert {camera.strides for camera in views.heldout} <= {(2,), (6,)}
        shown = replace(views, training=iter(training))
        images = ImageBuffer(full, shown, config=quick(**sizes), seed=0)
        drawn = [images.draw().cameras for _ in training]
        assert [camera.strides[0] for camera in drawn] == [2 * one.strides[0] for one in training]
        assert {camera.width for camera in drawn} == {side_then // 2}


def optimized(small, full, config, *, cameras, steps):
    """Optimize without held-out images; their scores are those of the patched function."""
    views = RefineViews(heldout=(), training=iter(ring(cameras).singles()), endless=False)
    return optimize.optimize(
        small,
        ImageBuffer(full, views, config=config, seed=0),
        None,
        limits=Limits(None, steps=steps),
        config=config,
        learning_rate_scale=torch.ones(len(small)),
        listener=silent,
    )


@pytest.mark.parametrize(
    ("later", "after"), [((19, 58), 22.5), ((22, 26), 23.0), ((21, 31), 23.25)]
)
def test_a_far_better_view_counts_as_ten_decibels_above_the_median(monkeypatch, later, after):
    """At first 20 dB in three views and 50 in the last, which counts as 30: 22.5 on average."""
    scores = chain([(20, 50)], repeat(later))  # also for parts of the changes

    def scored(*_) -> torch.Tensor:
        usual, last = next(scores)
        return torch.tensor([usual, usual, usual, last], dtype=torch.float64)

    monkeypatch.setattr(optimize, "heldout_psnr", scored)
    full, config = full_scene(50), quick()
    small = discolored(full)
    found = optimized(small, full, config, cameras=1, steps=1)
    assert (found.before, found.after) == (22.5, after)
    assert (found.scene is small) == (after == 22.5)


@pytest.mark.parametrize(
    ("later", "part"),
    [((21,), 1.0), ((19, 20.5), 0.75), ((19, 20, 21), 0.5), ((19, 19, 20, 20.1), 0.25)],
)
def test_the_largest_part_of_refused_changes_that_gains_is_kept(monkeypatch, later, part):
    """Scores of the start, after the step, and of three quarters, half and a quarter of it."""
    scores = iter([20, *later])
    monkeypatch.setattr(optimize, "heldout_psnr", lambda *_: torch.tensor([float(next(scores))]))
    full, config = full_scene(50), quick()
    small = discolored(full)
    found = optimized(small, full, config, cameras=1, steps=1)
    assert next(scores, None) is None
    assert found.after == pytest.approx(later[-1])
    monkeypatch.setattr(optimize, "heldout_psnr", lambda *_: torch.tensor([20.0 + next(whole)]))
    whole = iter(range(2))
    changes = optimized(small, full, config, cameras=1, steps=1).scene.sh0 - small.sh0
    assert changes.abs().amax() > 0
    torch.testing.assert_close(found.scene.sh0 - small.sh0, part * changes, atol=1e-6, rtol=1e-4)


def test_without_a_part_that_gains_the_start_is_kept(monkeypatch):
    scores = iter([20.0, 19.0, 19.0, 20.0, 20.0])
    monkeypatch.setattr(optimize, "heldout_psnr", lambda *_: torch.tensor([next(scores)]))
    full, config = full_scene(50), quick()
    small = discolored(full)
    assert optimized(small, full, config, cameras=1, steps=1).scene is small
    assert next(scores, None) is None


def test_no_part_is_tried_when_the_time_is_over(monkeypatch):
    scores = iter([20.0, 19.0])
    monkeypatch.setattr(optimize, "heldout_psnr", lambda *_: torch.tensor([next(scores)]))
    monkeypatch.setattr(Limits, "reached", lambda limits: "time" if limits.steps else "")
    full, config = full_scene(50), quick()
    small = discolored(full)
    assert optimized(small, full, config, cameras=1, steps=1).scene is small


def test_an_equal_scene_looks_equal_over_every_background(monkeypatch):
    """And the weights of the two losses are those of the configuration."""
    seen = []

    def noted(image, target, **weights) -> torch.Tensor:
        seen.append((float((image.detach() - target).abs().max()), float(target.mean()), weights))
        return image.sum() * 0

    monkeypatch.setattr(optimize, "relative_loss", noted)
    monkeypatch.setattr(optimize, "heldout_psnr", lambda *_: torch.full((2,), 30.0).double())
    full, config = full_scene(50), quick(mse_weight=0.2, image_weight=0.7)
    optimized(full, full, config, cameras=4, steps=4)
    errors, means, weights = zip(*seen, strict=True)
    assert max(errors) < 2e-3
    assert len(set(means)) == 4
    assert weights == ({"mse_weight": 0.2, "image_weight": 0.7},) * 4


def test_old_images_leave_the_buffer_in_random_order():
    """Often another image than the one that was just used."""
    config = quick(images=4, steps_per_image=2)
    views = RefineViews(heldout=(), training=iter(ring(80).singles()), endless=True)
    images = ImageBuffer(full_scene(50), views, config=config, seed=0)
    eyes = [tuple(images.draw().cameras.centers[0].tolist()) for _ in range(140)]
    assert images.rendered > 50
    assert not set(eyes[:20]) & set(eyes[100:])
    new = [step for step in range(20, 130) if eyes[step] not in eyes[:step]]
    assert any(eyes[step - 1] in eyes[step:] for step in new)


@pytest.mark.parametrize(("pixels", "groups"), [(1, [1, 1, 1, 1, 1]), (1 << 21, [3, 1, 1])])
def test_small_views_of_one_size_are_scored_together(monkeypatch, pixels, groups):
    full, small = full_scene(200), discolored(full_scene(200))
    other = ring(1, width=20, height=16)
    cameras = [*ring(3).singles(), other, ring(1)]
    rendered = []

    def counted(scene, cameras):
        rendered.append(len(cameras))
        return render_views(scene, cameras)

    scorer = Scorer(full, cameras, metrics=Metrics(), backgrounds=(BLACK, WHITE))
    monkeypatch.setattr(scorer_module, "PIXELS_TOGETHER", pixels)
    monkeypatch.setattr(scorer_module, "render_views", counted)
    scores = scorer.score(small)
    assert rendered == groups
    for row, camera in enumerate(cameras):
        single = Scorer(full, [camera], metrics=Metrics(), backgrounds=(BLACK, WHITE))
        assert single.score(small) == scores[2 * row : 2 * row + 2]


def test_cameras_that_see_nothing_are_not_held_out():
    """An image of nothing is perfect from the start, so no step would be taken."""
    full, cameras = full_scene(50), ring(16)
    viewmats = cameras.viewmats.clone()
    viewmats[[4, 5], :3, 3] += 1000.0
    away, config = replace(cameras, viewmats=viewmats), RefineConfig(size=32, heldout=2)
    held = split_views(away, config=config, seed=0, full=full).heldout
    rows = [row for one in held for row in range(16) if torch.equal(one.viewmats[0], viewmats[row])]
    assert len(rows) == len(held) == 1
    assert not {4, 5} & set(rows)
    observed = observe(full, away.fitted(32))
    shared = shared_views(observed, full, away, config=config, seed=0)
    assert len(shared.heldout_images) == 1
    assert all(bool((image.alpha > 0).any()) for image in shared.heldout_images)
