"""The parts of refinement: limits, scores, views, images, settings."""

import weakref
from itertools import chain

import pytest
import torch

from cvtgs.cameras import Cameras
from cvtgs.errors import ConfigError
from cvtgs.evaluation import scorer as scorer_module
from cvtgs.evaluation.scorer import BLACK, WHITE, Metrics, Scorer, ViewImages, render_views
from cvtgs.refinement import RefineConfig, images as images_module, optimize as optimize_module
from cvtgs.refinement.images import ImageBuffer, RefineViews, generated_views, split_views
from cvtgs.refinement.optimize import Limits, heldout_psnr, psnr_cap, step_factor
from cvtgs.rendering import observe
from refine_cases import full_scene, quick, ring, three_views
from scenes import random_scene


class Clock:
    """A clock that stands still until a test advances it."""

    def __init__(self, monkeypatch):
        self.now = 100.0
        monkeypatch.setattr(optimize_module.time, "perf_counter", lambda: self.now)


@pytest.fixture
def clock(monkeypatch) -> Clock:
    return Clock(monkeypatch)


def test_steps_are_counted():
    limits = Limits(None, steps=4)
    assert (limits.total, limits.done, limits.share(), limits.reached()) == (4, 0, 0.0, "")
    shares = []
    for _ in range(4):
        limits.begin()
        limits.end("step")
        shares.append((limits.share(), limits.done))
    assert shares == [(0.25, 1), (0.5, 2), (0.75, 3), (1.0, 3)]
    assert limits.reached() == "steps"


@pytest.mark.parametrize(
    ("cooling", "wanted"),
    [
        (0.0, [1, 2 / 3, 1 / 2, 2 / 5]),
        (0.5, [1, 2 / 3, 1 / 2, 1 / 5]),
        (1.0, [1, 1 / 2, 1 / 4, 0.1]),
    ],
)
def test_steps_become_shorter_and_end_at_zero_if_configured(cooling, wanted):
    limits, config = Limits(None, steps=4), RefineConfig(half_after=2, cooling=cooling)
    found = []
    for _ in range(4):
        found.append(step_factor(limits, config))
        limits.begin()
        limits.end("step")
    assert found == pytest.approx(wanted)


def test_refinement_stops_before_a_round_that_would_exceed_the_time(clock):
    limits = Limits(10.0, steps=None)
    limits.begin()
    clock.now += 2
    limits.end("check")
    clock.now += 1
    limits.end("step")
    assert (limits.total, limits.done, limits.steps) == (1000, 300, 1)
    clock.now = 106.9
    assert limits.reached() == ""
    clock.now = 107.1
    assert limits.reached() == "time"


def test_the_first_step_is_reported_however_little_time_has_passed(clock):
    limits = Limits(10.0, steps=None)
    assert limits.done == 0
    limits.begin()
    limits.end("step")
    assert limits.done == 1
    clock.now += 20
    assert (limits.done, limits.share()) == (999, 1.0)


def test_generated_views_are_endless_and_differ_from_held_out_ones():
    full = full_scene()
    views = generated_views(full, config=quick(heldout=5, batch=4), seed=0)
    assert len(views.heldout) == 5
    training = [next(views.training) for _ in range(9)]
    cameras = [camera.viewmats for camera in (*views.heldout, *training)]
    assert all(len(camera) == 1 for camera in cameras)
    different = {tuple(camera.flatten().tolist()) for camera in cameras}
    assert len(different) == 14
    assert {(camera.width, camera.height) for camera in training} == {(32, 32)}


