"""The robust frame, which a minority of outliers cannot move, and the Morton curve."""

import math
from dataclasses import replace

import pytest
import torch

import oracles
from cvtgs.math.frames import (
    BITS,
    RobustFrame,
    group_radius,
    morton_order,
    robust_frame,
    unit_vectors,
)

UNIT = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=1.0)


def test_frame_of_five_points_on_a_line():
    points = torch.tensor([[float(x), 0.0, 0.0] for x in (0, 1, 2, 3, 10)])
    frame = robust_frame(points)
    assert frame.center.tolist() == [2.0, 0.0, 0.0]
    assert frame.radius == 2.0  # distances 0 1 1 2 8; the fourth of five


def test_contraction_of_known_points():
    points = torch.tensor([[0.5, 0, 0], [0, 2, 0], [0, 0, -4.0]])
    wanted = [[0.5, 0, 0], [0, 1 + math.log(2), 0], [0, 0, -1 - math.log(4)]]
    torch.testing.assert_close(UNIT.contract(points), torch.tensor(wanted).double())


def test_one_point_and_coincident_points():
    for count in (1, 7):
        frame = robust_frame(torch.full((count, 3), 3.0))
        assert frame.center.tolist() == [3.0, 3.0, 3.0]
        assert frame.radius == 1.0


def test_mostly_coincident_points_take_a_quantile_of_the_others():
    points = torch.zeros(10, 3)
    points[9, 0] = 4.0
    assert robust_frame(points).radius == 4.0
    points = torch.zeros(100, 3)
    points[90:, 0] = torch.arange(1, 11)
    points[99, 0] = 1e9
    assert robust_frame(points).radius == 7.0


@pytest.mark.parametrize("far", [1e6, 1e30])
def test_flyaways_do_not_move_the_frame(far):
    points = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0))
    clean = robust_frame(points)
    flown = points.clone()
    flown[:5] = far
    frame = robust_frame(flown)
    assert float((frame.center - clean.center).abs().amax()) < 0.02
    assert frame.radius == pytest.approx(clean.radius, rel=0.02)


def test_permutation_does_not_change_the_frame():
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(1))
    shuffled = points[torch.randperm(500, generator=torch.Generator().manual_seed(2))]
    first, second = robust_frame(points), robust_frame(shuffled)
    assert torch.equal(first.center, second.center)
    assert first.radius == second.radius


def test_geo_referenced_points_keep_their_detail():
    local = torch.randn(200, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    offset = torch.tensor([6e6, -6e6, 6e6], dtype=torch.float64)
    near = robust_frame(local).normalize(local)
    far = robust_frame(1e-2 * local + offset).normalize(1e-2 * local + offset)
    torch.testing.assert_close(near, far, rtol=0, atol=1e-5)


def test_contraction_keeps_directions_and_order_and_shrinks():
    g = torch.Generator().manual_seed(4)
    directions = torch.nn.functional.normalize(
        torch.randn(300, 3, generator=g, dtype=torch.float64), dim=1
    )
    distances = torch.logspace(-3, 9, 300, dtype=torch.float64)
    contracted = UNIT.contract(distances[:, None] * directions)
    lengths = torch.linalg.vector_norm(contracted, dim=1)
    assert bool((lengths.diff() > 0).all())
    assert bool((lengths <= distances + 1e-12).all())
    assert float(lengths[-1]) == pytest.approx(1 + 9 * math.log(10))
    torch.testing.assert_close(contracted / lengths[:, None], directions)


def test_partial_contraction_shrinks_the_logarithm_of_the_distance():
    points = torch.tensor([[0.0, 20.0, 0.0], [0.3, 0.1, 0.0]])
    assert UNIT.contract(points, 0.0).equal(points.double())
    whole, half = UNIT.contract(points)[0, 1], UNIT.contract(points, 0.5)[0, 1]
    torch.testing.assert_close(half.square(), 20.0 * whole)
    assert UNIT.contract(points, 0.5)[1].equal(points[1].double())


def test_contraction_is_finite_for_float32_flyaways():
    points = torch.tensor([[1e30, -1e30, 0.0], [3e38, 0.0, 0.0]])
    lengths = torch.linalg.vector_norm(UNIT.contract(points), dim=1)
    wanted = [1 + math.log(1e30 * math.sqrt(2)), 1 + math.log(3e38)]
    assert lengths.tolist() == pytest.approx(wanted, rel=0.2)


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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_may_lie_at_both_ends_of_the_range_of_numbers(dtype):
    most = torch.finfo(dtype).max
    points = most * torch.tensor([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0], [-0.5, 0, 0]], dtype=dtype)
    assert morton_order(points).tolist() == [0, 3, 1, 2]


@pytest.mark.parametrize("size", [1e-30, 1e-20, 1.0, 1e20, 1e30])
def test_vectors_of_any_length_become_unit_vectors(size):
    found = unit_vectors(size * torch.tensor([[1.0, -2.0, 2.0], [0.0, 0.0, -1.0]]))
    wanted = torch.tensor([[1 / 3, -2 / 3, 2 / 3], [0.0, 0.0, -1.0]])
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)


def test_neighbours_on_the_curve_are_near():
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(1))
    walked = points[morton_order(points)]
    step = torch.linalg.vector_norm(walked.diff(dim=0), dim=1).mean()
    before = torch.linalg.vector_norm(points.diff(dim=0), dim=1).mean()
    assert float(step) < 0.2 * float(before)


def test_one_group_is_as_wide_as_the_scene_and_groups_far_apart_are_not():
    points = torch.randn(4000, 3, generator=torch.Generator().manual_seed(0))
    frame = robust_frame(points)
    assert group_radius(points) > frame.radius
    for count, distance in ((2, 50.0), (10, 1000.0)):
        shifts = distance * torch.arange(count).repeat_interleave(4000 // count)
        apart = points + shifts[:, None] * torch.tensor([1.0, 0.0, 0.0])
        assert frame.radius < group_radius(apart) < 8 * frame.radius
        far = replace(robust_frame(apart), group_radius=group_radius(apart))
        assert far.view_radius == far.group_radius < 0.3 * far.radius
    assert robust_frame(points).view_radius == frame.radius


@pytest.mark.parametrize("points", [torch.zeros(600, 3), torch.rand(511, 3)])
def test_few_or_coincident_points_have_no_groups(points):
    assert group_radius(points) == math.inf


def test_the_radius_of_groups_does_not_depend_on_the_order_of_rows():
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(6000, 3, generator=generator)
    points[:, 0] += 70.0 * torch.arange(6).repeat_interleave(1000)
    wanted = group_radius(points)
    for _ in range(3):
        order = torch.randperm(6000, generator=generator)
        assert group_radius(points[order]) == wanted


@pytest.mark.parametrize(("radius", "is_far"), [(5.0, True), (5.1, False)])
def test_float32_points_are_far_from_the_origin_from_a_thousand_radii_on(radius, is_far):
    center = torch.tensor([0.0, -5000.0, 0.0], dtype=torch.float64)
    frame = RobustFrame(center=center, radius=radius)
    origin = frame.far_origin(torch.zeros(1, 3))
    assert (None if origin is None else origin.tolist()) == (center.tolist() if is_far else None)
    assert frame.far_origin(torch.zeros(1, 3, dtype=torch.float64)) is None
