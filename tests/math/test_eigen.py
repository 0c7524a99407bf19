"""Eigenvectors by Jacobi rotations equal those of LAPACK."""

import pytest
import torch

from cvtgs.errors import InvalidArgumentError
from cvtgs.math import eigen
from cvtgs.math.eigen import jacobi_eigen, symmetric_eigen
from pretended_device import pretended_cuda

SIZES = {
    "a ball": [1.0, 1.0, 1.0],
    "a needle": [1.0, 1e-3, 1e-6],
    "a disc": [1.0, 1.0, 0.0],
    "a line": [1.0, 1e-9, 1e-9],
    "indefinite": [1.0, -1.0, 0.5],
}


def matrices(sizes, dtype, count=500):
    generator = torch.Generator().manual_seed(0)
    axes, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    made = (axes * torch.tensor(sizes, dtype=torch.float64)) @ axes.mT
    return (0.5 * (made + made.mT)).to(dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 4e-6)])
@pytest.mark.parametrize("sizes", SIZES.values(), ids=SIZES)
def test_rotations_find_the_same(sizes, dtype, tolerance):
    made = matrices(sizes, dtype)
    values, axes = jacobi_eigen(made)
    close = {"rtol": 0, "atol": tolerance}
    torch.testing.assert_close(values, torch.linalg.eigvalsh(made), **close)
    torch.testing.assert_close((axes * values[:, None]) @ axes.mT, made, **close)
    unit = torch.eye(3, dtype=dtype).expand(len(made), 3, 3)
    torch.testing.assert_close(axes.mT @ axes, unit, **close)


def test_values_that_are_not_finite_are_one_clear_error():
    matrices = torch.eye(3).repeat(5, 1, 1)
    matrices[3] = torch.nan
    with pytest.raises(InvalidArgumentError, match="covariances must be finite, found NaN"):
        symmetric_eigen(matrices)


def test_diagonal_matrices_stay_exact():
    made = torch.diag_embed(torch.tensor([[1.0, 9, 4], [0, 0, 0], [2, 2, 2]]))
    values, axes = jacobi_eigen(made)
    assert values.tolist() == [[1, 4, 9], [0, 0, 0], [2, 2, 2]]
    assert axes[1].tolist() == torch.eye(3).tolist()


@pytest.mark.slow
def test_one_sweep_less_is_enough(monkeypatch):
    made = torch.randn(2000, 3, 3, generator=torch.Generator().manual_seed(0)).double()
    made = made + made.mT
    wanted, _ = jacobi_eigen(made)
    monkeypatch.setattr(eigen, "SWEEPS", eigen.SWEEPS - 1)
    torch.testing.assert_close(jacobi_eigen(made)[0], wanted, rtol=0, atol=1e-13)


def test_a_device_uses_rotations():
    made = matrices([1.0, 0.5, 0.2], torch.float64, count=50)
    with pretended_cuda():
        found = symmetric_eigen(made.to("cuda"))[0].cpu()
    assert torch.equal(found, jacobi_eigen(made)[0])
    assert torch.equal(symmetric_eigen(made)[0], torch.linalg.eigh(made)[0])


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_two_hundred_thousand_matrices_on_cuda():
    made = matrices([1.0, 0.5, 0.2], torch.float64, count=200_000)
    values, axes = (one.cpu() for one in symmetric_eigen(made.cuda()))
    torch.testing.assert_close((axes * values[:, None]) @ axes.mT, made, rtol=0, atol=1e-14)
