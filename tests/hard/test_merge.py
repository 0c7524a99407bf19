"""Merging given cells of hard scenes with and without a network, and network gradients."""

import math
from copy import deepcopy

import pytest
import torch

import oracles
from cvtgs import render
from cvtgs.cells import Partition, merge_cells
from cvtgs.config import SimplifyConfig
from cvtgs.mergenet import PublishedMergeNet, load_checkpoint, summarize
from hard_cases import CASES, each_case
from hard_scenes import DEVICES, PRESETS, dtypes, valid_case
from mergenet_cases import Case, are_corrected, case_of, features_of, lively_net
from render_cases import around
from scenes import assert_same_gaussians, assert_standard, covariances_of, moved, oracle_rows

COUNT = 60
EPSILON = {torch.float32: 1.2e-7, torch.float64: 2.3e-16}


def labels_of(scene):
    """Return labels of cells of four unrelated rows, and of two cells of one row."""
    labels = torch.arange(len(scene)) // 4
    labels[:2] = labels[-1] + 1 + torch.arange(2)[: len(scene)]
    return torch.unique(labels, return_inverse=True)[1].to(scene.device)


def merged(scene, config):
    labels = labels_of(scene)
    return merge_cells(scene, Partition.from_labels(labels, int(labels.amax()) + 1), config=config)


def case_of_cells(scene, device) -> Case:
    case = case_of(scene.to("cpu"), labels_of(scene).cpu())
    if device == "cpu":
        return case
    part = case.part.to(torch.device(device))
    there = case.neighbors.to(device), case.visibility.to(device)
    return Case(scene.to(device), case.merged.to(device), part, *there, case.pixel_size)


@dtypes
@each_case
@pytest.mark.slow
def test_each_case_without_a_network(make, dtype, subtests):
    scene = valid_case(make, COUNT, dtype)
    bounded = scene if make is not CASES["far_flyaways"] else CASES["flyaways"](COUNT, dtype)
    for preset in PRESETS:
        config = SimplifyConfig.from_preset(preset).merge
        for device in DEVICES:
            with subtests.test("cells equal the oracle", device=device, preset=preset):
                check_that_cells_equal_the_oracle(make, bounded.to(device), config)
            with subtests.test("merged cells are standard", device=device, preset=preset):
                check_that_merged_cells_are_standard(scene.to(device), config)
        with subtests.test("the order of members changes nothing", preset=preset):
            check_that_the_order_of_members_changes_nothing(scene, config)
        if dtype == torch.float64:
            with subtests.test("moments move with the scene", preset=preset):
                check_that_moments_move_with_the_scene(scene, config)


def check_that_cells_equal_the_oracle(make, scene, config):
    """Compare to the precision of the dtype, relative to positions, cell size and colours.

    The oracle computes areas from eigenvalues, so it is accurate to 1e-4 for needles only, and
    fails for cells of 1e30.
    """
    small, labels = merged(scene, config).to("cpu"), labels_of(scene).cpu()
    scene, matrices = scene.to("cpu"), covariances_of(small)
    epsilon = EPSILON[scene.dtype]
    tolerance = 200 * epsilon + 2e-12  # eigenvalues are floored at 1e-12 of the largest
    tolerance += 1e-4 * (make.__name__ == "needles")
    for cell in range(len(small)):
        rows = (labels == cell).nonzero()[:, 0].tolist()
        wanted = oracles.merge(
            oracle_rows(scene, rows),
            area_power=config.area_power,
            opacity=config.opacity,
            antialiased=scene.antialiased,
        )
        size = math.sqrt(float(wanted.covariance.max()))
        place = tolerance * size + epsilon * float(scene.means[rows].abs().amax())
        assert small.means[cell].tolist() == pytest.approx(wanted.mean, abs=place)
        worst = (matrices[cell] - torch.from_numpy(wanted.covariance)).abs().amax()
        assert float(worst) <= 3 * tolerance * size * size * max(1, abs(math.log(size)))
        opacity = float(torch.sigmoid(small.logit_opacities[cell].double()))
        if len(rows) > 1:
            assert opacity == pytest.approx(wanted.opacity, rel=1e-3, abs=2e-6)
        bound = tolerance * (1 + float(abs(wanted.sh).max()))
        torch.testing.assert_close(
            small.sh[cell].double(), torch.from_numpy(wanted.sh), rtol=tolerance, atol=bound
        )


def check_that_merged_cells_are_standard(scene, config):
    counts = torch.bincount(labels_of(scene))
    assert int((counts == 1).sum()) >= min(2, len(scene))
    assert_standard(merged(scene, config).select(counts > 1))


def check_that_moments_move_with_the_scene(scene, config):
    """Turn, shift by twice the scene size and change the unit, to 1e-4, in float64."""
    extent = float((scene.means - scene.means.median(dim=0).values).abs().median()) or 1.0
    motion = {"quat": (0.9, 0.1, -0.3, 0.2), "scale": 1e3, "shift": (2e3 * extent, 0.0, -extent)}
    small = merged(scene, config)
    assert_same_gaussians(merged(moved(scene, **motion), config), moved(small, **motion))


