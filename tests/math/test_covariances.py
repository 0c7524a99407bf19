"""Covariances: building, decomposition, and the mean projected area."""

import math

import numpy as np
import pytest
import torch

import oracles
from cvtgs.math import parameters


def random_shapes(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    scales = torch.exp(torch.randn(count, 3, generator=g, dtype=torch.float64))
    return scales, parameters.normalize_quats(
        torch.randn(count, 4, generator=g, dtype=torch.float64)
    )


def rebuilt(scales: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
    return parameters.build_covariances(scales, quats)


def test_needle_turned_from_x_to_y():
    half = math.sqrt(0.5)
    matrix = rebuilt(
        torch.tensor([[3.0, 1.0, 1.0]], dtype=torch.float64),
        torch.tensor([[half, 0, 0, half]], dtype=torch.float64),
    )
    torch.testing.assert_close(
        matrix[0], torch.diag(torch.tensor([1.0, 9.0, 1.0], dtype=torch.float64))
    )


def test_area_of_a_sphere_and_of_a_disc():
    scales = torch.tensor([[2.0, 2.0, 2.0], [1.0, 1.0, 0.0]], dtype=torch.float64)
    sphere, disc = parameters.mean_projected_area(scales).tolist()
    assert sphere == pytest.approx(4 * math.pi)
    assert disc == pytest.approx(math.pi / 2, rel=0.012)  # exactly half of its face


def test_no_rows():
    scales, quats = parameters.decompose_covariances(torch.zeros(0, 3, 3))
    assert scales.shape == (0, 3)
    assert quats.shape == (0, 4)
    assert parameters.mean_projected_area(torch.zeros(0, 3)).shape == (0,)
    assert parameters.log_mean_projected_area(torch.zeros(0, 3)).shape == (0,)


def test_zero_matrix_gives_positive_scales():
    for dtype in (torch.float32, torch.float64):
        scales, quats = parameters.decompose_covariances(torch.zeros(1, 3, 3, dtype=dtype))
        assert bool((scales > 0).all())
        assert bool((scales < 1e-15).all())
        assert torch.linalg.vector_norm(quats).item() == pytest.approx(1.0)


def test_rank_one_matrix_is_floored():
    direction = torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64)
    scales, _ = parameters.decompose_covariances((direction[:, None] * direction)[None])
    assert scales[0, 0].item() == pytest.approx(3.0)
    assert bool((scales[0, 1:] >= 3e-6 * (1 - 1e-9)).all())
    assert bool((scales[0, 1:] < 1e-5).all())


@pytest.mark.parametrize("size", [1e-18, 1.0, 5e8])
def test_needles_keep_their_thin_axes(size):
    g = torch.Generator().manual_seed(5)
    quats = parameters.normalize_quats(torch.randn(20, 4, generator=g, dtype=torch.float64))
    given = size * torch.tensor([[1.0, 1e-5, 1e-6]], dtype=torch.float64).expand(20, 3)
    scales, turned = parameters.decompose_covariances(rebuilt(given, quats))
    torch.testing.assert_close(scales, given, rtol=1e-3, atol=0)
    matrices = rebuilt(scales, turned)
    torch.testing.assert_close(matrices, rebuilt(given, quats), rtol=0, atol=1e-13 * size * size)


def test_equal_eigenvalues_give_a_proper_frame():
    matrices = torch.stack(
        [
            torch.eye(3, dtype=torch.float64),
            torch.diag(torch.tensor([4.0, 4.0, 1.0], dtype=torch.float64)),
            torch.diag(torch.tensor([1.0, 4.0, 1.0], dtype=torch.float64)),
        ]
    )
    scales, quats = parameters.decompose_covariances(matrices)
    torch.testing.assert_close(rebuilt(scales, quats), matrices)
    assert scales.tolist() == [[1, 1, 1], [2, 2, 1], [2, 1, 1]]


def test_covariance_equals_the_oracle():
    scales, quats = random_shapes(30)
    wanted = np.stack(
        [
            oracles.covariance(s, q)
            for s, q in zip(scales.log().tolist(), quats.tolist(), strict=True)
        ]
    )
    torch.testing.assert_close(rebuilt(scales, quats), torch.from_numpy(wanted), rtol=1e-10, atol=0)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-4), (torch.float64, 1e-11)])
