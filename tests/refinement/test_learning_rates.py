"""The steps of a refinement: the learning-rate scale of each Gaussian, and how far it moves."""

import math

import pytest
import torch

from cvtgs import GaussianScene, concatenate
from cvtgs.analysis import ambient_visibility
from cvtgs.config import Rates
from cvtgs.math import parameters
from cvtgs.math.frames import robust_frame
from cvtgs.refinement import optimize, refine
from cvtgs.refinement.optimize import SceneOptimizer, learning_rate_scales
from cvtgs.refinement.refine import changed_count
from refine_cases import as_dtype, discolored, full_scene, quick, small_scene
from scenes import random_scene, same_bits


def with_one_far_away(scene: GaussianScene, one: GaussianScene) -> GaussianScene:
    """Return the scene with one more Gaussian that has nothing around it."""
    tensors = one.with_tensors({"means": one.means + 1e3}, {}).tensors()
    return GaussianScene(
        **{name: torch.cat([values, tensors[name]]) for name, values in scene.tensors().items()}
    )


def visibility_of(scene: GaussianScene) -> torch.Tensor:
    return ambient_visibility(scene.means, scene.masses, robust_frame(scene.means)).float()


def size_factors_of(scene: GaussianScene) -> torch.Tensor:
    """Twice the upper quartile of the largest standard deviations, over each one's, at most 1."""
    sizes = scene.log_scales.amax(dim=1).exp()
    return (2.0 * sizes.sort().values[-(-3 * len(sizes) // 4) - 1] / sizes).clamp_max(1.0)


def freedom_of(scene: GaussianScene) -> torch.Tensor:
    return visibility_of(scene) * size_factors_of(scene)


def test_gaussians_that_represent_only_themselves_do_not_move():
    full, one = full_scene(300), full_scene(1, seed=1)
    small = with_one_far_away(full.select(torch.arange(40)), one)
    factors = learning_rate_scales(small, with_one_far_away(full, one))
    assert factors[-1] == 0.0
    assert float(factors[:-1].median()) > 0.1  # pruned: they represent others, too


def test_copies_of_a_gaussian_share_its_learning_rate():
    full = full_scene(300)
    twice = full.select(torch.arange(300).repeat(2))
    assert not learning_rate_scales(full, full).any()
    torch.testing.assert_close(learning_rate_scales(full, twice), 0.5 * freedom_of(full))


@pytest.mark.parametrize("name", ["log_scales", "logit_opacities", "sh0"])
def test_exact_gaussians_at_one_position_do_not_move(name):
    full = full_scene(100)
    other = full.with_tensors({name: full.tensors()[name] - 1.0}, {})
    both = concatenate([full, other, full])  # also two of each that are equal
    assert not learning_rate_scales(both, both).any()
    order = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    assert not learning_rate_scales(both.select(order), both).any()


@pytest.mark.parametrize("name", ["means", "log_scales", "logit_opacities", "sh0"])
def test_changed_gaussians_move_in_proportion_to_their_visibility(name):
    full = full_scene(300)
    changed = full.with_tensors({name: full.tensors()[name] + 1e-3}, {})
    # each represents one Gaussian, so it is nearly right
    torch.testing.assert_close(learning_rate_scales(changed, full), 0.25 * freedom_of(changed))


@pytest.mark.parametrize(("copies", "share"), [(2, 0.5), (4, 0.75), (10, 0.9)])
def test_changed_gaussians_move_less_the_fewer_they_represent(copies, share):
    full = full_scene(200)
    changed = full.with_tensors({"sh0": full.sh0 + 1e-3}, {})
    several = full.select(torch.arange(200).repeat(copies))
    factors = learning_rate_scales(changed, several)
    torch.testing.assert_close(factors, share * freedom_of(changed))


def test_one_heavy_gaussian_among_light_ones_counts_as_few():
    full = full_scene(200)
    changed = full.with_tensors({"sh0": full.sh0 + 1e-3}, {})
    light = full.with_tensors({"logit_opacities": torch.full_like(full.logit_opacities, -9.0)}, {})
    both = GaussianScene(
        **{
            name: torch.cat([values, *3 * [light.tensors()[name]]])
            for name, values in full.tensors().items()
        }
    )
    factors = learning_rate_scales(changed, both) / freedom_of(changed)
    assert 0.25 <= float(factors.max()) < 0.3


def test_gaussians_that_are_large_for_the_scene_move_less():
    full = full_scene(200)
    log_scales = full.log_scales.sub(0.001)  # changed, so each moves at a quarter
    log_scales[:4, 0] = torch.tensor([3.0, 5.0, 100.0, math.inf])
    scene = full.with_tensors({"log_scales": log_scales}, {})
    with_one_invalid = learning_rate_scales(scene, full)
    assert with_one_invalid[3] == 0.0
    valid = scene.select(torch.arange(200) != 3)
    factors = learning_rate_scales(valid, full)
    torch.testing.assert_close(with_one_invalid[torch.arange(200) != 3], factors)
    nearly = factors / visibility_of(valid).clamp_min(1e-6)
    assert float(nearly[0] / nearly[1]) == pytest.approx(math.exp(2.0), rel=1e-3)
    assert float(nearly[2]) < 1e-30
    assert float(nearly[4:].median()) == pytest.approx(0.25, rel=0.2)


def test_sizes_of_exact_gaussians_do_not_count_among_those_of_the_scene():
    """Large exact ones would raise the limit for all others."""
    full = full_scene(100)
    exact = full_scene(300, seed=1).with_tensors({"means": full_scene(300, seed=1).means + 50.0})
    exact = exact.with_tensors({"log_scales": exact.log_scales + 3.0})
    changed = full.with_tensors({"sh0": full.sh0 + 1e-3})
    log_scales = changed.log_scales.clone()
    log_scales[0] = log_scales.amax() + 2.0
    changed = changed.with_tensors({"log_scales": log_scales})
    alone = learning_rate_scales(changed, full)
    beside = learning_rate_scales(concatenate([changed, exact]), concatenate([full, exact]))
    assert not beside[100:].any()
    ratio = float(alone[0] / alone[1:].median())
    assert 0.0 < ratio < 0.6
    assert float(beside[0] / beside[1:100].median()) == pytest.approx(ratio, rel=0.5)


def test_gaussians_that_cannot_be_rendered_do_not_move():
    full = random_scene(50)
    means = full.means.clone()
    means[3], means[7] = math.nan, 0.1
    factors = learning_rate_scales(full.with_tensors({"means": means}, {}), full)
    assert factors[3] == 0.0
    assert factors[7] > 0.0


@pytest.mark.long
def test_refinement_moves_merged_gaussians_but_not_exact_ones():
    full = full_scene(500)
    small = discolored(small_scene(full, 0.5), 0.5)
    exact = (small.means[:, None] == full.means).all(dim=2).any(dim=1)
    sh0 = torch.where(exact[:, None, None], small.sh0 - 0.5, small.sh0)
    small = small.with_tensors({"sh0": sh0}, {})
    free = learning_rate_scales(small, full) > 0
    scene, report = refine(small, full, steps=40, config=quick())
    assert 0 < int((~free).sum()) < len(small)
    assert same_bits(scene.select(~free), small.select(~free))
    assert report.changed_count > 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1e-44, 1e-30, 1e25, 3e38, 1e300])
def test_gradients_of_any_size_give_finite_steps(dtype, size):
    scene = as_dtype(random_scene(2, degree=0), dtype)
    scale = torch.ones(2, dtype=dtype)
    optimizer = SceneOptimizer(scene, Rates(sh0=0.25), learning_rate_scale=scale)
    size = min(size, torch.finfo(dtype).max)
    for sign in (1, -1, 1, 1):
        optimizer.step(sign * size * optimizer.scene().sh0[0, 0, 0], factor=1.0)
    moved = (optimizer.scene().sh0 - scene.sh0).detach()
    assert bool(moved.isfinite().all())
    assert float(moved.abs().amax()) <= 4 * 0.25
    assert not moved[1].any()


def shortening(gradients: torch.Tensor) -> torch.Tensor:
    """Factors of a first step: gradients over themselves plus a share of their root mean square."""
    return gradients / (gradients + 0.01 * gradients.square().mean().sqrt())


def test_a_step_is_the_rate_times_the_scale_of_the_gaussian():
    scene = random_scene(4, degree=0)
    scale = torch.tensor([1.0, 1.0, 0.5, 0.0])
    optimizer = SceneOptimizer(scene, Rates(sh0=0.25, means=0.5), learning_rate_scale=scale)
    now = optimizer.scene()
    optimizer.step(now.sh0[:, 0, 0].sum() - 3 * now.means[1, 2], factor=0.5)
    found = optimizer.result()
    moved = scene.sh0.clone()
    moved[:, 0, 0] -= 0.125 * scale * shortening(scale)
    torch.testing.assert_close(found.sh0, moved)
    axes = scene.scales[1].clamp_min(0.1 * float(scene.scales[1].mean()))
    along = parameters.rotation_matrices(scene.quats)[1].T @ (found.means - scene.means)[1]
    shortened = float(shortening(torch.tensor([0.0, 1.0, 0.0, 0.0]))[1])
    torch.testing.assert_close(along.abs(), 0.25 * shortened * axes, rtol=1e-4, atol=1e-6)
    assert float((found.means - scene.means)[1, 2]) > 0
    torch.testing.assert_close(found.log_scales, scene.log_scales)


def test_a_disc_tilts_less_than_it_turns_and_moves_less_across_than_along():
    """Axes of 1, 1 and 0.2: a tilt by 0.01 of a turn's unit is 0.2 / (1 - 0.04) of it."""
    scene = random_scene(1, degree=0)
    scene = scene.with_tensors({"log_scales": torch.tensor([[1.0, 1.0, 0.2]]).log()}, {})
    rates = Rates(means=0.02, quats=0.01)
    optimizer = SceneOptimizer(scene, rates, learning_rate_scale=torch.ones(1))
    now = optimizer.scene()
    slopes = torch.tensor([1.0, 2, 3]), torch.tensor([1.0, -2, 3, 5])
    optimizer.step((now.means @ slopes[0] + now.quats @ slopes[1]).sum(), factor=1.0)
    found = optimizer.scene()
    start = parameters.normalize_quats(scene.quats)
    back = start * torch.tensor([1.0, -1, -1, -1])
    turned = parameters.multiply_quats(back, found.quats)[0, 1:].abs()
    alone = float(shortening(torch.ones(1)))
    torch.testing.assert_close(turned, alone * 0.01 * torch.tensor([0.2 / 0.96, 0.2 / 0.96, 1]))
    moved = parameters.rotation_matrices(scene.quats)[0].T @ (found.means - scene.means)[0]
    torch.testing.assert_close(moved.abs(), alone * 0.02 * torch.tensor([1.0, 1, 0.2]))


def test_rows_without_a_gradient_keep_their_bits_and_their_momentum():
    scene = random_scene(5)
    optimizer = SceneOptimizer(scene, Rates(), learning_rate_scale=torch.ones(len(scene)))
    optimizer.step(optimizer.scene().sh0[0].sum(), factor=1.0)
    before = optimizer.result()
    optimizer.step(optimizer.scene().sh0[1].sum(), factor=1.0)
    after = optimizer.result()
    assert same_bits(before.select(torch.tensor([0])), after.select(torch.tensor([0])))
    rest = torch.tensor([2, 3, 4])
    assert same_bits(after.select(rest), scene.select(rest))
    assert changed_count(scene, after) == 2


def test_gaussians_that_images_hardly_show_move_less():
    scene = random_scene(3, degree=0)
    optimizer = SceneOptimizer(scene, Rates(sh0=0.25), learning_rate_scale=torch.ones(3))
    strengths = torch.tensor([1.0, 0.1, 1e-5])
    optimizer.step((strengths[:, None, None] * optimizer.scene().sh0).sum(), factor=1.0)
    moved = (scene.sh0 - optimizer.result().sh0)[:, 0, 0]
    torch.testing.assert_close(moved, 0.25 * shortening(strengths), rtol=1e-3, atol=1e-6)
    assert float(moved[2] / moved[0]) < 0.01


def test_a_gaussian_that_is_first_shown_late_moves_as_far_as_others_at_first():
    scene = random_scene(2, degree=0)
    optimizer = SceneOptimizer(scene, Rates(sh0=0.25), learning_rate_scale=torch.ones(2))
    optimizer.step(optimizer.scene().sh0[0].sum(), factor=1.0)
    first = float((scene.sh0 - optimizer.result().sh0)[0, 0, 0])
    for _ in range(40):
        optimizer.step(optimizer.scene().sh0[0].sum(), factor=1.0)
    optimizer.step(optimizer.scene().sh0[1].sum(), factor=1.0)
    late = float((scene.sh0 - optimizer.result().sh0)[1, 0, 0])
    assert late == pytest.approx(first, rel=0.1)  # 2.3 times, with one count for all


def test_a_row_with_one_bad_gradient_is_left_alone():
    scene = random_scene(3)
    optimizer = SceneOptimizer(scene, Rates(), learning_rate_scale=torch.ones(len(scene)))
    now = optimizer.scene()
    weights = torch.tensor([[1.0, 1, 1], [1, math.nan, 1], [math.inf, 1, 1]])
    optimizer.step((now.means * weights).sum() + now.sh0.sum(), factor=1.0)
    found = optimizer.result()
    rest = torch.tensor([1, 2])
    assert same_bits(found.select(rest), scene.select(rest))
    assert changed_count(scene, found) == 1


def test_rows_that_leave_the_valid_range_are_restored():
    scene = random_scene(3)
    optimizer = SceneOptimizer(
        scene, Rates(log_scales=1e6), learning_rate_scale=torch.ones(len(scene))
    )
    optimizer.step(-optimizer.scene().log_scales[1].sum(), factor=1.0)
    assert same_bits(optimizer.result(), scene)


def test_a_loss_without_gradients_changes_nothing():
    scene = random_scene(3)
    optimizer = SceneOptimizer(scene, Rates(), learning_rate_scale=torch.ones(len(scene)))
    optimizer.step(torch.tensor(1.0), factor=1.0)
    optimizer.step(optimizer.scene().sh0.sum() * 0, factor=1.0)
    assert same_bits(optimizer.result(), scene)


def test_the_upper_quartile_of_five_sizes_is_the_fourth():
    sizes = torch.tensor([0.0, 1.0, 2.0, 3.0, 90.0])
    scene = random_scene(5, degree=0)
    scene = scene.with_tensors({"log_scales": sizes[:, None].expand(5, 3).contiguous()}, {})
    found = vars(optimize)["_size_factors"](scene, torch.ones(5, dtype=torch.bool))
    assert float(found[4].log()) == pytest.approx(math.log(optimize.LARGE) + 3 - 90)
