"""Inflation and aligned axes: against the oracle, by hand, and what they leave unchanged."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

import oracles
from cvtgs import GaussianScene
from cvtgs.cells import Partition, align_axes, inflate_cells
from cvtgs.cells.inflate import side_cover
from cvtgs.config import MergeConfig
from cvtgs.cvt import nearest_neighbors
from cvtgs.math import parameters
from cvtgs.pipeline import shape_merged
from hard_scenes import ball
from mergenet_cases import case_of, lively_net
from scenes import assert_same_gaussians, covariances_of, moved, random_scene, same_bits

GROWTH = {"everywhere": 0.1, "covered": 0.4}


def crowded(counts: list[int]) -> Partition:
    labels = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    return Partition.from_labels(labels, len(counts))


def opaque_scene(count: int) -> GaussianScene:
    """Overlapping, mostly opaque Gaussians."""
    scene = random_scene(count, dtype=torch.float64)
    return scene.with_tensors(
        {
            "means": scene.means * 0.3,
            "log_scales": scene.log_scales + 1.0,
            "logit_opacities": scene.logit_opacities + 2.0,
        },
        {},
    )


def widened(scene: GaussianScene, counts: list[int], **growth: float) -> GaussianScene:
    neighbors = nearest_neighbors(scene.means, 8)
    return inflate_cells(scene, crowded(counts), neighbors, **{**GROWTH, **growth})


def test_an_isolated_opaque_cell_of_a_hundred_grows_by_a_tenth():
    scene = random_scene(2, dtype=torch.float64)
    far = torch.tensor([[0.0, 0, 0], [1e6, 0, 0]]).double()
    logits = torch.full((2,), 20.0).double()
    scene = scene.with_tensors({"means": far, "logit_opacities": logits}, {})
    ratio = widened(scene, [100, 10]).scales / scene.scales
    assert ratio[0].tolist() == pytest.approx([1.1] * 3, rel=1e-5)
    assert ratio[1].tolist() == pytest.approx([1.05] * 3, rel=1e-5)


def test_an_axis_grows_more_where_both_its_ends_are_covered():
    """Opaque balls to the left and right, none above: the x axis is covered, y is not."""
    scene = random_scene(3, dtype=torch.float64)
    row = scene.select(torch.tensor([0, 0, 0]))
    scene = row.with_tensors(
        {
            "means": torch.tensor([[0.0, 0, 0], [3, 0, 0], [-3, 0, 0]]).double(),
            "quats": torch.tensor([[1.0, 0, 0, 0]] * 3).double(),
            "log_scales": torch.zeros(3, 3).double(),
            "logit_opacities": torch.full((3,), 20.0).double(),
        },
        {},
    )
    ratio = widened(scene, [100, 1, 1]).scales / scene.scales
    assert ratio[0].tolist() == pytest.approx([1.5, 1.1, 1.1], rel=1e-2)
    assert bool((ratio[1:] == 1).all())


def test_cover_equals_the_oracle():
    scene = opaque_scene(12)
    rows = torch.tensor([0, 5, 7])
    others = torch.tensor([[1, 2, 3], [4, 6, 8], [9, 10, 11]])
    found = side_cover(scene, rows, others)
    quats = torch.nn.functional.normalize(scene.quats, dim=1)
    arrays = [tensor.numpy() for tensor in (scene.means, quats, scene.scales, scene.opacities)]
    for place, row in enumerate(rows.tolist()):
        wanted = oracles.side_cover(*arrays, row, others[place].tolist())
        assert found[place].flatten().tolist() == pytest.approx(np.ravel(wanted), abs=1e-12)
    assert float(found.amax()) > 0.1


def test_inflation_equals_the_oracle():
    scene, counts = opaque_scene(9), [1, 2, 3, 10, 50, 100, 1000, 2, 7]
    rows = torch.arange(9)
    cover = side_cover(scene, rows, nearest_neighbors(scene.means, 8))
    ratio = widened(scene, counts).scales / scene.scales
    for row in rows.tolist():
        wanted = [
            oracles.inflation(float(scene.opacities[row]), counts[row], side, **GROWTH)
            for side in cover[row].amin(dim=1).tolist()
        ]
        wanted = [1.0] * 3 if counts[row] == 1 else wanted
        assert ratio[row].tolist() == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("growth", [(0.1, 0.0), (0.0, 0.4), (0.0, 0.0)])
def test_each_kind_of_growth_can_be_used_alone(growth):
    scene, cells = opaque_scene(9), crowded([10] * 9)
    neighbors = nearest_neighbors(scene.means, 8)
    config = MergeConfig(inflation=growth[0], covered_inflation=growth[1], align_axes=False)
    found = shape_merged(scene, cells, neighbors, config)
    wanted = inflate_cells(scene, cells, neighbors, everywhere=growth[0], covered=growth[1])
    assert same_bits(found, wanted)
    assert torch.equal(found.log_scales, scene.log_scales) == (growth == (0.0, 0.0))


def test_only_scales_of_cells_with_several_members_change():
    scene = opaque_scene(40)
    wide = widened(scene, [1] * 20 + [50] * 20)
    assert same_bits(wide.select(torch.arange(20)), scene.select(torch.arange(20)))
    assert bool((wide.log_scales[20:] > scene.log_scales[20:]).all())
    assert same_bits(wide.with_tensors({"log_scales": scene.log_scales}, {}), scene)


def test_haze_is_left_alone():
    scene = opaque_scene(30)
    hazy = scene.with_tensors({"logit_opacities": scene.logit_opacities * 0 - 9.0}, {})
    ratio = widened(hazy, [100] * 30).scales / hazy.scales
    assert float((ratio - 1).abs().amax()) < 1e-6


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_cells_have_few_neighbours(count):
    scene = opaque_scene(count)
    assert len(widened(scene, [10] * count)) == count


def test_chunks_do_not_change_a_bit(monkeypatch):
    scene = opaque_scene(50)
    whole = widened(scene, [3] * 50)
    monkeypatch.setitem(inflate_cells.__wrapped__.__globals__, "CHUNK", 7)
    assert same_bits(widened(scene, [3] * 50), whole)


def test_inflation_moves_with_the_scene():
    scene, counts = opaque_scene(30), [20] * 30
    motion = {"quat": (0.3, -0.5, 0.8, 0.1), "shift": (3.0, -2.0, 5.0), "scale": 10.0}
    assert_same_gaussians(
        widened(moved(scene, **motion), counts),
        moved(widened(scene, counts), **motion),
        tolerance=1e-7,
    )


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


def test_near_neighbours_pull_by_the_inverse_square_of_their_distance():
    """One at 2 units outweighs two at 3 units on another axis: 1/4 against 2/9."""
    scene = cells_of(SHAPES["balls"]).select(torch.arange(4))
    means = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0, -3, 0]]).double()
    axes = axes_of(settled(scene.with_tensors({"means": means}, {})))[0]
    assert axes[:, 0].abs().tolist() == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("thin", [-1.0, -0.01])  # variances differ by 2 %, which is enough
def test_a_pancake_turns_within_its_plane_only(thin):
    scene = random_scene(3, dtype=torch.float64)
    means = torch.tensor([[0.0, 0, 0], [3, 4, 9], [3, 4, 8]]).double()
    scene = scene.with_tensors(
        {
            "means": means,
            "quats": torch.tensor([[1.0, 0, 0, 0]] * 3).double(),
            "log_scales": torch.tensor([[0.0, 0.0, thin]] * 3).double(),
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


def test_coincident_neighbours_do_no_harm():
    scene = cells_of(SHAPES["balls"])
    scene = scene.with_tensors({"means": torch.ones_like(scene.means)}, {})
    assert bool(settled(scene).quats.isfinite().all())


def test_coincident_neighbours_do_not_pull():
    scene = cells_of(SHAPES["balls"]).select(torch.arange(3))
    means = torch.tensor([[0.0, 0, 0], [0, 0, 0], [3, 4, 0]]).double()
    axes = axes_of(settled(scene.with_tensors({"means": means}, {})))[0]
    assert axes[:, 0].abs().tolist() == pytest.approx([0.6, 0.8, 0.0], abs=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["32", "64"])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_aligning_axes_keeps_covariances(shape, dtype):
    scene = cells_of(shape, dtype=dtype)
    small = settled(scene)
    before, after = covariances_of(scene), covariances_of(small)
    size = before.abs().amax(dim=(1, 2))
    assert bool(((after - before).abs().amax(dim=(1, 2)) <= 2e-4 * size).all())
    torch.testing.assert_close(small.log_scales, scene.log_scales, rtol=0, atol=2e-4)


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_axes_turn_with_the_scene(shape):
    """Up to their signs, which have no effect."""
    scene = cells_of(shape)
    spun = scene.select(torch.arange(len(scene)))
    if shape == SHAPES["balls"]:  # whose axes are arbitrary
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


def test_results_are_deterministic():
    scene = cells_of(SHAPES["balls"])
    assert same_bits(settled(scene), settled(scene))