def test_decompose_inverts_building(dtype, tolerance):
    scales, quats = (tensor.to(dtype) for tensor in random_shapes(200, seed=1))
    matrices = rebuilt(scales, quats)
    again = rebuilt(*parameters.decompose_covariances(matrices))
    size = matrices.abs().amax(dim=(1, 2), keepdim=True)
    assert float(((again - matrices).abs() / size).amax()) < tolerance


def test_axes_are_canonical():
    scales, quats = parameters.decompose_covariances(rebuilt(*random_shapes(300, seed=2)))
    axes = parameters.quats_to_matrices(quats)
    assert bool((scales.diff(dim=1) <= 0).all())
    assert bool((quats[:, 0] >= 0).all())
    torch.testing.assert_close(torch.linalg.det(axes), torch.ones(300, dtype=torch.float64))
    for column in (0, 1):
        largest = axes[:, :, column].gather(1, axes[:, :, column].abs().argmax(1, keepdim=True))
        assert bool((largest > 0).all())


def test_area_is_within_thomsens_error_for_every_shape():
    rng = np.random.default_rng(0)
    shapes = np.exp(rng.uniform(-4, 0, size=(60, 3)))
    shapes = np.concatenate([shapes, [[1, 1e-6, 1e-6], [1, 1, 1e-9], [1, 0.3, 0.3], [1, 1, 0.3]]])
    areas = parameters.mean_projected_area(torch.from_numpy(shapes))
    for shape, area in zip(shapes, areas.tolist(), strict=True):
        assert area == pytest.approx(oracles.mean_shadow(shape), rel=0.012)
        assert area == pytest.approx(oracles.thomsen_area(shape), rel=1e-12)


@pytest.mark.parametrize("exponent", [-40.0, 20.0])
def test_area_of_extreme_scales_in_float32(exponent):
    size = math.exp(exponent)
    area = parameters.mean_projected_area(torch.full((1, 3), size)).item()
    assert area == pytest.approx(math.pi * size * size, rel=1e-5)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_logarithm_of_the_area(dtype, tolerance):
    """A sphere of radius 2 has an area of 4 pi; other shapes agree with the plain area."""
    sphere = torch.full((1, 3), math.log(2.0), dtype=dtype)
    found = parameters.log_mean_projected_area(sphere)
    assert found.dtype == dtype
    assert found.item() == pytest.approx(math.log(4 * math.pi), rel=tolerance)
    scales, _ = random_shapes(100, seed=6)
    areas = parameters.mean_projected_area(scales)
    found = parameters.log_mean_projected_area(scales.log().to(dtype)).double()
    torch.testing.assert_close(found, areas.log(), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("exponent", [-80.0, 80.0])
def test_logarithm_of_the_area_of_extreme_scales(dtype, exponent):
    """e^-80 and e^80, whose areas are beyond float32."""
    shapes = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, -1.0], [0.0, -3.0, 1.0]], dtype=dtype)
    found = parameters.log_mean_projected_area(shapes + exponent)
    wanted = [math.log(oracles.thomsen_area(row)) for row in shapes.double().exp().tolist()]
    assert found.tolist() == pytest.approx([w + 2 * exponent for w in wanted], rel=1e-5)


def test_logarithm_of_the_area_of_discs_and_needles_is_finite():
    """The area of the disc is exact; that of the needle, e^-200 thin, is nearly zero."""
    shapes = torch.tensor([[0.0, 0.0, -500.0], [0.0, -200.0, -200.0]], requires_grad=True)
    disc, needle = parameters.log_mean_projected_area(shapes)
    flat = math.log(parameters.mean_projected_area(torch.tensor([[1.0, 1.0, 0.0]])).item())
    assert disc.item() == pytest.approx(flat, rel=1e-5)
    assert needle.item() < -50
    (disc + needle).backward()
    assert bool(shapes.grad.isfinite().all())


def test_gradients():
    scales, quats = random_shapes(3, seed=4)
    scales.requires_grad_()
    quats.requires_grad_()
    assert torch.autograd.gradcheck(parameters.build_covariances, (scales, quats))
    assert torch.autograd.gradcheck(parameters.mean_projected_area, (scales,))
    assert torch.autograd.gradcheck(parameters.log_mean_projected_area, (scales,))
