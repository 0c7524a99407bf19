"""Descriptors: against the oracle, hand-computed, and their invariances."""

import math

import numpy as np
import pytest
import torch

import mergenet_oracle as oracle
import oracles
from cvtgs import GaussianScene
from cvtgs.cells import Partition, describe_cells, merge_cells
from cvtgs.cells.descriptors import CELL_FEATURES, MEMBER_FEATURES, PAIR_FEATURES
from cvtgs.cells.partition import MOST_SAMPLED, sample_members
from cvtgs.config import MergeConfig
from cvtgs.math.segments import segment_sum
from mergenet_cases import (
    Case,
    assert_same_features,
    case_of,
    features_of,
    some_case,
    some_labels,
)
from scenes import moved, random_scene

HALF_TURNS = {"x": (0, 1, 0, 0), "y": (0, 0, 1, 0), "z": (0, 0, 0, 1)}


def turned_about_own_axis(quats: torch.Tensor, axis: str) -> torch.Tensor:
    """Flip the other two axes: the same Gaussians by another quaternion."""
    products = [oracles.quaternion_product(quat, HALF_TURNS[axis]) for quat in quats.tolist()]
    return torch.tensor(products, dtype=quats.dtype)


def test_two_round_members_side_by_side():
    """Weights 1/2; mean 2, scales sqrt(5), 1, 1; the other colour is half a step away."""
    row = random_scene(1, degree=0, dtype=torch.float64).select(torch.tensor([0, 0]))
    scene = row.with_tensors(
        {
            "means": torch.tensor([[0.0, 0, 0], [4, 0, 0]]).double(),
            "quats": torch.tensor([[1.0, 0, 0, 0]] * 2).double(),
            "log_scales": torch.zeros(2, 3).double(),
            "logit_opacities": torch.zeros(2).double(),
            "sh0": torch.tensor([[[0.0] * 3], [[0.5 / oracle.C0] * 3]]).double(),
        },
        {},
    )
    case = case_of(scene, torch.tensor([0, 0]), visibility=torch.tensor([1.0, 0.0]))
    seen = case._replace(pixel_size=0.5).describe()
    far = math.log1p(2 / math.sqrt(5))
    inside = 0.3 * math.log(1 / math.sqrt(5))
    assert seen.positions.abs().tolist() == [pytest.approx([2 / math.sqrt(5), 0, 0])] * 2
    first = seen.members[0].tolist()
    assert first[:7] == pytest.approx([far, 0, 0, far, inside, 0, 0])
    assert first[7:11] == [0, 0, 0, 0]
    assert first[11:13] == pytest.approx([0, 0.5])
    assert first[14:18] == pytest.approx([3 * 0.25, 0.5 * 0.25 / 0.27, 1, 1.5])
    assert first[18] == pytest.approx(0.5 * 4 / 5)
    cell = seen.cells[0].tolist()
    assert cell[:9] == pytest.approx([0] * 6 + [1 / 5, 1, 1])
    assert cell[9] == pytest.approx(0.2 * math.log(2))
    assert cell[13:15] == pytest.approx([0.5 * math.log(5) / 2, 0])
    assert cell[15:20] == pytest.approx([5 * 0.25, 0.5, 0.5 * 2 / math.sqrt(5), math.log(51), 0])
    assert cell[20] == pytest.approx(0.3 * math.log(2 * 5 ** (1 / 6)))
    assert seen.pairs.shape == (1, 0, PAIR_FEATURES)
    assert seen.weights.tolist() == [0.5, 0.5]


def test_features_of_far_members_and_of_bright_ones_are_bounded():
    """The third member is 50 deviations away on the bright side, and hardly moves the cell."""
    row = random_scene(1, degree=0, dtype=torch.float64).select(torch.tensor([0, 0, 0]))
    scene = row.with_tensors(
        means=torch.tensor([[-1.0, 0, 0], [1, 0, 0], [60, 0, 0]]).double(),
        log_scales=torch.full((3, 3), -0.7).double(),
        logit_opacities=torch.tensor([0.0, 0.0, -13.0]).double(),
        sh0=torch.tensor([0.0, 0.0, 100.0]).double()[:, None, None].expand(3, 1, 3),
    )
    seen = case_of(scene, torch.zeros(3).long(), visibility=torch.tensor([0.0, 1.0, 0.5]))
    assert seen.describe().members[2, [14, 18]].tolist() == [3.0, 3.0]


