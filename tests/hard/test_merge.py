"""Merging given cells of hard scenes, with and without a network, and the network's gradients."""

import math

import pytest
import torch

import oracles
from cvtgs import render
from cvtgs.cells import Partition, merge_cells
from cvtgs.config import SimplifyConfig
from hard_cases import CASES, each_case
from hard_scenes import devices, dtypes, presets, simplifier, valid_rows
from mergenet_cases import Case, case_of, features_of, lively_net
from render_cases import around
from scenes import assert_same_gaussians, assert_standard, covariances_of, moved, oracle_rows

COUNT = 60
EPSILON = {torch.float32: 1.2e-7, torch.float64: 2.3e-16}


def valid_scene(make, dtype, device="cpu"):
    scene = make(COUNT, dtype)
    return scene.select(valid_rows(scene)).to(device)


def labels_of(scene):
    """Cells of four rows, which lie anywhere, and two cells of one."""
    labels = torch.arange(len(scene)) // 4
    labels[:2] = labels[-1] + 1 + torch.arange(2)[: len(scene)]
    return torch.unique(labels, return_inverse=True)[1].to(scene.device)


def merged(scene, config):
    labels = labels_of(scene)
    return merge_cells(scene, Partition.from_labels(labels, int(labels.amax()) + 1), config=config)


def config_of(preset):
    return SimplifyConfig.from_preset(preset).merge


def case_of_cells(make, dtype, device="cpu") -> Case:
    scene = valid_scene(make, dtype, device)
    case = case_of(scene.to("cpu"), labels_of(scene).cpu())
    if device == "cpu":
        return case
    part = case.part.to(torch.device(device))
    there = case.neighbors.to(device), case.visibility.to(device)
    return Case(scene, case.merged.to(device), part, *there)


@presets
@dtypes
@devices
@each_case
def test_cells_equal_the_oracle(make, device, dtype, preset):
    """To what float32 and float64 hold: of positions, of the cell's own size, of colours.

    The oracle takes areas from eigenvalues, and so loses needles to 1e-4, and cells of 1e30.
    """
    if make.__name__ == "far_flyaways":
        make = CASES["flyaways"]
    scene, config = valid_scene(make, dtype, device), config_of(preset)
    small, labels = merged(scene, config).to("cpu"), labels_of(scene).cpu()
    scene, matrices = scene.to("cpu"), covariances_of(small)
    tolerance = 200 * EPSILON[dtype] + 2e-12  # eigenvalues are floored at 1e-12 of the largest
    tolerance += 1e-4 * (make.__name__ == "needles")
    for cell in range(len(small)):
        rows = (labels == cell).nonzero()[:, 0].tolist()
        wanted = oracles.merge(
            oracle_rows(scene, rows), area_power=config.area_power, opacity=config.opacity
        )
        size = math.sqrt(float(wanted.covariance.max()))
        place = tolerance * size + EPSILON[dtype] * float(scene.means[rows].abs().amax())
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


@presets
@dtypes
@devices
@each_case
def test_merged_cells_are_standard(make, device, dtype, preset):
    scene = valid_scene(make, dtype, device)
    counts = torch.bincount(labels_of(scene))
    assert int((counts == 1).sum()) >= min(2, len(scene))
    assert_standard(merged(scene, config_of(preset)).select(counts > 1))


@presets
@each_case
def test_moments_move_with_the_scene(make, preset):
    """Any turn, a shift by twice the size of the scene and another unit, to 1e-4, in float64."""
    scene, config = valid_scene(make, torch.float64), config_of(preset)
    extent = float((scene.means - scene.means.median(dim=0).values).abs().median()) or 1.0
    motion = {"quat": (0.9, 0.1, -0.3, 0.2), "scale": 1e3, "shift": (2e3 * extent, 0.0, -extent)}
    small = merged(scene, config)
    assert_same_gaussians(merged(moved(scene, **motion), config), moved(small, **motion))


