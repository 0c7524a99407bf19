"""Axes that moments leave open: neighbours decide, and the answer turns with the scene."""

import math

import pytest
import torch
from torch import Tensor

from cvtgs import GaussianScene
from cvtgs.cells import Partition, align_axes
from cvtgs.cvt import nearest_neighbors
from cvtgs.math import parameters
from hard_scenes import ball
from mergenet_cases import case_of, lively_net
from scenes import assert_same_gaussians, covariances_of, moved, random_scene, same_bits

TURN = {"quat": (0.9, 0.1, -0.3, 0.2)}
SHAPES = {
    "balls": (0.0, 0.0, 0.0),
    "pancakes": (0.0, 0.0, -2.0),
    "needles": (0.0, -2.0, -2.0),
    "needles at the floor": (0.0, math.log(1e-6), math.log(1e-6)),
    "nearly balls": (0.0, -1e-4, -3e-4),
}


def cells_of(shape: tuple[float, float, float], *, dtype=torch.float64) -> GaussianScene:
    scene = random_scene(30, dtype=dtype)
    log_scales = scene.log_scales[:, :1] + torch.tensor(shape, dtype=dtype)
    return scene.with_tensors({"log_scales": log_scales}, {})


def settled(scene: GaussianScene, members: int = 2) -> GaussianScene:
    labels = torch.arange(len(scene)).repeat_interleave(members)
    neighbors = nearest_neighbors(scene.means, 8)
    return align_axes(scene, Partition.from_labels(labels, len(scene)), neighbors)


def axes_of(scene: GaussianScene) -> Tensor:
    return parameters.quats_to_matrices(scene.quats)


def test_a_ball_turns_its_first_axis_to_its_only_neighbour():
    scene = random_scene(2, dtype=torch.float64)
    means = torch.tensor([[1.0, 2.0, 3.0], [1.0, 5.0, 7.0]]).double()
    scene = scene.with_tensors({"means": means, "log_scales": torch.zeros(2, 3).double()}, {})
    for axes in axes_of(settled(scene)):
        assert axes[:, 0].abs().tolist() == pytest.approx([0.0, 0.6, 0.8], abs=1e-9)


def test_a_pancake_turns_within_its_plane_only():
    scene = random_scene(3, dtype=torch.float64)
    means = torch.tensor([[0.0, 0, 0], [3, 4, 9], [-3, -4, 9]]).double()
    scene = scene.with_tensors(
        {
            "means": means,
            "quats": torch.tensor([[1.0, 0, 0, 0]] * 3).double(),
            "log_scales": torch.tensor([[0.0, 0.0, -1.0]] * 3).double(),
        },
        {},
    )
    axes = axes_of(settled(scene))[0]
    assert axes[:, 0].tolist() == pytest.approx([0.6, 0.8, 0.0], abs=1e-9)
    assert axes[:, 2].abs().tolist() == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)


def test_other_cells_keep_their_bits():
    """Axes of different lengths, cells of one member, and cells without neighbours."""
    plain, round_ones = random_scene(30), cells_of(SHAPES["balls"])
    assert settled(plain) is plain
    assert settled(round_ones, members=1) is round_ones
    alone = round_ones.select(torch.tensor([0]))
    assert settled(alone) is alone
    mixed = plain.with_tensors({"log_scales": plain.log_scales.clone()}, {})
    mixed.log_scales[3] = 0.5
    changed = (settled(mixed).quats != mixed.quats).any(dim=1)
    assert changed.nonzero()[:, 0].tolist() == [3]


def test_where_neighbours_coincide_nothing_breaks():
    scene = cells_of(SHAPES["balls"])
    scene = scene.with_tensors({"means": torch.ones_like(scene.means)}, {})
    assert bool(settled(scene).quats.isfinite().all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["32", "64"])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_shapes_stay(shape, dtype):
    scene = cells_of(shape, dtype=dtype)
    small = settled(scene)
    before, after = covariances_of(scene), covariances_of(small)
    size = before.abs().amax(dim=(1, 2))
    assert bool(((after - before).abs().amax(dim=(1, 2)) <= 2e-4 * size).all())
    torch.testing.assert_close(small.log_scales, scene.log_scales, rtol=0, atol=2e-4)


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_axes_turn_with_the_scene(shape):
    """But for their signs, which nothing sees."""
    scene = cells_of(shape)
    spun = scene.select(torch.arange(len(scene)))
    if shape == SHAPES["balls"]:  # which come with any axes
        spun = spun.with_tensors({"quats": spun.quats[torch.randperm(len(spun))]}, {})
    first, second = moved(settled(scene), **TURN), settled(moved(spun, **TURN))
    cosines = (axes_of(first) * axes_of(second)).sum(dim=1).abs()
    assert bool((cosines > 1 - 1e-6).all()), cosines.amin()


@pytest.mark.parametrize("exponent", [-8.0, -1.0])
def test_corrected_pairs_move_with_the_scene(exponent):
    """Two members that are small beside their distance make a needle."""
    scene = ball(60, torch.float64)
    small = scene.with_tensors({"log_scales": torch.full((60, 3), exponent).double()}, {})
    labels = torch.arange(60) // 2
    first, second = (
        case_of(s, labels).correct(lively_net()) for s in (small, moved(small, **TURN))
    )
    assert_same_gaussians(second, moved(first, **TURN))


def test_same_input_same_bits():
    scene = cells_of(SHAPES["balls"])
    assert same_bits(settled(scene), settled(scene))
