"""The losses that steps minimize, and the scores of validations."""

import math
import random
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

import cvtgs
from cvtgs.evaluation import psnr
from cvtgs.evaluation.scorer import MOST_PSNR, ViewImages
from cvtgs.losses import image_loss
from cvtgs.rendering import Rendering, render
from cvtgs.tags import ANTIALIASED
from cvtgs.train import LossConfig
from cvtgs.train.cases import render_targets
from cvtgs.train.losses import local_loss, scene_loss, validation_psnr, view_loss
from cvtgs.views import mixed_views
from mergenet_cases import lively_net
from train_cases import small_net, small_scene, some_case, some_views, tiny_config, tiny_data


def config_of(**loss):
    return tiny_config(tiny_data(cvtgs.__path__[0]), loss=LossConfig(**loss))


def images() -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    target = torch.rand(1, 16, 20, 3, generator=g)
    return target + 0.1 * torch.randn(1, 16, 20, 3, generator=g), target


def views_by(change: Callable[[torch.Tensor, torch.Tensor], object]) -> ViewImages:
    """Views of 4,000 Gaussians by cameras changed in place."""
    scene = small_scene(4000)
    cameras = mixed_views(scene, 2, size=32, seed=0)
    change(cameras.viewmats, cameras.Ks)
    images = render(scene, cameras)
    return ViewImages(cameras=cameras, rgb=images.rgb.half(), alpha=images.alpha.half())


def test_a_known_loss():
    """All pixels are off by a tenth: a squared error of a hundredth."""
    target = torch.full((1, 12, 12, 3), 0.25)
    config = LossConfig(mse_weight=2.0, image_weight=0.0)
    assert view_loss(target + 0.1, target, config).item() == pytest.approx(
        2 * math.log(0.01 + 1e-5), rel=1e-5
    )


def test_the_loss_of_equal_images_is_finite():
    target = torch.rand(1, 12, 12, 3, generator=torch.Generator().manual_seed(0))
    same = target.clone().requires_grad_()
    loss = view_loss(same, target, LossConfig(mse_weight=1.0, image_weight=1.0))
    assert loss.item() == pytest.approx(math.log(1e-5) + math.log(1e-3), abs=1e-2)
    loss.backward()
    assert bool(same.grad.isfinite().all())


def test_the_loss_is_the_weighted_sum_of_its_parts():
    image, target = images()
    error = (image - target).square().mean().item()
    other = image_loss(image, target).item()
    for squared, weight in ((0.5, 0.5), (1.0, 0.0), (0.0, 2.0), (0.0, 0.0)):
        loss = view_loss(image, target, LossConfig(mse_weight=squared, image_weight=weight)).item()
        wanted = squared * math.log(error + 1e-5) + weight * math.log(other + 1e-3)
        assert loss == pytest.approx(wanted, rel=1e-4)


def test_every_weight_of_images_counts():
    """The size of residuals alone has another place, :func:`_residual_penalty`."""
    image, target = images()
    usual = view_loss(image, target, LossConfig()).item()
    for name in sorted(LossConfig.model_fields.keys() - {"residual_weight"}):
        other = view_loss(image, target, LossConfig(**{name: 3.0})).item()
        assert other != usual, f"pass {name} in view_loss of train/losses.py"


def test_doubling_the_error_costs_the_same_at_any_error():
    image, target = images()
    config = LossConfig(mse_weight=1.0, image_weight=0.0)
    losses = [
        view_loss(target + factor * (image - target), target, config).item()
        for factor in (0.5, 1.0, 2.0, 4.0)
    ]
    steps = torch.tensor(losses).diff()
    torch.testing.assert_close(steps, torch.full((3,), math.log(4)), rtol=0, atol=2e-2)


@pytest.mark.slow
def test_an_untrained_network_has_the_loss_of_the_reference():
    """The same views over the same backgrounds, half of them black, cut the same way."""
    case, views, config = some_case(), some_views(size=40), config_of()
    found = scene_loss(small_net(), case, views, config=config, rng=random.Random(3))
    rng, losses = random.Random(3), []
    for _ in range(config.views.per_step):
        background = torch.tensor([rng.random() for _ in range(3)])
        background *= rng.random() >= 0.5
        camera = views.cameras.select(torch.tensor([rng.randrange(len(views.cameras))]))
        y, x = rng.randint(0, 40 - 32), rng.randint(0, 40 - 32)
        before, full = (
            render(scene, camera, background=background).rgb[:, y : y + 32, x : x + 32]
            for scene in (case.reference.merged, small_scene())
        )
        losses.append(view_loss(before, full, config.loss).item())
    assert found.item() == pytest.approx(sum(losses) / len(losses), abs=5e-3)