@pytest.mark.slow
def test_the_seed_decides_the_views():
    full = full_scene()
    first, again, other = (
        next(generated_views(full, config=quick(), seed=seed).training).viewmats
        for seed in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize(
    ("count", "heldout", "number"), [(2, 8, 1), (9, 8, 1), (16, 8, 2), (100, 8, 8), (100, 3, 3)]
)
def test_given_cameras_are_split(count, heldout, number):
    cameras = ring(count)
    views = split_views(cameras, config=RefineConfig(heldout=heldout), seed=0)
    training = list(views.training)
    assert (len(views.heldout), len(training)) == (number, count - number)
    everything = torch.cat([camera.viewmats for camera in chain(views.heldout, training)])
    assert len({tuple(each.flatten().tolist()) for each in everything}) == count


@pytest.mark.parametrize(
    ("width", "height", "size"),
    [(640, 480, (64, 48)), (40, 30, (40, 30)), (6400, 100, (64, 11)), (5, 7, (11, 11))],
)
def test_large_images_are_scaled_down_and_tiny_ones_up(width, height, size):
    views = split_views(ring(2, width=width, height=height), config=RefineConfig(size=64), seed=0)
    camera = views.heldout[0]
    assert (camera.width, camera.height) == size
    assert camera.Ks[0, 0, 2].item() == pytest.approx(size[0] / 2)


def flat_image(value: float, alpha: float) -> ViewImages:
    return ViewImages(
        cameras=ring(1),
        rgb=torch.full((1, 24, 32, 3), value),
        alpha=torch.full((1, 24, 32), alpha),
    )


def test_an_image_over_a_background():
    found = flat_image(0.25, 0.5).over(torch.tensor([1.0, 0.5, 0.0]).double())
    assert found.dtype == torch.float64
    assert found[0, 3, 4].tolist() == [0.75, 0.5, 0.25]


def test_scores_by_hand(monkeypatch):
    """A Gaussian behind the camera paints nothing: black over black, white over white."""
    blind = random_scene(1).with_tensors({"means": torch.tensor([[0.0, 0.0, -90.0]])}, {})

    def scores(*truths: ViewImages) -> torch.Tensor:
        full = full_scene(1)
        with monkeypatch.context() as patch:
            patch.setattr(scorer_module, "render_views", lambda *_: next(images))
            images = iter(truths)
            cameras = [image.cameras for image in truths]
            metrics = Metrics(ssim=False, most_psnr=60.0)
            scorer = Scorer(full, cameras, metrics=metrics, backgrounds=(BLACK, WHITE))
        return heldout_psnr(blind, scorer)

    assert scores(flat_image(0.0, 0.0)).tolist() == [60, 60]
    # The first is off by 0.1 over black, by 0.1 over white.
    found = scores(flat_image(0.1, 0.2), flat_image(0.1, 0.1))
    # The second is off by 0.1 over black (20 dB), and equal over white.
    assert found.tolist() == pytest.approx([20, 20, 20, 60], abs=1e-4)


def test_the_psnr_of_a_far_better_view_is_capped():
    assert psnr_cap(torch.tensor([20.0, 24.0, 26.0, 58.0])) == 34
    assert psnr_cap(torch.tensor([55.0, 58.0])) == 60


@pytest.mark.parametrize("endless", [False, True])
def test_images_are_rendered_when_needed_and_reused(endless):
    full = full_scene(50)
    config = quick(steps_per_image=3, images=2)
    images = ImageBuffer(full, three_views(endless=endless), config=config, seed=0)
    taken, drawn = [], []
    for _ in range(12):
        drawn.append(images.draw())
        taken.append(images.rendered)
    assert taken == [1, 1, 1, 2, 2, 2, 3, 3, 3, 3, 3, 3]
    eyes = [tuple(image.cameras.centers[0].tolist()) for image in drawn]
    assert (len(set(eyes[:3])), len(set(eyes[6:]))) == (1, 2)
    assert drawn[0].rgb.dtype == torch.float16
    exact = render_views(full, drawn[0].cameras)
    torch.testing.assert_close(drawn[0].rgb.float(), exact.rgb, rtol=1e-3, atol=1e-3)


def test_first_steps_get_new_images_and_all_images_recur():
    config = quick(first_images=8, steps_per_image=100)
    views = RefineViews(heldout=(), training=iter(ring(8).singles()), endless=True)
    images = ImageBuffer(full_scene(50), views, config=config, seed=0)
    eyes = [tuple(images.draw().cameras.centers[0].tolist()) for _ in range(8 + 64)]
    assert images.rendered == len(set(eyes[:8])) == 8
    # An image recurs after at least half of the others were used, and not much later.
    for eye in set(eyes):
        uses = [step for step, other in enumerate(eyes) if other == eye]
        gaps = torch.tensor(uses).diff()
        assert int(gaps.amin()) > 4
        assert int(gaps.amax()) < 24


def test_the_pixels_of_a_step_equal_those_of_the_whole_image():
    full = full_scene(200)
    cameras = ring(1, width=47, height=33)
    views = RefineViews(heldout=(), training=iter([cameras]), endless=False)
    images = ImageBuffer(full, views, config=quick(stride=3), seed=0)
    whole = render_views(full, cameras).rgb
    seen = set()
    for _ in range(40):
        found = images.draw()
        column, row = (
            round(3 * float(0.5 - shift) - 0.5)
            for shift in found.cameras.Ks[0, :2, 2] - cameras.Ks[0, :2, 2] / 3
        )
        seen.add((column, row))
        torch.testing.assert_close(
            found.rgb.float(), whole[:, row::3, column::3], rtol=1e-3, atol=1e-3
        )
    assert len(seen) == 9


@pytest.mark.slow
def test_held_out_views_are_thinned_like_training_images():
    full = full_scene(50)
    views = generated_views(full, config=quick(size=48, stride=2), seed=0)
    assert all(camera.strides == (2,) for camera in views.heldout)
    assert {(camera.width, camera.height) for camera in views.heldout} == {(24, 24)}
    assert next(views.training).width == 48
    tiny = generated_views(full, config=quick(size=16, stride=3), seed=0)
    assert next(tiny.training).width == 33  # so that enough pixels for SSIM are left
    given = split_views(ring(8), config=quick(stride=2), seed=0)
    assert [(camera.width, camera.height) for camera in given.heldout] == [(16, 12)]


def test_the_number_of_images_for_a_number_of_steps():
    config = RefineConfig(first_images=32, steps_per_image=8)
    assert [config.new_images(steps) for steps in (0, 5, 32, 39, 40, 48)] == [0, 5, 32, 32, 33, 34]
    config = quick(first_images=3, steps_per_image=3)
    views = RefineViews(heldout=(), training=iter(ring(8).singles()), endless=True)
    images = ImageBuffer(full_scene(50), views, config=config, seed=0)
    taken = []
    for steps in range(1, 10):
        images.draw()
        taken.append(images.rendered)
        assert taken[-1] == config.new_images(steps)
    assert taken == [1, 2, 3, 3, 3, 4, 4, 4, 5]


def test_observed_images_come_first_and_every_eighth_is_held_out():
    full, cameras = full_scene(50), ring(24)
    config = quick(stride=2, first_images=2, steps_per_image=50)
    observed = observe(full, cameras.select(torch.arange(16)).interleaved(2))
    views = images_module.shared_views(observed, full, cameras, config=config, seed=0)
    assert (len(views.heldout), len(views.heldout_images), len(views.images)) == (0, 2, 14)
    images = ImageBuffer(full, views, config=config, seed=0)
    drawn = [images.draw() for _ in range(50)]
    assert [config.new_images(steps, shared=16) for steps in (14, 49, 50, 100)] == [0, 0, 1, 2]
    assert images.rendered == 1
    given = {tuple(camera.viewmats.flatten().tolist()) for camera in observed.cameras.singles()}
    known = [tuple(image.cameras.viewmats.flatten().tolist()) in given for image in drawn]
    assert known == [True] * 49 + [False]
    assert {image.cameras.strides for image in drawn} == {(2,)}
    held = {tuple(image.cameras.viewmats.flatten().tolist()) for image in views.heldout_images}
    assert not held & {tuple(image.cameras.viewmats.flatten().tolist()) for image in drawn}
    exact = render_views(full, drawn[0].cameras)
    torch.testing.assert_close(drawn[0].rgb.float(), exact.rgb, rtol=1e-3, atol=1e-3)


def test_no_view_is_searched_before_it_is_needed(monkeypatch):
    full = full_scene(50)
    observed = observe(full, ring(8))
    monkeypatch.setattr(images_module, "find_view_positions", None)
    views = images_module.shared_views(
        observed, full, None, config=quick(steps_per_image=9), seed=0
    )
    images = ImageBuffer(full, views, config=quick(steps_per_image=9), seed=0)
    assert [images.draw().cameras.strides for _ in range(8)] == [()] * 8
    with pytest.raises(TypeError):
        images.draw()


def test_images_that_are_never_used_again_are_not_kept():
    images = ImageBuffer(full_scene(50), three_views(endless=True), config=quick(images=9), seed=0)
    first, second = weakref.ref(images.draw().rgb), images.draw()
    assert first() is None
    assert second.rgb.shape == (1, 24, 32, 3)


@pytest.mark.parametrize(
    "values", [{"size": 8}, {"half_after": 0}, {"rates": {"sh0": -1}}, {"colour": 1}]
)
def test_invalid_settings_are_refused(values):
    with pytest.raises(ConfigError):
        RefineConfig(**values)


def test_training_cameras_have_one_view_each():
    views = split_views(ring(4), config=RefineConfig(), seed=1)
    assert all(isinstance(camera, Cameras) and len(camera) == 1 for camera in views.training)