@pytest.mark.parametrize(
    ("seed", "tagged", "near"),
    [
        (1, True, 8),
        *(pytest.param(seed, False, 8, marks=pytest.mark.slow) for seed in (0, 2)),
        *(pytest.param(1, tagged, 1, marks=pytest.mark.slow) for tagged in (False, True)),
        *(pytest.param(2, tagged, 0, marks=pytest.mark.slow) for tagged in (False, True)),
    ],
)
def test_descriptors_equal_the_oracle(seed, tagged, near):
    case = some_case(60, 12, seed=seed, near=near, tagged=tagged)
    seen = case.describe()
    cells = case.oracle_cells()
    members = [row for cell in cells for row in oracle.describe_members(cell)]
    shares = [share for cell in cells for share in cell.shares]
    np.testing.assert_allclose(seen.members, members, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        seen.cells, [oracle.describe_cell(cell) for cell in cells], rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(seen.weights, shares, rtol=1e-12)
    assert seen.offsets.tolist() == case.part.offsets.tolist()
    assert seen.pairs.shape == (12, near, PAIR_FEATURES)
    if near:
        pairs = [oracle.describe_pairs(cell) for cell in cells]
        np.testing.assert_allclose(seen.pairs, pairs, rtol=1e-9, atol=1e-9)
        places = [[cell.own.locate(other.mean) for other in cell.others] for cell in cells]
        np.testing.assert_allclose(seen.pair_positions, places, rtol=1e-9, atol=1e-9)


def test_large_cells_are_described_by_a_sample():
    case = some_case(300, 3)
    seen, sampled = case.describe(), sample_members(case.scene, case.part)
    assert seen.rows.tolist() == sampled.part.order.tolist()
    assert seen.offsets.tolist() == sampled.part.offsets.tolist()
    assert float(seen.offsets.diff().amax()) <= MOST_SAMPLED
    rates = sampled.rates.reciprocal()
    ids = torch.repeat_interleave(torch.arange(3), sampled.part.counts)
    for found, values in (
        (seen.shares, rates),
        (seen.weights, case.scene.masses[seen.rows] * rates),
    ):
        wanted = values / segment_sum(values, seen.offsets)[ids]
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=0.0)
    # The mean of all members is the centre of the cell, so that of the sample is moved there.
    means = segment_sum(seen.positions, seen.offsets, seen.weights)
    torch.testing.assert_close(means, torch.zeros(3, 3).double(), rtol=0.0, atol=1e-9)
    counts = 0.2 * sampled.counts.double().log()
    torch.testing.assert_close(seen.cells[:, 9], counts, rtol=1e-12, atol=0.0)
    members = case.scene.select(case.part.order)
    depths = -torch.log1p(-members.opacities) * members.areas
    depths = segment_sum(depths, case.part.offsets) / case.merged.areas
    torch.testing.assert_close(seen.cells[:, 12], 0.3 * depths.log(), rtol=0.0, atol=0.03)


@pytest.mark.long
def test_samples_estimate_the_totals_of_all_members():
    case = some_case(900, 3)
    seen, sampled = case.describe(), sample_members(case.scene, case.part)
    wanted = torch.tensor([oracle.describe_cell(cell) for cell in case.oracle_cells()])
    torch.testing.assert_close(seen.cells, wanted.double(), rtol=0.1, atol=0.1)
    shares = torch.cat([torch.tensor(cell.shares) for cell in case.oracle_cells()]).double()
    places = torch.empty_like(case.part.order)
    places[case.part.order] = torch.arange(900)
    counts = torch.repeat_interleave(sampled.counts, sampled.part.counts)
    relative = 0.3 * (shares[places[seen.rows]] * counts).log()
    torch.testing.assert_close(seen.members[:, 11], relative, rtol=0.0, atol=0.01)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_shapes_and_dtypes(dtype):
    seen = some_case(60, 12, degree=3, dtype=dtype).describe()
    assert len(seen) == 12
    assert seen.members.shape == (60, MEMBER_FEATURES)
    assert seen.pairs.shape == (12, 8, PAIR_FEATURES)
    assert seen.cells.shape == (12, CELL_FEATURES)
    assert seen.positions.shape == (60, 3)
    assert seen.pair_positions.shape == (12, 8, 3)
    assert {values.dtype for values in features_of(seen).values()} == {dtype}
    assert seen.offsets.dtype == torch.int64