def check_that_the_order_of_members_changes_nothing(scene, config):
    """Compare to 1e-4 of the cell size: sums in another order round differently."""
    labels = labels_of(scene)
    shuffle = torch.randperm(len(scene), generator=torch.Generator().manual_seed(3))
    other = scene.select(shuffle)
    part = Partition.from_labels(labels[shuffle], int(labels.amax()) + 1)
    first, second = merged(scene, config), merge_cells(other, part, config=config)
    sizes = first.scales.double().amax(dim=1, keepdim=True)
    slack = 1e-4 * sizes + 2 * EPSILON[scene.dtype] * scene.means.double().abs().amax()
    assert bool(((first.means - second.means).abs() <= slack).all())
    ours, theirs = covariances_of(first), covariances_of(second)
    assert bool(((ours - theirs).abs().amax(dim=(1, 2)) <= 1e-4 * sizes[:, 0].square()).all())
    torch.testing.assert_close(first.opacities, second.opacities, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(first.sh, second.sh, rtol=1e-4, atol=1e-4)


# With a network


@pytest.mark.slow
@dtypes
@each_case
def test_each_case_with_a_network(make, dtype, subtests):
    scene = valid_case(make, COUNT, dtype)
    for device in DEVICES:
        case = case_of_cells(scene, device)
        with subtests.test("network inputs are bounded", device=device):
            check_that_network_inputs_are_bounded(case)
        for preset in PRESETS:
            with subtests.test(
                "corrected cells are near the reference", device=device, preset=preset
            ):
                net = deepcopy(load_checkpoint(preset).net).to(device, dtype)
                check_that_corrected_cells_are_finite_and_near_the_reference(case, net)
        with subtests.test("gradients are finite", device=device):
            check_that_gradients_are_finite(case, lively_net(dtype).to(device))


def check_that_network_inputs_are_bounded(case):
    seen = case.describe()
    for name, values in {**features_of(seen), "positions": seen.positions}.items():
        assert bool(values.isfinite().all()), name
        assert values.numel() == 0 or float(values.abs().amax()) <= 50, name


def check_that_corrected_cells_are_finite_and_near_the_reference(case, net):
    """Log-scales change at most by the bound of the network, logits by 2.

    The network of CVT-GS as published has no bounds.
    """
    small = case.correct(net)
    several = case.part.counts > 1
    for name, values in small.tensors().items():
        assert bool(values[several].isfinite().all()), name
        assert torch.equal(values[~several], case.merged.tensors()[name][~several])
    if isinstance(net, PublishedMergeNet):
        return
    limit = net.architecture.largest_growth
    growth = (small.log_scales - case.merged.log_scales)[several].abs()
    change = (small.logit_opacities - case.merged.logit_opacities)[several].abs()
    assert several.sum() == 0 or float(growth.amax()) <= limit + 1e-4
    assert several.sum() == 0 or float(change.amax()) <= 2 + 1e-4
    if bool((net.known(summarize(case.describe())) > 0.1).any()) and len(case.scene) > 3:
        assert float(growth.amax()) > 1e-6 or case.scene.dtype == torch.float32


def check_that_gradients_are_finite(case, net):
    """Check gradients through the network and the rendered images."""
    middle = case.merged.means.median(dim=0).values.cpu().double()
    cameras = around(1, 16, 12, 16.0)
    viewmats = cameras.viewmats.clone()
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ middle
    tensors = case.compose(net(case.describe()))
    small = case.merged.with_tensors(tensors, {})
    camera = type(cameras)(viewmats=viewmats, Ks=cameras.Ks, width=16, height=12)
    image = render(small, camera)
    assert bool(image.rgb.isfinite().all())
    (image.rgb.square().mean() + image.alpha.mean()).backward()
    for name, values in net.named_parameters():
        assert values.grad is None or bool(values.grad.isfinite().all()), name
    with torch.no_grad():  # cells that are far too small for images have no residuals
        corrected = render(small.select(are_corrected(case)), camera).alpha
    seen = bool((corrected > 0.01).any())
    moves = any(v.grad is not None and bool(v.grad.any()) for v in net.parameters())
    assert moves or not seen


def test_corrected_cells_of_equal_eigenvalues_turn_with_the_scene():
    """Neighbours determine the axes that equal eigenvalues leave undefined."""
    scene = CASES["isotropic_cells"](COUNT, torch.float64)
    labels = torch.arange(COUNT) // 6
    turn = {"quat": (0.9, 0.1, -0.3, 0.2)}
    first, second = (
        case_of(s, labels)._replace(pixel_size=0.01).correct(lively_net())
        for s in (scene, moved(scene, **turn))
    )
    assert_same_gaussians(second, moved(first, **turn))
