"""The Morton curve against interleaved bits."""

import pytest
import torch

import oracles
from cvtgs.math.morton import BITS, morton_order


def oracle_order(points: torch.Tensor) -> list[int]:
    low = points.amin(dim=0)
    side = float((points.amax(dim=0) - low).amax()) or 1.0
    steps = ((points - low) / side * (2**BITS - 1)).to(torch.int64).tolist()
    codes = [oracles.morton_code(step, BITS) for step in steps]
    return sorted(range(len(codes)), key=lambda row: codes[row])


def test_corners_of_a_cube():
    corners = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    walked = corners[morton_order(corners)].tolist()
    assert walked == [[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]


def test_one_point():
    assert morton_order(torch.ones(1, 3)).tolist() == [0]


def test_coincident_points_keep_their_order():
    assert morton_order(torch.full((5, 3), 7.0)).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [2, 100, 1000])
def test_random_points_equal_the_oracle(count, dtype):
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(count), dtype=dtype)
    assert morton_order(points).tolist() == oracle_order(points)


def test_points_on_a_line_come_in_order():
    points = torch.zeros(1000, 3, dtype=torch.float64)
    points[:, 1] = torch.randperm(1000, generator=torch.Generator().manual_seed(0)).double()
    assert points[morton_order(points), 1].tolist() == list(range(1000))


def test_neighbours_on_the_curve_are_near():
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(1))
    walked = points[morton_order(points)]
    step = torch.linalg.vector_norm(walked.diff(dim=0), dim=1).mean()
    before = torch.linalg.vector_norm(points.diff(dim=0), dim=1).mean()
    assert float(step) < 0.2 * float(before)
