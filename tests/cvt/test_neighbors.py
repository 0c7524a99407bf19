"""The nearest other sites of every site against plain comparison."""

import pytest
import torch

from cvtgs.cvt import nearest_neighbors


def test_three_sites_on_a_line():
    sites = torch.tensor([[0.0], [1.0], [9.0]])
    assert nearest_neighbors(sites, 2).tolist() == [[1, 2], [0, 2], [1, 0]]


@pytest.mark.parametrize(("m", "count"), [(1, 8), (2, 8), (9, 8), (300, 5)])
def test_neighbours_are_the_nearest_others(m, count):
    sites = torch.randn(m, 3, generator=torch.Generator().manual_seed(m), dtype=torch.float64)
    found = nearest_neighbors(sites, count)
    assert found.shape == (m, min(count, m - 1))
    distances = (sites[:, None] - sites[None]).norm(dim=2)
    distances.fill_diagonal_(torch.inf)
    wanted = distances.sort(dim=1).values[:, : found.shape[1]]
    torch.testing.assert_close(distances.gather(1, found), wanted)


def test_coincident_sites_never_name_themselves():
    sites = torch.zeros(50, 3)
    found = nearest_neighbors(sites, 4)
    assert found.shape == (50, 4)
    assert not bool((found == torch.arange(50)[:, None]).any())
