"""Weights and embedded positions of Gaussians in the tessellation."""

import math
from inspect import unwrap

import pytest
import torch

from cvtgs.analysis import perspective_falloff
from cvtgs.cvt import embed, gaussian_weights, tessellation_weights
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.frames import RobustFrame, robust_frame
from cvtgs.math.spherical_harmonics import SH_C0

FRAME = RobustFrame(center=torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), radius=2.0)


def test_falloff_beyond_the_radius_is_the_inverse_square():
    means = torch.tensor([[1.0, 0, 0], [2.9, 0, 0], [1, 4, 0], [1, 0, -20]])
    assert perspective_falloff(FRAME.distances(means)).tolist() == pytest.approx(
        [1.0, 1.0, 0.25, 0.01]
    )


def test_weights_have_mean_one():
    opacities, areas = torch.tensor([0.2, 0.6]), torch.tensor([1.0, 3.0])
    by_mass = tessellation_weights(opacities, areas, area_power=1.0, floor=0.0)
    by_opacity = tessellation_weights(opacities, areas * 7, area_power=0.0, floor=0.0)
    assert by_mass.tolist() == pytest.approx([0.2, 1.8])
    assert by_opacity.tolist() == pytest.approx([0.5, 1.5])


def test_embedding_of_known_points():
    means, sh0 = torch.tensor([[3.0, 0, 0], [1, 8, 0]]), torch.zeros(2, 1, 3)
    plain = embed(means, sh0, frame=FRAME, color=0.0)
    assert plain.tolist() == [[1.0, 0, 0], [0, 4, 0]]
    pulled = embed(means, sh0, frame=FRAME, color=0.0, contraction=1.0)
    assert pulled.tolist() == [[1.0, 0, 0], [0, pytest.approx(1 + math.log(4)), 0]]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("color", "d"), [(0.0, 3), (0.05, 6)])
def test_embedding_has_six_coordinates_with_colour(color, d, dtype):
    means, sh0 = torch.zeros(4, 3, dtype=dtype), torch.ones(4, 1, 3, dtype=dtype)
    points = embed(means, sh0, frame=FRAME, color=color, contraction=1.0)
    assert points.shape == (4, d)
    assert points.dtype == dtype


@pytest.mark.parametrize("contraction", [0.0, 0.5, 1.0])
def test_embedding_in_chunks_gives_the_same(monkeypatch, contraction):
    g = torch.Generator().manual_seed(0)
    means, sh0 = torch.randn(100, 3, generator=g), torch.randn(100, 1, 3, generator=g)
    whole = embed(means, sh0, frame=FRAME, color=0.1, contraction=contraction)
    monkeypatch.setitem(unwrap(embed).__globals__, "CHUNK", 7)
    assert torch.equal(embed(means, sh0, frame=FRAME, color=0.1, contraction=contraction), whole)


def test_detail_far_from_the_origin_survives():
    g = torch.Generator().manual_seed(0)
    local = 1e-2 * torch.randn(50, 3, generator=g, dtype=torch.float64)
    sh0 = torch.zeros(50, 1, 3, dtype=torch.float64)
    near, far = (
        embed(means, sh0, frame=robust_frame(means), contraction=1.0)
        for means in (local, local + 6e6)
    )
    torch.testing.assert_close(near, far, rtol=0, atol=1e-6)


def test_colour_is_scaled():
    sh0 = torch.zeros(2, 1, 3, dtype=torch.float64)
    sh0[1, 0] = torch.tensor([1.0, -1.0, 0.5])
    points = embed(torch.zeros(2, 3).double(), sh0, frame=FRAME, color=0.1)
    wanted = 0.1 * 0.28209479177387814 * torch.tensor([1.0, -1.0, 0.5], dtype=torch.float64)
    torch.testing.assert_close(points[1, 3:] - points[0, 3:], wanted)


def test_extreme_colours_hardly_separate_points():
    sh0 = torch.tensor([[[1e4, -1e4, 0.0]], [[-1e30, 1e30, 0.0]]])
    points = embed(torch.zeros(2, 3), sh0, frame=FRAME, color=0.05)
    assert float((points[0] - points[1]).abs().amax()) < 0.2


