"""Lloyd's algorithm: centroids, energies and when it stops."""

import math

import pytest
import torch

from cvtgs.cvt import fill_empty_cells, lloyd, nearest_scipy, stratified_seeds, weighted_seeds
from cvtgs.cvt.tessellate import centroids, weighted_sums
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.frames import morton_order

BACKENDS = {"scipy": nearest_scipy}


def weighted_cloud(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    points = torch.randn(count, 3, generator=g, dtype=torch.float64).pow(3)
    points = points[morton_order(points)]
    return points, torch.exp(torch.randn(count, generator=g, dtype=torch.float64))


def start(points: torch.Tensor, weights: torch.Tensor, count: int, seeding: str) -> torch.Tensor:
    if seeding == "weighted":
        return points[weighted_seeds(weights, count, torch.Generator().manual_seed(0))]
    return points[stratified_seeds(weights, count)[0]]


def test_centroid_of_weighted_points():
    points = torch.tensor([[0.0, 0.0], [4.0, 8.0], [1.0, 1.0]])
    fallback = torch.tensor([[9.0, 9.0], [5.0, 6.0], [7.0, 7.0]])
    totals, sums = weighted_sums(points, torch.tensor([3.0, 1.0, 0.0]), torch.tensor([2, 2, 0]), 3)
    assert centroids(totals, sums, fallback).tolist() == [[9.0, 9.0], [5.0, 6.0], [1.0, 2.0]]


def test_energies_of_three_points_on_a_line():
    points = torch.tensor([[0.0], [2.0], [10.0]])
    result = lloyd(
        points, torch.tensor([1.0, 3.0, 1.0]), torch.tensor([[0.0], [10.0]]),
        nearest=nearest_scipy, iterations=5, tolerance=0.0,
    )  # fmt: skip
    assert result.sites.tolist() == [[1.5], [10.0]]
    assert result.energies == (12.0, 3.0, 3.0)


def test_zero_iterations_keep_the_sites():
    points, weights = weighted_cloud(50)
    result = lloyd(points, weights, points[:5], nearest=nearest_scipy, iterations=0, tolerance=0.0)
    assert torch.equal(result.sites, points[:5])
    assert result.energies == ()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("seeding", ["stratified", "weighted"])
@pytest.mark.parametrize(("count", "sites"), [(300, 7), (600, 100), (600, 550), (50, 1)])
def test_energy_never_rises(backend, seeding, count, sites):
    points, weights = weighted_cloud(count, seed=sites)
    result = lloyd(
        points, weights, start(points, weights, sites, seeding),
        nearest=BACKENDS[backend], iterations=12, tolerance=0.0,
    )  # fmt: skip
    energies = torch.tensor(result.energies, dtype=torch.float64)
    assert len(energies) >= 2
    assert bool((energies.diff() <= 1e-12 * energies[0]).all())
    assert float(energies[-1]) < float(energies[0])


def test_sites_without_points_stay():
    points = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    sites = torch.tensor([[0.0], [100.0]], dtype=torch.float64)
    result = lloyd(
        points, torch.ones(2).double(), sites, nearest=nearest_scipy, iterations=3, tolerance=0.0
    )
    assert result.sites.tolist() == [[0.5], [100.0]]


def test_stops_when_the_energy_stalls():
    points, weights = weighted_cloud(2000)
    sites = start(points, weights, 50, "stratified")
    counts = []
    for tolerance in (0.5, 0.02, 0.0):
        told: list[int] = []
        result = lloyd(
            points, weights, sites, nearest=nearest_scipy, iterations=40, tolerance=tolerance,
            on_iteration=told.append,
        )  # fmt: skip
        assert told == list(range(1, len(told) + 1))
        assert len(told) <= len(result.energies)
        counts.append(len(told))
    assert counts[0] < counts[1] < counts[2]


def test_sites_move_towards_heavy_points():
    points = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    result = lloyd(
        points, torch.tensor([1.0, 1e6], dtype=torch.float64), points[:1],
        nearest=nearest_scipy, iterations=2, tolerance=0.0,
    )  # fmt: skip
    assert result.sites.item() == pytest.approx(1.0, abs=2e-6)


def test_the_most_expensive_point_fills_the_empty_cell():
    labels = torch.tensor([0, 0, 0, 2, 2])
    squared = torch.tensor([1.0, 9.0, 4.0, 6.0, 8.0])
    weights = torch.tensor([1.0, 1.0, 3.0, 1.0, 1.0])
    new, cost, refilled = fill_empty_cells(labels, weights, squared, 3)
    assert new.tolist() == [0, 0, 1, 2, 2]  # 3 * 4 is the largest cost
    assert cost.tolist() == [1.0, 9.0, 0.0, 6.0, 8.0]
    assert refilled == 1


def test_a_cell_of_one_keeps_its_point_whatever_its_cost():
    labels, squared = torch.tensor([0, 1, 1]), torch.tensor([100.0, 1.0, 2.0])
    assert fill_empty_cells(labels, torch.ones(3), squared, 3)[0].tolist() == [0, 1, 2]


def test_without_empty_cells_the_input_is_returned():
    labels, squared = torch.tensor([1, 0]), torch.ones(2)
    found = fill_empty_cells(labels, torch.ones(2), squared, 2)
    assert found[0] is labels
    assert found[1] is squared
    assert found[2] == 0


@pytest.mark.parametrize("count", [2, 40, 199, 200])
@pytest.mark.parametrize("filled", [1, 2, 20])
def test_no_cell_is_empty_and_the_energy_does_not_rise(count, filled):
    g = torch.Generator().manual_seed(count + filled)
    labels = torch.randint(0, min(filled, count), (200,), generator=g)
    labels[: min(filled, count)] = torch.arange(min(filled, count))
    squared = torch.rand(200, generator=g, dtype=torch.float64)
    weights = torch.rand(200, generator=g, dtype=torch.float64)
    before = labels.clone(), squared.clone()
    new, cost, refilled = fill_empty_cells(labels, weights, squared, count)
    assert torch.equal(torch.unique(new), torch.arange(count))
    assert refilled == count - min(filled, count)
    assert float((weights * cost).sum()) <= float((weights * squared).sum())
    assert int((new != labels).sum()) == refilled
    for cell in range(min(filled, count)):  # each cell keeps its cheapest point
        rows = (labels == cell).nonzero()[:, 0]
        cheapest = rows[(weights[rows] * squared[rows]).argmin()]
        assert new[cheapest] == cell
    assert torch.equal(labels, before[0])
    assert torch.equal(squared, before[1])


@pytest.mark.parametrize("count", [1, 10, 9_999, 10_000])
def test_ten_thousand_coincident_points(count):
    labels = torch.zeros(10_000, dtype=torch.int64)
    new, _, refilled = fill_empty_cells(labels, torch.ones(10_000), torch.zeros(10_000), count)
    assert torch.equal(torch.unique(new), torch.arange(count))
    assert refilled == count - 1


def test_weights_of_zero():
    new, _, _ = fill_empty_cells(
        torch.zeros(6, dtype=torch.int64), torch.zeros(6), torch.ones(6), 4
    )
    assert torch.unique(new).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("wrong", [-0.1, math.nan, "zz"])
def test_the_tolerance_is_checked(wrong):
    points = torch.zeros(2, 1)
    with pytest.raises(InvalidArgumentError, match="tolerance must be a finite number of at"):
        lloyd(points, torch.ones(2), points, nearest=nearest_scipy, iterations=1, tolerance=wrong)
