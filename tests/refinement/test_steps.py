"""The images, backgrounds and loss of one step."""

from dataclasses import replace

import torch

from cvtgs.refinement.images import ImageBuffer
from cvtgs.refinement.optimize import mean_loss
from refine_cases import full_scene, quick, ring, small_scene, three_views


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


def test_backgrounds_are_random_and_seeded():
    full = full_scene(50)
    buffers = [ImageBuffer(full, three_views(), config=quick(), seed=seed) for seed in (0, 0, 1)]
    first, again, other = (images.draw_backgrounds(2) for images in buffers)
    assert first.shape == (2, 3)
    assert not torch.equal(first[0], first[1])
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert 0 <= float(first.amin()) <= float(first.amax()) <= 1