def test_colours_are_clamped_at_black_and_at_one_and_a_half():
    sh0 = torch.tensor([[[-2.0, 0.8, 3.0]]]).double() / SH_C0
    points = embed(torch.zeros(1, 3).double(), sh0, frame=FRAME, color=0.1)
    assert points[0, 3:].tolist() == pytest.approx([-0.05, 0.08, 0.1])


@pytest.mark.parametrize("size", [1e-300, 1.0, 1e300])
@pytest.mark.parametrize("power", [0.9, 2.0])  # squares of such areas overflow
def test_the_unit_of_area_does_not_matter(size, power):
    areas = torch.rand(100, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    plain = tessellation_weights(areas, areas, area_power=power, floor=1e-3)
    scaled = tessellation_weights(areas, size * areas, area_power=power, floor=1e-3)
    torch.testing.assert_close(scaled, plain, rtol=1e-12, atol=0)


def test_no_weight_is_below_the_floor():
    areas = torch.tensor([0.0, 1e-12, 1.0, 3.0], dtype=torch.float64)
    weights = tessellation_weights(torch.ones(4), areas, area_power=1.0, floor=0.01)
    assert weights.tolist() == pytest.approx([0.01, 0.01, 1.0, 3.0])


def test_gaussians_without_opacity_and_area_weigh_the_same():
    zero = torch.zeros(3)
    assert tessellation_weights(zero, zero, area_power=1.0, floor=0.0).tolist() == [1.0, 1.0, 1.0]


def test_flyaways_have_almost_no_weight():
    means = torch.randn(100, 3, generator=torch.Generator().manual_seed(0))
    means[0] = 1e30
    factors = perspective_falloff(robust_frame(means).distances(means))
    assert 0 <= float(factors[0]) < 1e-50
    assert bool(factors.isfinite().all())


@pytest.mark.parametrize("contraction", [0.0, 0.5, 1.0])
def test_flyaways_do_not_overflow(contraction):
    means = torch.tensor([[3e38, -3e38, 0.0], [1e-10, 0, 0], [0, 0, 0]])
    frame = RobustFrame(center=torch.zeros(3, dtype=torch.float64), radius=1e-10)
    points = embed(means, frame=frame, contraction=contraction)
    assert bool(points.isfinite().all())
    assert points[1:].tolist() == [[1.0, 0, 0], [0, 0, 0]]
    assert float(points[0, 0]) > 1.4


def test_shapes_that_do_not_fit_are_errors():
    means, ones = torch.zeros(4, 3), torch.ones(4)
    for call, text in (
        (lambda: embed(means[:, :2], frame=FRAME), "means must be a tensor of floats of shape (n, "
         "3), found torch.float32 of shape (4, 2)."),
        (lambda: embed(means, torch.zeros(5, 1, 3), frame=FRAME), "sh0 must be a tensor of floats "
         "of shape (4, 1, 3) or None, found torch.float32 of shape (5, 1, 3)."),
        (lambda: embed(means, frame=FRAME, contraction=float("nan")), "contraction must be a "
         "number from 0 to 1, found nan."),
        (lambda: embed(means, frame=2.0), "frame must be of type RobustFrame, found float."),
        (lambda: tessellation_weights(ones, ones[1:], area_power=1.0, floor=0.0), "areas must be a "
         "tensor of floats of shape (4,), found torch.float32 of shape (3,)."),
    ):  # fmt: skip
        with pytest.raises(InvalidArgumentError) as caught:
            call()
        assert str(caught.value) == text


@pytest.mark.parametrize("wrong", [-0.1, math.nan, math.inf, None, "0.1"])
def test_numbers_of_embeddings_and_weights_are_checked(wrong):
    with pytest.raises(InvalidArgumentError, match="color must be a finite number of at least 0"):
        embed(torch.zeros(2, 3), torch.zeros(2, 1, 3), frame=FRAME, color=wrong)
    with pytest.raises(InvalidArgumentError, match="area_power must be a finite number of at"):
        gaussian_weights(torch.ones(2), torch.ones(2), area_power=wrong)


def test_weights_of_nothing_are_empty_and_floors_are_not_negative():
    none = torch.zeros(0)
    assert len(tessellation_weights(none, none, area_power=0.5, floor=0.1)) == 0
    for floor in (-1.0, float("nan")):
        with pytest.raises(InvalidArgumentError, match="floor must be"):
            tessellation_weights(torch.ones(2), torch.ones(2), area_power=0.5, floor=floor)
