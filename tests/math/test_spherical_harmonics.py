"""Spherical harmonics in the order, scale and signs of 3DGS files."""

import math

import numpy as np
import pytest
import torch

import oracles
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.spherical_harmonics import (
    SH_C0,
    clamped_parts,
    degree_of,
    evaluate,
    rest_basis,
    rotated_rest,
)


def random_directions(count: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(0)
    return torch.nn.functional.normalize(
        torch.randn(count, 3, generator=g, dtype=torch.float64), dim=1
    )


def test_constant_band():
    assert pytest.approx(1 / (2 * math.sqrt(math.pi))) == SH_C0


def test_first_band_along_the_axes():
    """Minus y, z, minus x, times sqrt(3 / (4 pi))."""
    c = math.sqrt(3 / (4 * math.pi))
    wanted = torch.tensor([[0, 0, -c], [-c, 0, 0], [0, c, 0]], dtype=torch.float64)
    torch.testing.assert_close(rest_basis(torch.eye(3, dtype=torch.float64), 1), wanted)


def test_colour_of_a_known_gaussian():
    sh0, rest = torch.ones(1, 1, 3), torch.zeros(1, 3, 3)
    rest[0, 1] = torch.tensor([1.0, -1.0, -9.0])
    color = evaluate(sh0, rest, torch.tensor([[0.0, 0.0, 1.0]]))[0].tolist()
    base, c = 0.5 + SH_C0, math.sqrt(3 / (4 * math.pi))
    assert color == pytest.approx([base + c, base - c, 0.0])


@pytest.mark.parametrize(("count", "degree"), [(0, 0), (3, 1), (8, 2), (15, 3)])
def test_degrees(count, degree):
    assert degree_of(count) == degree
    assert rest_basis(random_directions(4), degree).shape == (4, count)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_basis_equals_the_oracle(degree):
    directions = random_directions(50)
    wanted = torch.from_numpy(oracles.sh_basis(directions.numpy(), degree)[:, 1:])
    torch.testing.assert_close(rest_basis(directions, degree), wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_rotated_coefficients_give_the_colours_of_turned_directions(degree):
    """The library's basis and the oracle's rotation agree."""
    directions, quat = random_directions(30), (0.3, -0.5, 0.8, 0.1)
    rng = np.random.default_rng(0)
    coefficients = 0.05 * rng.normal(size=(1, (degree + 1) ** 2, 3))
    matrix = oracles.rotation(quat)
    plain, turned = (
        torch.from_numpy(array).expand(30, -1, -1)
        for array in (coefficients, oracles.rotated_sh(coefficients, matrix))
    )
    seen = evaluate(plain[:, :1], plain[:, 1:], directions)
    assert float(seen.min()) > 0
    turned_directions = directions @ torch.from_numpy(matrix).T
    torch.testing.assert_close(
        evaluate(turned[:, :1], turned[:, 1:], turned_directions), seen, rtol=0, atol=1e-6
    )
    found = rotated_rest(plain[:, 1:], torch.from_numpy(matrix))
    torch.testing.assert_close(found, turned[:, 1:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("count", [1, 14, 24, -1])
def test_other_counts_are_errors(count):
    with pytest.raises(InvalidArgumentError) as caught:
        degree_of(count)
    assert str(caught.value) == (
        "a scene has 0, 3, 8 or 15 view-dependent SH coefficients per channel "
        f"(degree 0 to 3), found {count}."
    )


@pytest.mark.parametrize("degree", [-1, 4, 1.5, "2"])
def test_other_degrees_are_errors(degree):
    with pytest.raises(InvalidArgumentError, match=r"the SH degree must be from 0 to 3, found"):
        rest_basis(random_directions(3), degree)


def test_gradients():
    directions = random_directions(3).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: rest_basis(d, 3), (directions,))


def random_colors(count: int, degree: int, mean: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return coefficients of colours about a mean, most of them on both sides of it."""
    g = torch.Generator().manual_seed(degree)
    sh = torch.randn(count, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64) * 0.3
    sh[:, 0] = (mean - 0.5) / SH_C0
    return sh[:, :1], sh[:, 1:]


@pytest.mark.parametrize("degree", range(4))
def test_colours_wholly_below_zero_are_their_own_clamped_part(degree):
    sh0, rest = random_colors(20000, degree, mean=-9.0)
    parts = clamped_parts(sh0, rest)
    torch.testing.assert_close(parts[:, :1], -(sh0 + 0.5 / SH_C0))
    torch.testing.assert_close(parts[:, 1:], -rest)
    assert not clamped_parts(-sh0, rest).any()


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_clamped_parts_are_the_best_fit_to_what_images_show(degree):
    """Of the difference between shown and signed colours, in directions of another kind."""
    sh0, rest = random_colors(50, degree, mean=0.0)
    directions = random_directions(3000)
    basis = torch.cat([torch.full((3000, 1), SH_C0), rest_basis(directions, degree)], dim=1)
    signed = 0.5 + torch.einsum("dk,nkc->ndc", basis, torch.cat([sh0, rest], dim=1))
    missing = signed.clamp_min(0) - signed
    best = torch.linalg.lstsq(basis, missing.transpose(0, 1).flatten(1)).solution
    found = torch.einsum("dk,nkc->ndc", basis, clamped_parts(sh0, rest))
    wanted = (basis @ best).unflatten(1, (50, 3)).transpose(0, 1)
    assert (found - wanted).square().mean() < 0.04 * missing.square().mean()
    assert (found - missing).square().mean() < 1.35 * (wanted - missing).square().mean()
    average = SH_C0 * clamped_parts(sh0, rest)[:, 0]
    torch.testing.assert_close(average, missing.mean(dim=1), atol=0.03, rtol=0.05)