@presets
@dtypes
@each_case
def test_the_order_of_members_changes_nothing(make, dtype, preset):
    """To 1e-4 of the size of each cell: sums of other orders round otherwise."""
    scene, config = valid_scene(make, dtype), config_of(preset)
    labels = labels_of(scene)
    shuffle = torch.randperm(len(scene), generator=torch.Generator().manual_seed(3))
    other = scene.select(shuffle)
    part = Partition.from_labels(labels[shuffle], int(labels.amax()) + 1)
    first, second = merged(scene, config), merge_cells(other, part, config=config)
    sizes = first.scales.double().amax(dim=1, keepdim=True)
    slack = 1e-4 * sizes + 2 * EPSILON[dtype] * scene.means.double().abs().amax()
    assert bool(((first.means - second.means).abs() <= slack).all())
    ours, theirs = covariances_of(first), covariances_of(second)
    assert bool(((ours - theirs).abs().amax(dim=(1, 2)) <= 1e-4 * sizes[:, 0].square()).all())
    torch.testing.assert_close(first.opacities, second.opacities, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(first.sh, second.sh, rtol=1e-4, atol=1e-4)


# With a network


@dtypes
@devices
@each_case
def test_what_the_network_sees_is_bounded(make, device, dtype):
    seen = case_of_cells(make, dtype, device).describe()
    for name, values in {**features_of(seen), "positions": seen.positions}.items():
        assert bool(values.isfinite().all()), name
        assert values.numel() == 0 or float(values.abs().amax()) <= 50, name


@presets
@dtypes
@devices
@each_case
def test_corrected_cells_are_finite_and_near_the_reference(make, device, dtype, preset):
    """Log scales change by as much as the network promises at most, logits by 2."""
    case = case_of_cells(make, dtype, device)
    net = simplifier(preset, device).checkpoint.net.to(dtype)
    small = case.correct(net)
    simplifier(preset, device).checkpoint.net.to(torch.float32)
    several = case.part.counts > 1
    for name, values in small.tensors().items():
        assert bool(values[several].isfinite().all()), name
        assert torch.equal(values[~several], case.merged.tensors()[name][~several])
    limit = net.architecture.largest_growth
    growth = (small.log_scales - case.merged.log_scales)[several].abs()
    change = (small.logit_opacities - case.merged.logit_opacities)[several].abs()
    assert several.sum() == 0 or float(growth.amax()) <= limit + 1e-4
    assert several.sum() == 0 or float(change.amax()) <= 2 + 1e-4
    if len(case.scene) > 3 and dtype == torch.float64:
        assert float(growth.amax()) > 1e-6


@dtypes
@devices
@each_case
def test_gradients_through_network_and_images_are_finite(make, device, dtype):
    case, net = case_of_cells(make, dtype, device), lively_net(dtype).to(device)
    middle = case.merged.means.median(dim=0).values.cpu().double()
    cameras = around(1, 16, 12, 16.0)
    viewmats = cameras.viewmats.clone()
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ middle
    tensors = case.compose(net(case.describe()))
    small = case.merged.with_tensors(tensors, {})
    image = render(small, type(cameras)(viewmats=viewmats, Ks=cameras.Ks, width=16, height=12))
    assert bool(image.rgb.isfinite().all())
    (image.rgb.square().mean() + image.alpha.mean()).backward()
    for name, values in net.named_parameters():
        assert values.grad is None or bool(values.grad.isfinite().all()), name
    seen = bool((image.alpha > 0.01).any())
    moves = any(v.grad is not None and bool(v.grad.any()) for v in net.parameters())
    assert moves or not seen


def test_corrected_cells_of_equal_eigenvalues_move_with_the_scene():
    """Neighbours decide about axes that equal eigenvalues leave open."""
    scene = CASES["isotropic_cells"](COUNT, torch.float64)
    labels = torch.arange(COUNT) // 6
    turn = {"quat": (0.9, 0.1, -0.3, 0.2)}
    first, second = (
        case_of(s, labels).correct(lively_net()) for s in (scene, moved(scene, **turn))
    )
    assert_same_gaussians(second, moved(first, **turn))
