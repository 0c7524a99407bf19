"""The tessellation of hard scenes: space, weights, seeds, nearest-site search and cells."""

from importlib import import_module
from itertools import pairwise

import numpy as np
import pytest
import torch

from cvtgs.analysis import ambient_visibility, perspective_falloff
from cvtgs.config import SimplifyConfig
from cvtgs.cvt import (
    embed,
    nearest_neighbors,
    nearest_scipy,
    stratified_seeds,
    tessellate,
    tessellation_weights,
)
from cvtgs.cvt.nearest import runs_of_equal
from cvtgs.math.frames import morton_order, robust_frame
from hard_cases import CASES, each_case
from hard_scenes import DEVICES, PRESETS, dtypes, valid_case

COUNT = 60


def squared_distances(points, sites):
    """Return all squared distances, in float64, computed by numpy alone."""
    a, b = (x.double().numpy() for x in (points, sites))
    return np.square(a[:, None] - b[None]).sum(axis=2)


@dtypes
@each_case
@pytest.mark.slow
def test_each_case(make, dtype, subtests):
    """Space and weights are finite, cells are not empty, and the nearest sites are found."""
    scene = valid_case(make, COUNT, dtype)
    for device in DEVICES:
        with subtests.test("space and weights are finite", device=device):
            check_that_space_and_weights_are_finite(scene.to(device))
        for preset in PRESETS:
            with subtests.test("cells have members, energies fall", device=device, preset=preset):
                check_that_cells_have_members_and_energies_fall(scene.to(device), preset)
    points = embed(scene.means, frame=robust_frame(scene.means))
    with subtests.test("the nearest site is found"):
        check_that_the_nearest_site_is_found(points)
    with subtests.test("the nearest neighbours are found"):
        check_that_the_nearest_neighbours_are_found(points)


def check_that_space_and_weights_are_finite(scene):
    frame = robust_frame(scene.means)
    assert frame.radius > 0
    if scene.dtype == torch.float32:  # float64 gives the same and takes longest
        light = ambient_visibility(scene.means, scene.masses, frame)
        assert bool(((light >= 0) & (light <= 1)).all())
    far = perspective_falloff(frame.distances(scene.means))
    assert bool(((far >= 0) & (far <= 1)).all())
    for contraction in (0.0, 0.5, 1.0):
        points = embed(scene.means, scene.sh0, frame=frame, contraction=contraction, color=0.05)
        assert bool(points.isfinite().all())
    for power in (0.0, 0.8, 1.0):
        weights = tessellation_weights(
            scene.opacities, scene.areas * far, area_power=power, floor=1e-3
        )
        assert bool((weights.isfinite() & (weights >= 0)).all())
        assert float(weights.amax()) > 0


def check_that_cells_have_members_and_energies_fall(scene, preset):
    frame = robust_frame(scene.means)
    points = embed(scene.means, frame=frame)
    order = morton_order(points)
    points, weights = points[order], scene.masses[order]
    weights = weights if float(weights.amax()) > 0 else torch.ones_like(weights)
    weights = weights / weights.amax()
    rounding = 1e-12 * float((weights * points.square().sum(dim=1)).sum())
    config = SimplifyConfig.from_preset(preset).cvt
    for count in sorted({1, max(1, len(scene) // 3), max(1, len(scene) - 1), len(scene)}):
        found = tessellate(points, weights, count, config=config)
        assert torch.bincount(found.labels, minlength=count).amin() >= 1
        assert len(found.sites) == count
        assert bool(found.sites.isfinite().all())
        energies = [*found.energies, found.energy]
        assert all(after <= before + rounding for before, after in pairwise(energies))


def check_that_the_nearest_site_is_found(points):
    sites = points[::3]
    labels, squared = nearest_scipy(points, sites)
    every = squared_distances(points, sites)
    own = every[np.arange(len(points)), labels.numpy()]
    np.testing.assert_allclose(own, every.min(axis=1), rtol=1e-12, atol=0)
    np.testing.assert_allclose(squared.numpy(), own, rtol=1e-12, atol=0)


def check_that_the_nearest_neighbours_are_found(sites):
    found = nearest_neighbors(sites, 8)
    assert found.shape == (len(sites), min(8, len(sites) - 1))
    assert not bool((found == torch.arange(len(sites))[:, None]).any())
    assert all(len(set(row)) == len(row) for row in found.tolist())
    every = squared_distances(sites, sites)
    np.fill_diagonal(every, np.inf)
    wanted = np.sort(every, axis=1)[:, : found.shape[1]]
    own = np.sort(np.take_along_axis(every, found.numpy(), axis=1), axis=1)
    np.testing.assert_allclose(own, wanted, rtol=1e-9, atol=0)


def test_coincident_sites_are_searched_as_one(monkeypatch):
    """A tree cannot separate them, and would compare every point with every site."""
    sites = torch.tensor([[1.0, 2.0, 3.0]]).repeat(1000, 1)
    sites[700] = 0.0
    home, seen = import_module("cvtgs.cvt.nearest"), []
    honest = home.build_tree
    monkeypatch.setattr(home, "build_tree", lambda sites: seen.append(len(sites)) or honest(sites))
    labels, squared = nearest_scipy(sites, sites)
    assert seen == [2]
    assert labels.tolist() == [700 if row == 700 else 0 for row in range(1000)]
    assert not bool(squared.any())


def test_coincident_sites_are_separated_in_the_neighbour_tree(monkeypatch):
    home, seen = import_module("cvtgs.cvt.nearest"), []
    honest = home.build_tree
    monkeypatch.setattr(
        home, "build_tree", lambda sites, **how: seen.append(sites) or honest(sites, **how)
    )
    far = 3e38 * torch.tensor([[1.0, -1.0, 1.0]])  # their extent is beyond float32
    sites = torch.cat([torch.zeros(500, 3), far, -far])
    found = nearest_neighbors(sites, 8)
    assert bool(seen[0].isfinite().all())
    assert len(seen[0].unique(dim=0)) == 502
    assert int(found[:500].amax()) < 500


@pytest.mark.parametrize("width", [1, 2, 3, 6])
def test_equal_rows_are_found(width):
    g = torch.Generator().manual_seed(0)
    sites = torch.rand(50, width, generator=g)[torch.randint(0, 50, (200,), generator=g)]
    first = {}
    for row, site in enumerate(sites.tolist()):
        first.setdefault(tuple(site), row)
    order, ranks = runs_of_equal(sites)
    assert sorted(order.tolist()) == list(range(200))
    assert sorted(order[ranks == 0].tolist()) == sorted(first.values())
    assert runs_of_equal(sites[sorted(first.values())]) is None


def test_seeds_among_equal_points_are_different_rows():
    for name in ("coincident", "duplicates", "all_transparent"):
        scene = CASES[name](COUNT, torch.float32)
        for count in (1, 7, COUNT - 1, COUNT):
            rows, shares = stratified_seeds(scene.masses, count)
            assert len(set(rows.tolist())) == count
            assert float(shares.sum()) == pytest.approx(float(scene.masses.sum()))


def test_ties_decide_the_order_of_coincident_points():
    points = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 0, 0], [1, 1, 1], [0, 0, 0]])
    ties = torch.tensor([3.0, 2.0, 1.0, 1.0, 1.0])
    assert morton_order(points).tolist() == [0, 2, 4, 1, 3]
    assert morton_order(points, ties).tolist() == [2, 4, 0, 3, 1]
    apart = points + 3 * torch.arange(5)[:, None]
    assert torch.equal(morton_order(apart, ties), morton_order(apart))
