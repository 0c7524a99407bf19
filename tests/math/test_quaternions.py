"""Unit quaternions and rotation matrices."""

import math

import numpy as np
import pytest
import torch

import oracles
from cvtgs.math import parameters

HALF = math.sqrt(0.5)


def random_quats(count: int, seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return parameters.normalize_quats(torch.randn(count, 4, generator=g, dtype=torch.float64))


def test_quarter_turn_about_z_sends_x_to_y():
    matrix = parameters.quats_to_matrices(
        torch.tensor([[HALF, 0.0, 0.0, HALF]], dtype=torch.float64)
    )
    wanted = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(matrix[0], wanted, rtol=0, atol=1e-15)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_have_their_axis_as_quaternion(axis):
    matrix = -torch.eye(3, dtype=torch.float64)
    matrix[axis, axis] = 1.0
    wanted = [0.0] * 4
    wanted[axis + 1] = 1.0
    assert parameters.matrices_to_quats(matrix[None])[0].abs().tolist() == wanted


def test_products_of_the_units():
    """``ij = k``, ``jk = i``, ``ki = j``; in reverse order, the sign changes; ``ii = -1``."""
    units = torch.eye(4, dtype=torch.float64)
    one, i, j, k = units
    table = [(i, j, k), (j, k, i), (k, i, j), (j, i, -k), (i, i, -one), (one, j, j), (j, one, j)]
    for a, b, wanted in table:
        assert torch.equal(parameters.multiply_quats(a[None], b[None])[0] + 0.0, wanted + 0.0)


def test_product_of_known_quaternions():
    a, b = torch.tensor([[1.0, 2.0, 3.0, 4.0]]), torch.tensor([[5.0, 6.0, 7.0, 8.0]])
    assert parameters.multiply_quats(a, b).tolist() == [[-60.0, 12.0, 30.0, 24.0]]


def test_products_equal_the_oracle_and_are_one_rotation_after_the_other():
    a, b = random_quats(40), random_quats(40, seed=1)
    found = parameters.multiply_quats(a, b)
    pairs = zip(a.tolist(), b.tolist(), strict=True)
    wanted = torch.tensor(
        [oracles.quaternion_product(*pair) for pair in pairs], dtype=torch.float64
    )
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-15)
    turns = [parameters.quats_to_matrices(quats) for quats in (a, b, found)]
    torch.testing.assert_close(turns[0] @ turns[1], turns[2], rtol=0, atol=1e-14)


def test_no_rows():
    assert parameters.multiply_quats(torch.zeros(0, 4), torch.zeros(0, 4)).shape == (0, 4)
    assert parameters.normalize_quats(torch.zeros(0, 4)).shape == (0, 4)
    assert parameters.quats_to_matrices(torch.zeros(0, 4)).shape == (0, 3, 3)
    assert parameters.matrices_to_quats(torch.zeros(0, 3, 3)).shape == (0, 4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("power", [-37, -20, 0, 20, 37])
def test_normalize_survives_tiny_and_huge(dtype, power):
    quats = torch.tensor([[3.0, -4.0, 0.0, 0.0]], dtype=dtype) * 10.0**power
    torch.testing.assert_close(
        parameters.normalize_quats(quats), torch.tensor([[0.6, -0.8, 0.0, 0.0]], dtype=dtype)
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_denormal_quaternions_that_do_not_matter_have_no_gradient(dtype):
    quats = torch.full((3, 4), torch.finfo(dtype).tiny / 100, dtype=dtype, requires_grad=True)
    (0.0 * parameters.rotation_matrices(quats)).sum().backward()
    assert not quats.grad.any()


def test_matrices_equal_the_oracle():
    quats = random_quats(50)
    wanted = torch.from_numpy(np.stack([oracles.rotation(q) for q in quats.tolist()]))
    torch.testing.assert_close(parameters.quats_to_matrices(quats), wanted, rtol=0, atol=1e-14)


def test_matrices_are_rotations():
    matrices = parameters.quats_to_matrices(random_quats(100))
    identity = torch.eye(3, dtype=torch.float64).expand(100, 3, 3)
    torch.testing.assert_close(matrices @ matrices.transpose(1, 2), identity, rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(100, dtype=torch.float64))


def test_negated_quaternion_is_the_same_rotation():
    quats = random_quats(20)
    assert torch.equal(parameters.quats_to_matrices(quats), parameters.quats_to_matrices(-quats))


def test_round_trip_near_half_turns():
    turn = math.pi - 1e-7
    axes = torch.nn.functional.normalize(random_quats(60)[:, 1:], dim=1)
    cosines = torch.full((60, 1), math.cos(turn / 2), dtype=torch.float64)
    quats = torch.cat([cosines, math.sin(turn / 2) * axes], dim=1)
    back = parameters.matrices_to_quats(parameters.quats_to_matrices(quats))
    torch.testing.assert_close(back, quats, rtol=0, atol=1e-13)


def test_round_trip_has_positive_w():
    quats = random_quats(200, seed=3)
    back = parameters.matrices_to_quats(parameters.quats_to_matrices(quats))
    assert bool((back[:, 0] >= 0).all())
    aligned = torch.where(quats[:, :1] < 0, -quats, quats)
    torch.testing.assert_close(back, aligned, rtol=0, atol=1e-13)


@pytest.mark.parametrize("about", ["x", "y", "z"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_no_component_is_minus_zero(about, sign):
    """Turns about the axes have many zeros; they have one sign, though ``w`` is made positive."""
    axis = torch.eye(3, dtype=torch.float64)["xyz".index(about)]
    halves = torch.tensor([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0], [-0.6, 0.8], [0.6, -0.8]]).double()
    quats = sign * torch.cat([halves[:, :1], halves[:, 1:] * axis], dim=1)
    back = parameters.matrices_to_quats(parameters.quats_to_matrices(quats))
    assert not bool((back.signbit() & (back == 0)).any())


def test_gradients():
    quats = random_quats(4).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda q: parameters.quats_to_matrices(parameters.normalize_quats(q)), (quats,)
    )
    others = random_quats(4, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(parameters.multiply_quats, (quats, others))
