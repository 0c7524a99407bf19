"""Sampling the members of large cells."""

import math

import pytest
import torch

from cvtgs import GaussianScene
from cvtgs.cells import Partition
from cvtgs.cells.partition import MOST_SAMPLED, START, sample_members
from scenes import random_scene

SIZES = [1, MOST_SAMPLED, MOST_SAMPLED + 1, 500, 3000]


def cells_of(sizes: list[int]) -> Partition:
    labels = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    return Partition.from_labels(labels, len(sizes))


def scene_of_masses(masses: torch.Tensor) -> GaussianScene:
    """Gaussians of one shape, whose masses are proportional to their opacities."""
    scene = random_scene(1, degree=0, dtype=torch.float64).select(
        torch.zeros(len(masses), dtype=torch.int64)
    )
    opacities = 0.9 * masses.double() / masses.amax()
    return scene.with_tensors({"logit_opacities": torch.logit(opacities)}, {})


def test_small_cells_keep_all_members():
    scene, part = random_scene(MOST_SAMPLED + 5, degree=0), cells_of([MOST_SAMPLED, 5])
    sampled = sample_members(scene, part)
    assert sampled.part.order.tolist() == part.order.tolist()
    assert sampled.rates.tolist() == [1.0] * len(part.order)


def test_large_cells_keep_few_members_in_the_same_order():
    scene, part = random_scene(sum(SIZES), degree=0), cells_of(SIZES)
    sampled = sample_members(scene, part)
    assert sampled.counts.tolist() == SIZES
    assert sampled.part.counts[:2].tolist() == SIZES[:2]
    # One member can pass several steps, so there may be fewer, but never more.
    assert bool((sampled.part.counts <= MOST_SAMPLED).all())
    assert bool((sampled.part.counts[2:] >= MOST_SAMPLED // 2).all())
    for cell, size in enumerate(SIZES):
        rows = sampled.part.cut(slice(cell, cell + 1)).order
        start = sum(SIZES[:cell])
        assert rows.tolist() == sorted(set(rows.tolist()))
        assert int(rows.amin()) >= start
        assert int(rows.amax()) < start + size


def test_equal_masses_are_sampled_at_equal_steps():
    """By hand: member i ends at step i 32 / 96, so every third one passes a step."""
    sampled = sample_members(scene_of_masses(torch.ones(96)), cells_of([96]))
    passing = [i for i in range(96) if math.floor((i + 1) / 3 + START) > math.floor(i / 3 + START)]
    assert sampled.part.order.tolist() == passing
    assert sampled.rates.tolist() == pytest.approx([1 / 3] * MOST_SAMPLED)


def test_a_heavy_member_is_always_taken():
    masses = torch.ones(1000)
    masses[[0, 517]] = 200.0
    sampled = sample_members(scene_of_masses(masses), cells_of([1000]))
    order = sampled.part.order.tolist()
    assert {0, 517} <= set(order)
    assert [float(sampled.rates[order.index(row)]) for row in (0, 517)] == [1.0, 1.0]
    light = [rate for row, rate in zip(order, sampled.rates.tolist(), strict=True) if row != 0]
    assert min(light) == pytest.approx(MOST_SAMPLED / 1398)


def test_each_cell_is_sampled_for_itself():
    masses = torch.ones(200)
    masses[0] = 50.0
    one = sample_members(scene_of_masses(masses), cells_of([200])).part.order.tolist()
    two = sample_members(scene_of_masses(masses.repeat(2)), cells_of([200, 200])).part.order
    assert one[0] == 0
    assert two.tolist() == [*one, *(200 + row for row in one)]


@pytest.mark.parametrize("seed", range(3))
def test_sums_are_estimated(seed):
    """Masses exactly but for members of more than a step; other sums within a hundredth."""
    g = torch.Generator().manual_seed(seed)
    masses = torch.rand(5000, generator=g).double() + 0.1
    values = masses * (2.0 + torch.arange(5000).double() / 5000)
    sampled = sample_members(scene_of_masses(masses), cells_of([5000]))
    rows, rates = sampled.part.order, sampled.rates
    assert float((masses[rows] / rates).sum()) == pytest.approx(float(masses.sum()))
    assert float((values[rows] / rates).sum()) == pytest.approx(float(values.sum()), rel=0.01)


@pytest.mark.parametrize("limit", [1, 700, 3000])
def test_neither_chunks_nor_dtypes_change_the_sample(limit):
    scene, part = random_scene(sum(SIZES), degree=0), cells_of(SIZES)
    whole = sample_members(scene, part).part.order.tolist()
    chunks = [sample_members(scene, chunk).part.order for _, chunk in part.chunks(limit)]
    assert torch.cat(chunks).tolist() == whole
    double = {name: values.double() for name, values in scene.tensors().items()}
    assert sample_members(scene.with_tensors(double, {}), part).part.order.tolist() == whole


def test_members_of_no_mass_and_of_huge_size():
    scene = random_scene(400, degree=0)
    logits, scales = scene.logit_opacities.clone(), scene.log_scales.clone()
    logits[:100], scales[300:] = -torch.inf, 80.0
    hard = scene.with_tensors({"logit_opacities": logits, "log_scales": scales}, {})
    sampled = sample_members(hard, cells_of([100, 200, 100]))
    assert bool((sampled.part.counts >= 1).all())
    assert bool((sampled.part.counts <= MOST_SAMPLED).all())
    assert bool(((sampled.rates > 0) & (sampled.rates <= 1)).all())