@pytest.mark.parametrize("kind", ["scene", "local"])
@pytest.mark.slow
def test_the_loss_depends_only_on_the_seed(kind, monkeypatch):
    """Over coloured backgrounds only: over black, two seeds may choose the same image."""
    monkeypatch.setattr("cvtgs.train.losses.BLACK_SHARE", 0.0)
    case, views, config = some_case(), some_views(), config_of()

    def loss(seed: int) -> float:
        rng = random.Random(seed)
        if kind == "local":
            return local_loss(small_net(), case, config=config, rng=rng).item()
        return scene_loss(small_net(), case, views, config=config, rng=rng).item()

    assert loss(0) == loss(0)
    assert len({loss(seed) for seed in range(4)}) == 4


@pytest.mark.parametrize("size", [32, 40])
def test_the_network_is_given_sizes_in_pixels_of_the_images(size):
    case, seen, net = some_case(), [], small_net()
    net.register_forward_hook(lambda net, args, result: seen.append(args[0].cells))
    scene_loss(net, case, some_views(size=size), config=config_of(), rng=random.Random(0))
    found = torch.cat(seen)[:, -1].sort().values
    every = (case.descriptors.cells[:, -1] + 0.3 * math.log(size / 400)).sort().values
    distances = (found[:, None] - every).abs().amin(dim=1)
    assert len(found) > 5
    assert float(distances.amax()) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(("tagged", "share"), [(True, 0.5), (False, 0.25)])
