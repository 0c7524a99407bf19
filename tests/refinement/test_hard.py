"""Refinement of hard scenes: hidden, invalid, single, infinite; gradients that are not finite."""

import math
from functools import partial
from importlib import import_module

import numpy as np
import pytest
import torch

import cvtgs
from cvtgs.config import Rates
from cvtgs.edit import concatenate
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.parameters import LOGIT_LIMIT
from cvtgs.math.spherical_harmonics import SH_C0
from cvtgs.refinement import refine
from cvtgs.refinement.images import ImageBuffer
from cvtgs.refinement.optimize import SceneOptimizer
from cvtgs.rendering import choose_backend
from refine_cases import as_dtype, discolored, full_scene, quick, ring, small_scene
from scenes import random_scene, same_bits


def test_gaussians_that_no_view_shows_stay_bit_for_bit():
    full = full_scene()
    hidden = small_scene(full, 0.02)
    count = len(hidden)
    behind = hidden.with_tensors(
        {
            "means": torch.tensor([[-0.0, 0.0, -50.0]]).repeat(count, 1),
            "quats": 7 * hidden.quats,
            "logit_opacities": torch.full((count,), math.inf),
        },
        {},
    )
    seen = discolored(full)[count:]
    both = seen.with_tensors(
        {name: torch.cat([ours, behind.tensors()[name]]) for name, ours in seen.tensors().items()},
        {},
    )
    scene, report = refine(both, full, steps=20, cameras=ring(), config=quick())
    assert report.gain > 0
    assert 0 < report.changed_count <= len(seen)
    assert same_bits(scene[len(seen) :], behind)


def test_the_simplified_scene_comes_first():
    full = full_scene()
    found = "small must have at most as many Gaussians as full, found 500 and 10; the simplified"
    with pytest.raises(InvalidArgumentError, match=found):
        refine(full, small_scene(full, 0.02), steps=1, config=quick())


@pytest.mark.slow
def test_invalid_rows_stay_and_do_no_harm():
    full = full_scene()
    small = discolored(full)
    means, logits, scales = (
        tensor.clone() for tensor in (small.means, small.logit_opacities, small.log_scales)
    )
    means[0], logits[1], scales[2] = math.nan, math.nan, math.inf
    changes = {"means": means, "logit_opacities": logits, "log_scales": scales}
    small = small.with_tensors(changes, {})
    scene, report = refine(small, small_scene(full, 1.0), steps=20, config=quick())
    assert report.gain > 0
    rows = torch.arange(3)
    assert same_bits(scene.select(rows), small.select(rows))
    assert cvtgs.validity.invalid_rows(scene.select(torch.arange(3, 500))) == {}


@pytest.mark.parametrize("name", ["sh0", "shN"])
def test_a_colour_that_is_no_number_does_no_harm(monkeypatch, name):
    """The torch backend spreads it over a part of every image."""
    torch_backend = partial(choose_backend, "torch")
    module = import_module("cvtgs.rendering.render")
    monkeypatch.setattr(module, "choose_backend", lambda _, device: torch_backend(device))
    full = full_scene(60)
    colors = discolored(full).tensors()[name].clone()
    colors[7] = math.nan
    small = discolored(full).with_tensors({name: colors}, {})
    scene, report = refine(
        small, full, steps=10, cameras=ring(), config=quick(), frozen=3, device="cpu"
    )
    assert report.gain > 0
    assert same_bits(scene.select([0, 1, 2, 7]), small.select([0, 1, 2, 7]))
    assert report.changed_count == 56


@pytest.mark.slow
def test_invalid_rows_of_the_full_scene_are_left_out():
    full = full_scene()
    means = full.means.clone()
    means[:7] = math.nan
    broken = full.with_tensors({"means": means}, {})
    whole = full.select(torch.arange(7, 500))
    small = discolored(whole)
    first, second = (
        refine(small, one, steps=5, config=quick(), device="cpu") for one in (broken, whole)
    )
    assert same_bits(first.scene, second.scene)


