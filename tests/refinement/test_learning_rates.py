"""The steps of a refinement: the learning rate scale of each Gaussian, and finite steps."""

import math

import pytest
import torch

from cvtgs import GaussianScene, concatenate
from cvtgs.analysis import ambient_visibility
from cvtgs.config import Rates
from cvtgs.math.frames import robust_frame
from cvtgs.refinement import refine
from cvtgs.refinement.optimize import SceneOptimizer, learning_rate_scales
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
    torch.testing.assert_close(learning_rate_scales(full, twice), 0.5 * visibility_of(full))


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
    torch.testing.assert_close(learning_rate_scales(changed, full), 0.25 * visibility_of(changed))


@pytest.mark.parametrize(("copies", "share"), [(2, 0.5), (4, 0.75), (10, 0.9)])
def test_changed_gaussians_move_less_the_fewer_they_represent(copies, share):
    full = full_scene(200)
    changed = full.with_tensors({"sh0": full.sh0 + 1e-3}, {})
    several = full.select(torch.arange(200).repeat(copies))
    factors = learning_rate_scales(changed, several)
    torch.testing.assert_close(factors, share * visibility_of(changed))


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
    factors = learning_rate_scales(changed, both) / visibility_of(changed)
    assert 0.25 <= float(factors.max()) < 0.3


def test_gaussians_that_cannot_be_rendered_do_not_move():
    full = random_scene(50)
    means = full.means.clone()
    means[3], means[7] = math.nan, 0.1
    factors = learning_rate_scales(full.with_tensors({"means": means}, {}), full)
    assert factors[3] == 0.0
    assert factors[7] > 0.0


@pytest.mark.slow
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