def test_a_subset_of_cells_gets_the_same_descriptors():
    """Cells are given by number, with the neighbours and sizes of all cells."""
    case = some_case(60, 12)
    whole, keep = case.describe(), torch.tensor([1, 4, 5, 11])
    mask = torch.zeros(12, dtype=torch.bool)
    mask[keep] = True
    some = describe_cells(
        case.scene,
        case.merged,
        case.part.select(mask),
        cells=keep,
        neighbors=case.neighbors[keep],
        sizes=case.part.counts,
        visibility=case.visibility,
        pixel_size=case.pixel_size,
    )
    members = torch.repeat_interleave(mask, case.part.counts)
    torch.testing.assert_close(some.cells, whole.cells[keep])
    torch.testing.assert_close(some.pairs, whole.pairs[keep])
    torch.testing.assert_close(some.members, whole.members[members])


def test_moving_to_another_dtype_and_device():
    seen = some_case().describe()
    single = seen.to(torch.float32).to(torch.device("cpu"))
    assert {values.dtype for values in features_of(single).values()} == {torch.float32}
    assert single.offsets.dtype == torch.int64
    assert seen.members.dtype == torch.float64


MOTIONS = {
    "turned": {"quat": (0.9, 0.1, -0.3, 0.2)},
    "shifted": {"shift": (3.0, -50.0, 100.0)},
    "in millimetres": {"scale": 1e3},
    "in kilometres": {"scale": 1e-3},
    "all of it": {"quat": (0.1, 0.7, 0.2, -0.6), "shift": (1.0, 2.0, 3.0), "scale": 30.0},
}


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
@pytest.mark.parametrize("degree", [0, 2])
def test_descriptors_do_not_depend_on_place_size_or_orientation(motion, degree):
    case = some_case(degree=degree)
    there = case_of(moved(case.scene, **motion), some_labels(60, 12))
    there = there._replace(pixel_size=case.pixel_size * motion.get("scale", 1.0))
    assert_same_features(case.describe(), there.describe())
    carried = there._replace(
        merged=moved(case.merged, **motion), part=case.part, neighbors=case.neighbors
    )
    assert_same_features(case.describe(), carried.describe())


def test_only_the_last_feature_of_a_cell_depends_on_the_size_of_images():
    case = some_case()
    large, small = (
        case._replace(pixel_size=case.pixel_size * factor).describe() for factor in (0.5, 1.0)
    )
    torch.testing.assert_close(features_of(large), features_of(small.in_images(2.0)))
    difference = large.cells - small.cells
    torch.testing.assert_close(difference[:, -1], torch.full((12,), 0.3 * math.log(2)).double())
    assert not difference[:, :-1].any()


@pytest.mark.parametrize("extreme", [1e-30, 1e30])
def test_sizes_in_pixels_are_bounded(extreme):
    cells = some_case()._replace(pixel_size=extreme).describe().cells[:, -1]
    assert cells.unique().tolist() == [pytest.approx(3.6 if extreme < 1 else -2.1)]


@pytest.mark.parametrize("axis", HALF_TURNS)
def test_descriptors_do_not_depend_on_the_signs_of_axes(axis):
    case = some_case()
    quats = case.merged.quats.clone()
    quats[::2] = turned_about_own_axis(quats[::2], axis)
    flipped = case._replace(merged=case.merged.with_tensors({"quats": quats}, {}))
    assert_same_features(case.describe(), flipped.describe())
    assert not torch.allclose(case.describe().positions, flipped.describe().positions)


@pytest.mark.parametrize("factor", [-1.0, 1e-3, 1e3])
def test_descriptors_do_not_depend_on_length_or_sign_of_quaternions(factor):
    case = some_case()
    other = case._replace(
        merged=case.merged.with_tensors({"quats": factor * case.merged.quats}, {}),
        scene=case.scene.with_tensors({"quats": factor * case.scene.quats}, {}),
    )
    assert_same_features(case.describe(), other.describe())


def test_descriptors_depend_only_on_distances_of_colours():
    """Offsets, permuted channels, and swapping dark and light have no effect."""
    case = some_case()
    offset = torch.tensor([5.0, -1.0, 0.3]).double()
    for change in (lambda c: c + offset, lambda c: c.flip(-1), lambda c: -c):
        other = case._replace(
            scene=case.scene.with_tensors({"sh0": change(case.scene.sh0)}, {}),
            merged=case.merged.with_tensors({"sh0": change(case.merged.sh0)}, {}),
        )
        assert_same_features(case.describe(), other.describe())