@pytest.mark.slow
def test_gradients_that_are_not_finite_do_no_harm(monkeypatch):
    full = full_scene()
    module = import_module("cvtgs.refinement.optimize")
    honest, calls = module.relative_loss, []

    def sometimes_nan(image, target, **weights):
        calls.append(1)
        return honest(image, target, **weights) * (math.nan if len(calls) % 2 else 1.0)

    monkeypatch.setattr(module, "relative_loss", sometimes_nan)
    scene, report = refine(discolored(full), full, steps=40, config=quick())
    assert report.gain > 0.5
    assert cvtgs.validity.invalid_rows(scene) == {}


def test_rho_1_is_perfect_already():
    full = full_scene()
    small = small_scene(full, 1.0)
    refined = refine(small, full, steps=50, config=quick())
    assert refined.scene is small
    assert (refined.report.stopped, refined.report.steps) == ("perfect", 0)
    assert refined.report.psnr_after == 60


@pytest.mark.slow
def test_a_single_gaussian():
    full = full_scene()
    refined = refine(small_scene(full, 1e-9), full, steps=20, config=quick())
    assert len(refined.scene) == 1
    assert refined.report.gain >= 0


@pytest.mark.long
@pytest.mark.parametrize("kind", [kind for kind in cvtgs.synthetic.KINDS if kind != "object"])
def test_other_kinds_of_scenes(kind):
    full = cvtgs.synthetic.scene(kind, 800, sh_degree=0, seed=1)
    assert refine(small_scene(full), full, steps=10, config=quick()).report.gain >= 0


@pytest.mark.long
def test_antialiased_scenes_are_rendered_antialiased():
    full = full_scene()
    object.__setattr__(full, "comments", ("SplatRenderMode: mip",))
    small = small_scene(full, 0.3)
    assert small.antialiased
    tagged = refine(discolored(small), full, steps=20, config=quick())
    assert tagged.scene.antialiased
    assert tagged.report.gain > 0
    plain = full_scene()
    untagged = refine(discolored(small_scene(plain, 0.3)), plain, steps=20, config=quick())
    assert untagged.report.psnr_before != tagged.report.psnr_before


@pytest.mark.long
@pytest.mark.parametrize("other", [torch.float32, torch.float64])
def test_float64_stays_float64(other):
    full = full_scene(200)
    small = as_dtype(discolored(full), torch.float64)
    scene, report = refine(small, as_dtype(full, other), steps=40, config=quick())
    assert scene.dtype == torch.float64
    assert report.gain > 0


@pytest.mark.slow
def test_infinite_logits():
    full = full_scene()
    logits = full.logit_opacities.clone()
    logits[::3], logits[1::3] = math.inf, -math.inf
    hard = full.with_tensors({"logit_opacities": logits}, {})
    scene, report = refine(discolored(hard), hard, steps=30, config=quick())
    assert report.gain > 0
    changed = (scene.sh0 != discolored(hard).sh0).flatten(1).any(dim=1)
    assert float(scene.logit_opacities[changed].abs().amax()) <= LOGIT_LIMIT + 1e-5
    assert torch.equal(scene.logit_opacities[~changed], logits[~changed])


def refined_beside_nothing(*, stray=0, seed=0):
    """Return a full scene, a small one, and its refinement by 120 short steps.

    With images of 48 pixels, steps of the usual length do not converge. Stray Gaussians, black
    and nearly opaque, are added where the full scene is empty.
    """
    full = random_scene(1500, degree=0, size=0.1)
    small = small_scene(full, 0.05)
    if stray:
        some = small.select(torch.arange(stray))
        directions = torch.nn.functional.normalize(some.means - small.means.mean(dim=0), dim=1)
        around = 1.5 * (full.means - full.means.mean(dim=0)).norm(dim=1).amax()
        black = some.with_tensors(
            means=full.means.mean(dim=0) + around * directions,
            logit_opacities=torch.full_like(some.logit_opacities, 2.0),
            sh0=torch.full_like(some.sh0, -0.5 / SH_C0),
        )
        small = concatenate([small, black])
    rates = Rates(means=0.02, quats=0.008, log_scales=0.01)
    config = quick(size=48, heldout=12, patience=100, rates=rates)
    return full, small, refine(small, full, steps=120, config=config, seed=seed).scene


