"""First sites: distinct, exactly as many as asked for, and fair by weight."""

from inspect import unwrap

import pytest
import torch

from cvtgs.cvt import stratified_seeds, weighted_seeds
from cvtgs.cvt.tessellate import MIN_SAMPLES, sample_points


def weights_of(kind: str, count: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(count + 1)
    uniform = torch.rand(count, generator=g, dtype=torch.float64)
    if kind == "heavy-tailed":
        return torch.exp(4 * torch.randn(count, generator=g, dtype=torch.float64))
    if kind == "mostly zero":
        return torch.where(uniform < 0.9, 0.0, uniform).index_fill(0, torch.tensor([0]), 0.5)
    if kind == "one heavy":
        return torch.cat([torch.full((count - 1,), 1e-9), torch.tensor([1e9])]).double()
    if kind == "denormal":
        return uniform * 1e-310
    return {"uniform": uniform, "equal": uniform * 0 + 0.1, "zero": uniform * 0}[kind]


KINDS = ["uniform", "equal", "zero", "heavy-tailed", "mostly zero", "one heavy", "denormal"]
SIZES = [(1, 1), (2, 1), (2, 2), (7, 3), (100, 1), (100, 99), (100, 100), (1000, 37), (999, 500)]


def drawn(weights: torch.Tensor, count: int, seed: int = 0) -> torch.Tensor:
    return weighted_seeds(weights, count, torch.Generator().manual_seed(seed))


def test_equal_weights_are_taken_at_equal_steps():
    rows, shares = stratified_seeds(torch.ones(12), 4)
    assert rows.tolist() == [1, 4, 7, 10]
    assert shares.tolist() == [3.0] * 4


def test_heavy_points_are_always_taken_and_the_rest_is_stratified():
    rows, shares = stratified_seeds(torch.tensor([1.0, 50.0, 1.0, 1.0, 20.0, 1.0]), 4)
    assert rows.tolist() == [0, 1, 3, 4]
    assert shares.tolist() == [2.0, 50.0, 2.0, 20.0]


def test_a_point_of_one_and_a_half_steps_is_always_taken_for_itself():
    rows, shares = stratified_seeds(torch.tensor([1.0, 3.0, 1.0, 1.0, 1.0, 1.0]), 4)
    assert rows.tolist() == [0, 1, 3, 5]
    assert shares.tolist() == pytest.approx([5 / 3, 3.0, 5 / 3, 5 / 3])


def test_points_without_weight_are_taken_evenly():
    assert stratified_seeds(torch.zeros(9), 3)[0].tolist() == [1, 4, 7]


@pytest.mark.parametrize("kind", KINDS)
def test_seeds_are_distinct_and_of_the_exact_count(kind, subtests):
    for total, count in SIZES:
        weights = weights_of(kind, total)
        for rows in (stratified_seeds(weights, count)[0], drawn(weights, count)):
            with subtests.test(total=total, count=count):
                assert rows.shape == (count,)
                assert bool((rows.diff() > 0).all())
                assert int(rows[0]) >= 0
                assert int(rows[-1]) < total


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("zero", "denormal")])
def test_shares_sum_to_the_total_weight(kind, subtests):
    for total, count in SIZES:
        weights = weights_of(kind, total)
        _, shares = stratified_seeds(weights, count)
        with subtests.test(total=total, count=count):
            assert bool((shares >= 0).all())
            assert float(shares.sum()) == pytest.approx(float(weights.sum()), rel=1e-9)


def test_points_of_a_sample_weigh_as_much_as_those_that_they_represent(monkeypatch):
    monkeypatch.setitem(unwrap(sample_points).__globals__, "MIN_SAMPLES", 1)
    points, weights = torch.arange(8.0)[:, None], torch.tensor([1.0] * 7 + [9.0])
    sample, shares = sample_points(points, weights, 3)
    assert sample[:, 0].tolist() == [1.0, 5.0, 7.0]
    assert shares.tolist() == [3.5, 3.5, 9.0]


def test_points_above_one_step_are_always_taken():
    weights = weights_of("heavy-tailed", 1000)
    for count in (10, 100, 500):
        rows, _ = stratified_seeds(weights, count)
        certain = (weights >= weights.sum() / count).nonzero()[:, 0]
        assert set(certain.tolist()) <= set(rows.tolist())


def test_every_stretch_of_the_curve_gets_its_share():
    weights = weights_of("uniform", 10_000)
    rows, _ = stratified_seeds(weights, 500)
    running = weights.cumsum(0)[rows] / weights.sum() * 500
    wanted = torch.arange(500, dtype=torch.float64) + 0.5
    assert float((running - wanted).abs().amax()) < 1.0


def test_weights_of_zero_are_drawn_last():
    weights = torch.tensor([0.0, 1.0, 0.0, 2.0, 0.0])
    assert drawn(weights, 2).tolist() == [1, 3]
    assert {1, 3} <= set(drawn(weights, 4).tolist())


def test_draws_follow_the_weights():
    weights = torch.tensor([1.0, 3.0])
    hits = sum(int(drawn(weights, 1, seed)) for seed in range(2000))
    assert hits / 2000 == pytest.approx(0.75, abs=0.04)


def test_the_same_seed_gives_the_same_draw():
    weights = weights_of("uniform", 1000)
    assert torch.equal(drawn(weights, 50, 7), drawn(weights, 50, 7))
    assert not torch.equal(drawn(weights, 50, 7), drawn(weights, 50, 8))


def test_stratified_seeds_are_deterministic():
    weights = weights_of("uniform", 1000)
    first, second = stratified_seeds(weights, 50), stratified_seeds(weights, 50)
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


def test_the_unit_of_weight_does_not_matter():
    weights = weights_of("uniform", 1000)
    assert torch.equal(stratified_seeds(weights, 77)[0], stratified_seeds(2.0**40 * weights, 77)[0])


def test_weights_are_not_changed():
    weights = weights_of("uniform", 100)
    before = weights.clone()
    stratified_seeds(weights, 10)
    drawn(weights, 10)
    assert torch.equal(weights, before)


@pytest.mark.parametrize(
    ("total", "used"),
    [(2 * MIN_SAMPLES, 2 * MIN_SAMPLES), (2 * MIN_SAMPLES + 2, MIN_SAMPLES)],
)
def test_points_are_sampled_only_if_that_leaves_out_half(total, used):
    points, weights = sample_points(torch.zeros(total, 1), torch.ones(total), 1)
    assert len(points) == len(weights) == used
    assert float(weights.sum()) == total


def test_seeds_are_the_middles_of_equal_steps():
    assert stratified_seeds(torch.ones(99), 2)[0].tolist() == [24, 74]  # 24.75 and 74.25
