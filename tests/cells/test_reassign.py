"""Members that stay in their group, however much better they fit another one."""

import pytest
import torch

from cvtgs.cells import Moments, reassign
from cvtgs.config import AllocationConfig


def moments_at(places: list[float]) -> Moments:
    ones = torch.ones(len(places), dtype=torch.float64)
    means = torch.nn.functional.pad(torch.tensor(places, dtype=torch.float64)[None], (0, 0, 0, 2))
    shapes = torch.tensor([1.0, 0, 0, 1, 0, 1]).double()[:, None].expand(6, len(places))
    return Moments(ones, ones, ones, means, shapes, 0 * means, means[:0])


@pytest.mark.parametrize(
    ("must_stay", "wanted"),
    [(None, [1, 0, 1, 1]), ([True, False], [1, 0, 1, 1]), ([False, True], [1, 1, 1, 1])],
)
def test_the_best_fitting_member_of_a_group_stays(must_stay, wanted):
    """Group 0 is far from all of its members, of which the second is the nearest."""
    found = reassign(
        moments_at([0.0, 0.2, 0.1, 0.3]),
        torch.tensor([0, 0, 0, 1]),
        moments_at([9.0, 0.1]),
        torch.tensor([[1], [0]]),
        AllocationConfig(),
        must_stay=None if must_stay is None else torch.tensor(must_stay),
    )
    assert found.tolist() == wanted
