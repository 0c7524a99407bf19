"""Spherical harmonics against scipy, and the lists of tiles against every pixel."""

import math

import pytest
import torch

import render_oracle as oracle
from cvtgs.cameras import Cameras
from cvtgs.math import spherical_harmonics
from cvtgs.rendering.projection import project, reach_of, to_pinholes
from cvtgs.rendering.torch_backend import intersect
from scenes import random_scene


def directions(count):
    g = torch.Generator().manual_seed(0)
    random = torch.randn(count, 3, generator=g, dtype=torch.float64)
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    return torch.nn.functional.normalize(torch.cat([axes, random]), dim=1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_basis_equals_that_of_scipy(degree):
    ways = directions(50)
    rows = [oracle.sh_basis(way, degree) for way in ways.tolist()]
    wanted = torch.tensor(rows, dtype=torch.float64)
    found = spherical_harmonics.rest_basis(ways, degree)
    torch.testing.assert_close(found, wanted[:, 1:], rtol=0, atol=1e-14)
    assert wanted[0, 0].item() == pytest.approx(spherical_harmonics.SH_C0)


def test_basis_is_orthonormal():
    """By a quadrature that is exact for these degrees: Gauss-Legendre by equal angles."""
    heights, weights = map(torch.from_numpy, oracle.np.polynomial.legendre.leggauss(8))
    angles = torch.arange(16, dtype=torch.float64) * math.pi / 8
    z, phi = (part.flatten() for part in torch.meshgrid(heights, angles, indexing="ij"))
    rim = (1 - z * z).sqrt()
    basis = spherical_harmonics.rest_basis(torch.stack([rim * phi.cos(), rim * phi.sin(), z], 1), 3)
    gram = basis.T @ (basis * (weights * math.pi / 8).repeat_interleave(16)[:, None])
    torch.testing.assert_close(gram, torch.eye(15).double(), rtol=0, atol=1e-13)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_colors(degree, dtype):
    scene = random_scene(40, degree=degree, dtype=dtype)
    ways = directions(34).to(dtype)
    found = spherical_harmonics.evaluate(scene.sh0, scene.shN, ways)
    assert found.dtype == dtype
    for row in range(40):
        basis = torch.tensor(oracle.sh_basis(ways[row].tolist(), degree), dtype=torch.float64)
        wanted = (0.5 + basis @ scene.sh[row].double()).clamp_min(0)
        torch.testing.assert_close(found[row].double(), wanted, rtol=0, atol=2e-6)


@pytest.mark.slow
def test_gradients_of_colors():
    scene = random_scene(6, degree=3, dtype=torch.float64)
    leaves = [scene.sh0 + 2, scene.shN, directions(0)]
    leaves = [leaf.clone().requires_grad_() for leaf in leaves]
    assert torch.autograd.gradcheck(spherical_harmonics.evaluate, leaves)


@pytest.mark.parametrize("side", [4, 7, 16])
@pytest.mark.parametrize("size", [0.02, 0.3])
def test_every_tile_that_a_splat_reaches_is_listed(side, size):
    """All tiles with a reached pixel are listed, and at most a few others by rounding."""
    scene = random_scene(80, degree=0, dtype=torch.float64, size=size)
    viewmat = torch.eye(4).double()
    viewmat[2, 3] = 3.0
    Ks = torch.tensor([[[30.0, 0, 19], [0, 30, 14], [0, 0, 1]]]).double()  # noqa: N806
    view = to_pinholes(Cameras(viewmats=viewmat[None], Ks=Ks, width=37, height=29))[0]
    splats = project(scene, view, 0)
    lists = intersect(splats, view.size, side)
    listed = set()
    for tile in range(len(lists.starts) - 1):
        members = lists.splats[lists.starts[tile] : lists.starts[tile + 1]].tolist()
        assert members == sorted(set(members))
        listed |= {(splat, tile) for splat in members}
    x, y = torch.arange(37).double() + 0.5, torch.arange(29).double() + 0.5
    reach = reach_of(splats.opacities)
    reached = set()
    for splat in range(len(splats.rows)):
        steep, shear, flat = splats.ellipses[splat]
        across, down = x - splats.centers[splat, 0], y - splats.centers[splat, 1]
        q = steep * (across[None] + shear * down[:, None]) ** 2 + flat * down[:, None] ** 2
        rows, columns = (q <= reach[splat]).nonzero(as_tuple=True)
        tiles = rows // side * lists.across + columns // side
        reached |= {(splat, tile) for tile in tiles.tolist()}
    assert reached <= listed
    assert len(listed) <= 1.1 * len(reached) + 5


def test_tiles_by_splat_are_the_same_intersections():
    scene = random_scene(50, degree=0, size=0.2)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3.0
    Ks = torch.tensor([[[30.0, 0, 19], [0, 30, 14], [0, 0, 1]]])  # noqa: N806
    view = to_pinholes(Cameras(viewmats=viewmat[None], Ks=Ks, width=37, height=29))[0]
    lists = intersect(project(scene, view, 0), view.size, 8)
    by_splat = torch.empty_like(lists.splats)
    by_splat[lists.ranks] = lists.splats
    assert torch.equal(by_splat, by_splat.sort().values)
    assert torch.equal(torch.bincount(by_splat), lists.splat_starts.diff()[: by_splat.amax() + 1])
