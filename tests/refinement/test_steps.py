"""The images, backgrounds and loss of one step."""

from dataclasses import replace

import pytest
import torch

from cvtgs.config import RefineConfig
from cvtgs.edit import Motion, move
from cvtgs.evaluation.scorer import render_views
from cvtgs.refinement import refine
from cvtgs.refinement.images import ImageBuffer, RefineViews
from cvtgs.refinement.optimize import mean_loss
from refine_cases import discolored, full_scene, quick, ring, small_scene, three_views


def test_a_scene_too_small_for_the_near_plane_is_warned_about():
    full, small = (
        move(one, Motion(scale=2e-3)) for one in (full_scene(), small_scene(full_scene()))
    )
    with pytest.warns(match="images of the full scene lack .* scale it up"):
        refine(small, full, steps=1, config=quick())


def test_the_images_of_a_step_are_joined_by_their_size():
    views = three_views()
    fewer = replace(views, training=iter([*views.training, ring(1, width=20, height=16)]))
    config = quick(images_per_step=4, first_images=4, steps_per_image=100)
    first, second = ImageBuffer(full_scene(50), fewer, config=config, seed=0).draw_step()
    assert first.rgb.shape == (3, 24, 32, 3)
    assert (len(first.cameras), first.cameras.width) == (3, 32)
    assert second.rgb.shape == (1, 16, 20, 3)


def test_the_loss_of_a_step_is_the_mean_over_its_images():
    full, small = full_scene(200), small_scene(full_scene(200))
    losses = []
    for number in (1, 3):
        config = quick(images_per_step=number, first_images=3)
        images = ImageBuffer(full, three_views(), config=config, seed=0)
        images.draw_backgrounds = lambda count: torch.zeros(count, 3)
        steps = [mean_loss(small, images, config) for _ in range(3 // number)]
        losses.append(torch.stack(steps).mean())
    torch.testing.assert_close(*losses)


def test_every_weight_of_the_loss_counts():
    full, small = full_scene(200), small_scene(full_scene(200))

    def loss_of(**weights: float) -> float:
        config = quick(first_images=3, **weights)
        images = ImageBuffer(full, three_views(), config=config, seed=0)
        return mean_loss(small, images, config).item()

    for name in RefineConfig.model_fields:
        if name.endswith("_weight"):
            assert loss_of(**{name: 3.0}) != loss_of(), f"pass {name} in mean_loss"


def test_images_of_all_sizes_weigh_the_same_in_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of four images, three have one size and one has another."""
    full, small = full_scene(200), small_scene(full_scene(200))
    views = three_views()
    views = replace(views, training=iter([*views.training, ring(1, width=20, height=16)]))
    config = quick(images_per_step=4, first_images=4, steps_per_image=100)
    images = ImageBuffer(full, views, config=config, seed=0)
    monkeypatch.setattr(images, "draw_backgrounds", lambda count: torch.zeros(count, 3))
    drawn, losses = images.draw_step(), list[torch.Tensor]()
    for some in (drawn, drawn[:1], drawn[1:]):
        monkeypatch.setattr(images, "draw_step", lambda some=some: some)
        count = sum(len(one.rgb) for one in some)
        of_these = config.model_copy(update={"images_per_step": count})
        losses.append(mean_loss(small, images, of_these))
    torch.testing.assert_close(losses[0], (3 * losses[1] + losses[2]) / 4)


def test_backgrounds_are_random_and_seeded():
    full = full_scene(50)
    buffers = [ImageBuffer(full, three_views(), config=quick(), seed=seed) for seed in (0, 0, 1)]
    first, again, other = (images.draw_backgrounds(2) for images in buffers)
    assert first.shape == (2, 3)
    assert not torch.equal(first[0], first[1])
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert 0 <= float(first.amin()) <= float(first.amax()) <= 1


@pytest.mark.parametrize(
    ("count", "thinning", "times"), [(164, 1, 1), (163, 2, 2.506), (100, 2, 3.2), (9, 2, 4)]
)
def test_few_gaussians_get_more_steps_of_fewer_pixels(count, thinning, times):
    """Of 32 x 32 pixels, 163 Gaussians have 6.28 each, and 164 have 6.24, less than 2.5 * 2.5."""
    config = RefineConfig(size=64, stride=2, steps=10, lengthening=4, half_after=20, check_every=5)
    assert config.thinning(count) == thinning
    found = config.for_count(count)
    assert (found.steps, found.half_after) == (round(10 * times), round(20 * times))
    assert (found.check_every, found.steps_per_image) == (round(5 * times), round(times))
    assert found.rates == config.rates
    twice = config.model_copy(update={"lengthening": 2.0})
    assert (twice.thinning(count), twice.for_count(count).steps) == (thinning, 10 * min(times, 2))
    never = config.model_copy(update={"lengthening": 1.0})
    assert never.thinning(count) == 1
    assert never.for_count(count) == never


def test_two_and_a_half_pixels_along_a_side_are_enough_to_thin_steps() -> None:
    config = RefineConfig(size=250, lengthening=4)
    assert [config.thinning(count) for count in (10_000, 10_001)] == [2, 1]


@pytest.mark.parametrize("stride", [1, 2])
def test_thinned_steps_see_every_second_pixel_of_those_of_the_stride(stride):
    full, cameras = full_scene(200), ring(1, width=62, height=46)
    views = RefineViews(heldout=(), training=iter([cameras]), endless=False)
    images = ImageBuffer(full, views, config=quick(stride=stride), seed=0, thinning=2)
    whole, step, seen = render_views(full, cameras).rgb, 2 * stride, set()
    for _ in range(60):
        found = images.draw()
        column, row = (
            round(step * float(0.5 - shift) - 0.5)
            for shift in found.cameras.Ks[0, :2, 2] - cameras.Ks[0, :2, 2] / step
        )
        seen.add((column, row))
        part = whole[:, row::step, column::step]
        torch.testing.assert_close(found.rgb.float(), part, rtol=1e-3, atol=1e-3)
    assert len(seen) == step**2


def test_images_that_are_too_small_for_ssim_are_not_thinned():
    views = RefineViews(heldout=(), training=iter([ring(1, width=40, height=21)]), endless=False)
    images = ImageBuffer(full_scene(50), views, config=quick(), seed=0, thinning=2)
    assert images.draw().rgb.shape == (1, 21, 40, 3)


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "found"), [(None, 12), (3, 3)])
def test_only_configured_steps_are_multiplied(steps, found):
    full = full_scene(60)
    config = quick(steps=4, size=48, lengthening=3.0)
    small = discolored(full.select(slice(0, 20)))
    assert refine(small, full, steps=steps, config=config).report.steps == found