def test_view_dependent_colours_are_ignored():
    case = some_case(degree=3)
    blank = case._replace(
        scene=case.scene.with_tensors({"shN": case.scene.shN * math.nan}, {}),
        merged=case.merged.with_tensors({"shN": case.merged.shN * math.nan}, {}),
    )
    for name, values in features_of(case.describe()).items():
        assert torch.equal(values, getattr(blank.describe(), name))


def test_order_of_members_does_not_matter():
    case = some_case()
    shuffle = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    labels = some_labels(60, 12)
    other = case_of(
        case.scene.select(shuffle), labels[shuffle], visibility=case.visibility[shuffle]
    )
    first, second = case.describe(), other.describe()
    rows = shuffle[other.part.order].argsort()[case.part.order]  # where each member went
    torch.testing.assert_close(first.members, second.members[rows])
    torch.testing.assert_close(first.weights, second.weights[rows])
    torch.testing.assert_close(first.cells, second.cells)
    torch.testing.assert_close(first.pairs, second.pairs)


def test_order_of_neighbours_does_not_matter():
    case = some_case()
    shuffle = torch.tensor([3, 1, 7, 0, 2, 6, 5, 4])
    first = case.describe()
    second = case._replace(neighbors=case.neighbors[:, shuffle]).describe()
    torch.testing.assert_close(first.members, second.members)
    torch.testing.assert_close(first.cells, second.cells)
    torch.testing.assert_close(first.pairs[:, shuffle], second.pairs)


def test_inverted_visibility_matters_and_mirroring_does_not():
    """Mirrored cells have the same descriptors; light from the other side changes them."""
    case = some_case()
    dark = case._replace(visibility=1 - case.visibility)
    assert not torch.allclose(case.describe().members, dark.describe().members)
    mirror = torch.tensor([-1.0, 1, 1]).double()
    flip = torch.tensor([1.0, 1, -1, -1]).double()  # of a quaternion, for the mirror x -> -x

    def mirrored(scene: GaussianScene) -> GaussianScene:
        return scene.with_tensors(
            {"means": scene.means * mirror, "quats": scene.quats * flip}, scene.extras
        )

    other = Case(mirrored(case.scene), mirrored(case.merged), *case[2:])
    assert_same_features(case.describe(), other.describe())


def test_descriptors_of_some_cells():
    """They are the same bits as in the whole."""
    case = some_case()
    seen, counts = case.describe(), case.part.counts
    for chosen, found in (
        (torch.tensor([1, 3, 4]), seen.select(torch.tensor([1, 3, 4]))),
        (torch.arange(0), seen.select(torch.arange(0))),
    ):
        is_chosen = torch.zeros(len(counts), dtype=torch.bool)
        is_chosen[chosen] = True
        members = is_chosen.repeat_interleave(counts)
        assert found.offsets.tolist() == [0, *counts[chosen].cumsum(0).tolist()]
        for name in ("members", "weights", "positions"):
            assert getattr(found, name).equal(getattr(seen, name)[members])
        for name in ("pairs", "cells", "pair_positions"):
            assert getattr(found, name).equal(getattr(seen, name)[chosen])


def test_small_cells_do_not_depend_on_sampled_ones():
    """Weights of the merge are not masses here, so the mean of a small cell is not its centre."""
    config = MergeConfig(area_power=0.0)
    many = 3 * MOST_SAMPLED
    labels = torch.cat([torch.zeros(5, dtype=torch.int64), torch.ones(many, dtype=torch.int64)])
    scene = random_scene(5 + many, degree=1)
    part = Partition.from_labels(labels, 2)
    merged = merge_cells(scene, part, config=config)
    both, alone = (
        describe_cells(
            scene,
            merged,
            part.select(torch.tensor([True, has_large])),
            cells=torch.arange(1 + has_large),
            neighbors=torch.tensor([[1], [0]])[: 1 + has_large],
            sizes=part.counts,
            visibility=torch.ones(5 + many).double(),
            pixel_size=0.01,
        )
        for has_large in (True, False)
    )
    torch.testing.assert_close(both.positions[:5], alone.positions)
    torch.testing.assert_close(both.members[:5], alone.members)