def alphas_of(*scenes):
    """Return their alphas in views of the first scene, and the mask of its empty pixels."""
    views = cvtgs.views.automatic_views(scenes[0], 4, width=48, height=48, seed=3)
    alphas = [cvtgs.render(scene, views).alpha for scene in scenes]
    empty = alphas[0] < 1e-3
    assert int(empty.sum()) > 1000
    return alphas, empty


@pytest.mark.long
@pytest.mark.xfail(strict=True, reason="steps in own frames paint 4 % more into what was empty")
def test_an_empty_background_stays_empty():
    (_, before, after), empty = alphas_of(*refined_beside_nothing())
    assert after[empty].mean() < before[empty].mean()


@pytest.mark.long
@pytest.mark.xfail(strict=True, reason="paint beside the scene grows by 8 % on balanced cells")
def test_an_empty_background_stays_nearly_empty():
    """The mean of three sets of views: one alone is too noisy for a bound of a twentieth."""
    paint, errors = [], []
    for seed in range(3):
        (wanted, before, after), empty = alphas_of(*refined_beside_nothing(seed=seed))
        paint.append(after[empty].mean() / before[empty].mean())
        errors.append((after - wanted).square().mean() / (before - wanted).square().mean())
    assert torch.stack(paint).mean() < 1.05
    assert max(errors) < 1.0


@pytest.mark.long
def test_random_backgrounds_take_black_paint_from_an_empty_background(monkeypatch):
    """Over black alone, black opaque Gaussians cost nothing."""
    full, small, refined = refined_beside_nothing(stray=20)
    black = lambda self, count: self._full.means.new_zeros(count, 3)  # noqa: E731
    monkeypatch.setattr(ImageBuffer, "draw_backgrounds", black)
    _, _, over_black = refined_beside_nothing(stray=20)
    (_, before, after, black), empty = alphas_of(full, small, refined, over_black)
    assert after[empty].mean() < 0.95 * black[empty].mean()
    assert after[empty].mean() < before[empty].mean()


@pytest.mark.parametrize("log_scale", [44.5, 88.0, 88.7])
def test_huge_gaussians_have_finite_units(log_scale):
    scene = small_scene(full_scene())
    log_scales = scene.log_scales.clone()
    log_scales[0] = torch.tensor([log_scale, 0.0, log_scale])
    optimizer = SceneOptimizer(
        scene.with_tensors({"log_scales": log_scales}),
        quick().rates,
        learning_rate_scale=torch.ones(len(scene)),
    )
    assert all(tensor.isfinite().all() for tensor in optimizer.scene().tensors().values())


@pytest.mark.slow
def test_seeds_and_steps_are_whole_numbers_of_any_type():
    full = full_scene()
    small = discolored(full)
    options = {"steps": 2, "config": quick(), "device": "cpu"}
    wanted = refine(small, full, seed=3, **options).scene
    numbers = {"seed": np.int64(3), "steps": np.int64(2)}
    assert same_bits(refine(small, full, **options | numbers).scene, wanted)
    for seed in (None, 0.5, "0"):
        with pytest.raises(
            InvalidArgumentError, match=f"seed must be a whole number, found {seed!r}"
        ):
            refine(small, full, seed=seed, **options)
    for frozen in (None, 0.5, -1):
        with pytest.raises(
            InvalidArgumentError, match=f"frozen must be .* between 0 .* found {frozen}"
        ):
            refine(small, full, frozen=frozen, **options)
