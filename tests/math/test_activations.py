"""Between stored and readable parameters, at the extremes too."""

import math

import pytest
import torch

import oracles
from cvtgs.math import parameters

DTYPES = [torch.float32, torch.float64]
INF = float("inf")


def test_opacity_of_known_logits():
    logits = torch.tensor([0.0, math.log(3.0), -math.log(3.0)], dtype=torch.float64)
    torch.testing.assert_close(
        parameters.opacity_from_logit(logits),
        torch.tensor([0.5, 0.75, 0.25], dtype=torch.float64),
    )


def test_depth_of_half_opaque_is_log_two():
    depth = parameters.optical_depth_from_logit(torch.zeros(1, dtype=torch.float64))
    assert depth.item() == pytest.approx(math.log(2.0), rel=1e-15)


def test_zero_divided_by_zero_is_zero():
    result = parameters.divide(torch.tensor([0.0, 6.0]), torch.tensor([0.0, 4.0]))
    assert result.tolist() == [0.0, 1.5]


@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 3)])
@pytest.mark.parametrize(
    "function",
    [
        parameters.opacity_from_logit,
        parameters.logit_from_opacity,
        parameters.clamp_logits,
        parameters.optical_depth_from_logit,
        parameters.opacity_from_optical_depth,
        parameters.positive_log,
        parameters.logit_from_optical_depth,
    ],
)
def test_shape_and_dtype_are_kept(function, shape):
    for dtype in DTYPES:
        result = function(torch.full(shape, 0.25, dtype=dtype))
        assert result.shape == shape
        assert result.dtype == dtype


@pytest.mark.parametrize("dtype", DTYPES)
def test_extreme_logits_stay_strictly_inside(dtype):
    logits = torch.tensor([-INF, -700.0, -20.0, 20.0, 700.0, INF], dtype=dtype)
    opacities = parameters.opacity_from_logit(logits)
    assert bool(((opacities > 0) & (opacities < 1)).all())
    wanted = [oracles.clamped_opacity(v) for v in (-700.0, -700.0, -20.0, 20.0, 700.0, 700.0)]
    torch.testing.assert_close(opacities, torch.tensor(wanted, dtype=dtype), rtol=1e-6, atol=0)
    depths = parameters.optical_depth_from_logit(logits)
    assert bool(depths.isfinite().all())
    assert depths[0].item() == pytest.approx(1e-6, rel=1e-5)
    assert depths[-1].item() == pytest.approx(-math.log(1e-6), rel=1e-5)


@pytest.mark.parametrize("dtype", DTYPES)
def test_logit_of_extreme_opacities_is_finite(dtype):
    logits = parameters.logit_from_opacity(torch.tensor([0.0, 1.0], dtype=dtype))
    assert logits[0].item() == pytest.approx(-parameters.LOGIT_LIMIT, abs=0.02)
    assert logits[1].item() == pytest.approx(parameters.LOGIT_LIMIT, abs=0.02)


def test_nan_is_not_hidden():
    assert bool(parameters.clamp_logits(torch.tensor([float("nan")])).isnan())


@pytest.mark.parametrize("dtype", DTYPES)
def test_logit_of_extreme_depths(dtype):
    depths = torch.tensor([0.0, 1e-30, 1e3, 1e30, INF], dtype=dtype)
    limit = parameters.LOGIT_LIMIT
    torch.testing.assert_close(
        parameters.logit_from_optical_depth(depths),
        torch.tensor([-limit, -limit, limit, limit, limit], dtype=dtype),
    )


def test_positive_log_of_zero_is_finite():
    for dtype in DTYPES:
        smallest = math.log(torch.finfo(dtype).tiny)
        logs = parameters.positive_log(torch.zeros(1, dtype=dtype))
        assert logs.item() == pytest.approx(smallest, rel=1e-6)


def test_opacity_round_trip():
    opacities = torch.linspace(1e-6, 1 - 1e-6, 1001, dtype=torch.float64)
    back = parameters.opacity_from_logit(parameters.logit_from_opacity(opacities))
    torch.testing.assert_close(back, opacities, rtol=1e-9, atol=1e-12)


def test_depth_round_trip_keeps_digits_at_both_ends():
    logits = torch.linspace(-13.8, 13.8, 1001, dtype=torch.float64)
    depths = parameters.optical_depth_from_logit(logits)
    torch.testing.assert_close(
        parameters.logit_from_optical_depth(depths), logits, rtol=1e-9, atol=1e-9
    )


def test_depth_inverts_opacity():
    logits = torch.linspace(-13, 13, 101, dtype=torch.float64)
    torch.testing.assert_close(
        parameters.opacity_from_optical_depth(parameters.optical_depth_from_logit(logits)),
        torch.sigmoid(logits),
        rtol=1e-12,
        atol=0,
    )


def test_gradients_are_finite_at_the_extremes():
    logits = torch.tensor([-INF, -700.0, 0.0, 700.0, INF], requires_grad=True)
    parameters.opacity_from_logit(logits).sum().backward()
    assert bool(logits.grad.isfinite().all())


def test_gradients():
    inside = torch.tensor([0.2, 0.5, 2.0], dtype=torch.float64, requires_grad=True)
    for function in (
        parameters.opacity_from_logit,
        parameters.optical_depth_from_logit,
        parameters.opacity_from_optical_depth,
        parameters.logit_from_optical_depth,
        parameters.positive_log,
    ):
        assert torch.autograd.gradcheck(function, (inside,))