def test_half_of_the_images_of_a_tagged_scene_ignore_the_tag(tagged, share, monkeypatch):
    """Of the four images of this scene, one ignores it."""
    seen: list[bool] = []

    def watched(scene, cameras, **options):
        seen.extend(cameras.ignores_tag)
        return Rendering(
            rgb=torch.zeros(1, 32, 32, 3), alpha=torch.zeros(1, 32, 32), depth=None, backend=""
        )

    monkeypatch.setattr("cvtgs.train.losses.render", watched)
    case, views = some_case(), render_targets(small_scene(), 4, size=32, seed=0)
    merged = replace(case.reference.merged, comments=(ANTIALIASED.text,) if tagged else ())
    case = replace(case, reference=case.reference._replace(merged=merged))
    assert sum(views.cameras.ignores_tag) == 1
    for seed in range(50):
        scene_loss(small_net(), case, views, config=config_of(), rng=random.Random(seed))
    assert sum(seen) / len(seen) == pytest.approx(share, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("length", [1, 40, 200])
def test_chunks_of_the_network_change_neither_loss_nor_gradient(length, monkeypatch):
    case, views, config = some_case(), some_views(), config_of(residual_weight=1.0)

    def loss_and_gradients() -> tuple[float, list[torch.Tensor]]:
        net = lively_net(torch.float32)
        loss = scene_loss(net, case, views, config=config, rng=random.Random(0))
        loss.backward()
        return loss.item(), [values.grad for values in net.parameters()]

    loss, gradients = loss_and_gradients()
    monkeypatch.setattr("cvtgs.train.losses.CHUNK_MEMBERS", length)
    in_chunks, others = loss_and_gradients()
    assert in_chunks == pytest.approx(loss, rel=1e-5)
    torch.testing.assert_close(others, gradients, rtol=1e-3, atol=1e-5)


def test_only_cells_that_are_seen_are_corrected(monkeypatch):
    """The loss and its gradient are those of a correction of all cells.

    The network is as moderate as a trained one, so that hardly any cell grows into an image.
    """
    case, config, rows = some_case(4000, ratio=0.1), config_of(), []
    views = views_by(lambda viewmats, intrinsics: intrinsics[:, :2, :2].mul_(4.0))

    def loss_and_gradients() -> tuple[float, list[torch.Tensor]]:
        net = lively_net(torch.float32)
        with torch.no_grad():
            for layer in (net.decoder, net.member_gates.gates, net.pair_gates.gates):
                for values in layer.parameters():
                    values.mul_(0.25)
        net.register_forward_hook(lambda net, args, result: rows.append(len(args[0])))
        loss = scene_loss(net, case, views, config=config, rng=random.Random(0))
        loss.backward()
        return loss.item(), [values.grad for values in net.parameters()]

    loss, gradients = loss_and_gradients()
    monkeypatch.setattr("cvtgs.train.losses.LEAST_PAINTED", -1.0)
    of_all, others = loss_and_gradients()
    assert rows[0] < 0.8 * rows[1] == 0.8 * len(case.cells)
    assert loss == pytest.approx(of_all, abs=5e-4)
    ours, theirs = (torch.cat([part.flatten() for part in parts]) for parts in (gradients, others))
    assert torch.cosine_similarity(ours, theirs, dim=0).item() > 0.999


def test_views_that_show_nothing_can_be_compared():
    net = lively_net(torch.float32)
    views = views_by(lambda viewmats, intrinsics: viewmats[:, 2, 3].fill_(-100.0))
    assert not views.alpha.any()
    loss = scene_loss(net, some_case(4000), views, config=config_of(), rng=random.Random(0))
    loss.backward()
    assert math.isfinite(loss.item())
    assert all(bool((values.grad == 0).all()) for values in net.parameters())


@pytest.mark.parametrize("kind", ["scene", "local"])
@pytest.mark.slow
def test_residuals_are_penalized(kind):
    case, views, net = some_case(), some_views(), lively_net(torch.float32)

    def loss(residual: float) -> float:
        config, rng = config_of(residual_weight=residual), random.Random(0)
        if kind == "local":
            return local_loss(net, case, config=config, rng=rng).item()
        return scene_loss(net, case, views, config=config, rng=rng).item()

    price = loss(2.0) - loss(0.0)
    assert 0 < price <= 2
    if kind == "scene":
        cost = net(case.seen_by(views.cameras).descriptors).cost().item()
        assert price == pytest.approx(2 * cost, rel=1e-4)


@pytest.mark.parametrize("kind", ["scene", "local"])
@pytest.mark.slow
def test_gradients_reach_the_last_layers_of_a_new_network(kind):
    """They start at zero, and no layer below them can change before they do."""
    case, views, net, config = some_case(), some_views(), small_net(), config_of()
    rng = random.Random(0)
    if kind == "local":
        local_loss(net, case, config=config, rng=rng).backward()
    else:
        scene_loss(net, case, views, config=config, rng=rng).backward()
    moved = {
        name.split(".")[0]
        for name, values in net.named_parameters()
        if values.grad is not None and bool((values.grad != 0).any())
    }
    assert moved == {"decoder", "member_gates", "pair_gates"}
    assert all(bool(values.grad.isfinite().all()) for values in net.parameters())


def test_a_local_step_takes_no_more_cells_than_there_are():
    case = some_case().select(torch.arange(3))
    loss = local_loss(small_net(), case, config=config_of(), rng=random.Random(0))
    assert math.isfinite(loss.item())


@pytest.mark.slow
def test_an_untrained_network_gains_nothing():
    before, after = validation_psnr(small_net(), some_case(), some_views())
    assert before == after
    assert 5 < before < 60


@pytest.mark.slow
def test_validation_psnr_is_that_of_the_images_over_grey():
    case, views, net = some_case(), some_views(), lively_net(torch.float32)
    before, after = validation_psnr(net, case, views)
    grey = torch.full((3,), 0.5)
    wanted = render(small_scene(), views.cameras, background=grey).rgb
    with torch.no_grad():
        corrected = case.correct_scene(net(case.seen_by(views.cameras).descriptors))
    for scene, found in ((case.reference.merged, before), (corrected, after)):
        rendered = render(scene, views.cameras, background=grey).rgb
        assert found == pytest.approx(psnr(rendered, wanted).mean().item(), abs=0.02)
    assert abs(after - before) > 0.005


def test_a_view_that_shows_nothing_leaves_the_gain_of_the_others():
    def turn_one_away(viewmats: torch.Tensor, Ks: torch.Tensor) -> None:  # noqa: N803
        viewmats[1] = torch.diag(viewmats.new_tensor([-1, 1, -1, 1])) @ viewmats[1]

    case, views, net = some_case(), views_by(turn_one_away), lively_net(torch.float32)
    assert views.alpha.flatten(1).any(dim=1).tolist() == [True, False]
    before, after = validation_psnr(net, case, views)
    alone = validation_psnr(net, case, views.select(0))
    assert (before, after) == pytest.approx([(MOST_PSNR + one) / 2 for one in alone])
    assert after != before


@pytest.mark.slow
def test_validation_psnr_leaves_no_gradient():
    net = lively_net(torch.float32)
    validation_psnr(net, some_case(), some_views())
    assert all(values.grad is None for values in net.parameters())
