"""Images that a matching holds out, and scenes far from the origin."""

from dataclasses import replace

import pytest
import torch

from cvtgs.cameras import Cameras, look_at
from cvtgs.config import MatchConfig
from cvtgs.matching import (
    fit_colors,
    heldout_rows,
    heldout_views,
    linear_view,
    match_opacities,
    match_views,
    mean_squared_error,
    with_deeper_opacities,
)
from cvtgs.rendering import observe, render
from refine_cases import ring
from scenes import random_scene, same_bits


@pytest.mark.parametrize(("count", "held"), [(7, []), (8, [4]), (12, [4]), (13, [4, 12])])
def test_every_eighth_image_is_held_out_and_none_of_fewer(count: int, held: list[int]) -> None:
    assert list(heldout_rows(torch.ones(count, 2, 2))) == held
    views = heldout_views(observe(random_scene(3, degree=0), ring(count)))
    wanted = ring(count).viewmats[held or slice(None)]
    assert torch.equal(views.cameras.viewmats, wanted)


def test_an_image_of_nothing_is_never_held_out() -> None:
    """Every scene has that image, so none would be better than the first."""
    scene, cameras = random_scene(60, degree=0), ring(12)
    viewmats = cameras.viewmats.clone()
    viewmats[4] = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])).to(viewmats) @ viewmats[4]
    views = observe(scene, replace(cameras, viewmats=viewmats))
    assert views.alpha.amax(dim=(1, 2))[4] == 0
    assert list(heldout_rows(views.alpha)) == [5]
    dark = scene.with_tensors({"sh0": scene.sh0 - 1}, {})
    config = MatchConfig(opacity_rounds=1, color_iterations=6)
    report = match_views(dark, views, views.contributions, config=config).report
    assert report.heldout == 1
    assert report.psnr_after > report.psnr_before + 1
    assert report.psnr_before < 40


def test_a_scene_that_no_image_shows_keeps_its_colors() -> None:
    scene = random_scene(5, degree=1)
    views = observe(scene, ring(3))
    away = scene.with_tensors({"means": scene.means + 1e4})
    found = fit_colors(away, views, config=MatchConfig(color_iterations=2))
    assert same_bits(found, away)


def test_depths_that_do_not_change_leave_every_bit_of_an_opacity() -> None:
    scene = random_scene(200, degree=0)
    scene.logit_opacities[7] = -800.0  # its optical depth is 0 even in float64
    factors = torch.where(torch.arange(200) < 100, 1.0, 0.5)
    found = with_deeper_opacities(scene, factors).logit_opacities
    assert torch.equal(found[:100], scene.logit_opacities[:100])
    assert bool((found[100:] < scene.logit_opacities[100:]).all())


def test_view_dependent_colors_far_from_the_origin_are_those_of_renders() -> None:
    near = random_scene(40, degree=1)
    shift = torch.tensor([2.0**24, 0.0, 0.0])
    scene = near.with_tensors({"means": 8 * near.means.round() + shift})
    scene = scene.with_tensors({"log_scales": torch.ones_like(near.log_scales)})
    eye, target = torch.tensor([[3.3, 0.0, -60.0], [0.0, 0.0, 0.0]]).double() + shift.double()
    camera = Cameras(
        viewmats=look_at(eye[None], target[None], torch.tensor([0.0, -1.0, 0.0]).double()),
        Ks=torch.tensor([[[30.0, 0.0, 16.0], [0.0, 30.0, 16.0], [0.0, 0.0, 1.0]]]).double(),
        width=32,
        height=32,
    )
    image = render(scene, camera).rgb[0]
    assert float(image.amax()) > 0.1
    assert float(linear_view(scene, camera, image).residual.abs().amax()) < 1e-4


def test_frozen_gaussians_keep_their_colours_and_the_others_make_up_for_them() -> None:
    scene = random_scene(40, degree=1, size=0.3)
    views = observe(scene, ring(3))
    gray = scene.with_tensors(sh0=torch.zeros_like(scene.sh0))
    found = fit_colors(gray, views, config=MatchConfig(color_iterations=4), frozen=20)
    assert same_bits(found[:20], gray[:20])
    assert bool((found.sh0[20:] != gray.sh0[20:]).any())
    errors = [mean_squared_error(one, views) for one in (gray, found)]
    assert errors[1] < 0.8 * errors[0]


def test_frozen_gaussians_keep_their_opacities() -> None:
    scene, cameras = random_scene(40, degree=0, size=0.3), ring(2)
    config = MatchConfig(opacity_rounds=1)
    found = match_opacities(scene, cameras, torch.full((40,), 5.0), config=config, frozen=20)
    assert same_bits(found[:20], scene[:20])
    assert bool((found.logit_opacities[20:] != scene.logit_opacities[20:]).all())
