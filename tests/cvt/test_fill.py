"""Empty cells get a point, and the energy does not rise for it."""

import pytest
import torch

from cvtgs.cvt import fill_empty_cells


def test_the_dearest_point_moves_and_the_cheapest_stays():
    labels = torch.tensor([0, 0, 0, 2, 2])
    squared = torch.tensor([1.0, 9.0, 4.0, 6.0, 8.0])
    weights = torch.tensor([1.0, 1.0, 3.0, 1.0, 1.0])
    new, cost, refilled = fill_empty_cells(labels, weights, squared, 3)
    assert new.tolist() == [0, 0, 1, 2, 2]  # 3 * 4 is the largest cost
    assert cost.tolist() == [1.0, 9.0, 0.0, 6.0, 8.0]
    assert refilled == 1


def test_a_cell_of_one_keeps_its_point_however_dear():
    labels, squared = torch.tensor([0, 1, 1]), torch.tensor([100.0, 1.0, 2.0])
    assert fill_empty_cells(labels, torch.ones(3), squared, 3)[0].tolist() == [0, 1, 2]


def test_nothing_to_fill_gives_the_input():
    labels, squared = torch.tensor([1, 0]), torch.ones(2)
    found = fill_empty_cells(labels, torch.ones(2), squared, 2)
    assert found[0] is labels
    assert found[1] is squared
    assert found[2] == 0


@pytest.mark.parametrize("count", [2, 40, 199, 200])
@pytest.mark.parametrize("filled", [1, 2, 20])
def test_no_cell_is_empty_and_no_energy_is_gained(count, filled):
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
    for cell in range(min(filled, count)):  # the cheapest point of each cell is still there
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
