"""Nearest site: the search equals brute force."""

import time

import numpy as np
import pytest
import torch

import oracles
from cvtgs.cvt import nearest_neighbors, nearest_scipy, nearest_site
from cvtgs.cvt.device_search import nearest_in_tiles
from cvtgs.cvt.nearest import nearest_several, runs_of_equal, search_once_per_position
from cvtgs.errors import InvalidArgumentError


def nearest_by_tiles(points, sites):
    labels, squared = nearest_in_tiles(points, sites)
    return labels[:, 0], squared[:, 0]


BACKENDS = {"scipy": nearest_scipy, "tiles": nearest_by_tiles}
both = pytest.mark.parametrize("backend", BACKENDS.values(), ids=BACKENDS)
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def cloud(kind: str, count: int, d: int, *, seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(1000 * seed + count)
    points = torch.randn(count, d, generator=g, dtype=torch.float64)
    if kind == "clusters":
        centers = 50 * torch.randn(5, d, generator=torch.Generator().manual_seed(9)).double()
        points = 0.01 * points + centers[torch.randint(0, 5, (count,), generator=g)]
    if kind == "far-flung":
        points *= 10 ** (6 * torch.rand(count, 1, generator=g, dtype=torch.float64))
    if kind == "line":
        points[:, 1:] = 0
    if kind == "lattice":
        points = points.mul(2).round()
    return points


SIZES = [(1, 1), (1, 5), (5, 1), (127, 31), (128, 32), (129, 33), (500, 257), (1000, 999)]


def brute_force(points: torch.Tensor, sites: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the smallest of all distances, summed as float64 squares (checked by an oracle)."""
    squared = (points.double()[:, None, :] - sites.double()[None, :, :]).square().sum(dim=2)
    return squared.argmin(dim=1), squared.amin(dim=1)


def assert_nearest(points, sites, found):
    """Distances equal the smallest, and each label names a site at that distance."""
    labels, squared = found
    _, wanted = brute_force(points, sites)
    torch.testing.assert_close(squared, wanted, rtol=1e-12, atol=1e-30)
    of_labels = (points.double() - sites.double()[labels]).square().sum(dim=1)
    torch.testing.assert_close(of_labels, wanted, rtol=1e-12, atol=1e-30)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_short_floats_are_searched(dtype):
    points = torch.arange(5.0)[:, None].to(dtype)
    labels, squared = nearest_scipy(points + 0.25, points)
    assert labels.tolist() == [0, 1, 2, 3, 4]
    assert squared.tolist() == [0.0625] * 5


def test_brute_force_equals_the_scalar_oracle():
    points, sites = cloud("lattice", 60, 3), cloud("lattice", 20, 3, seed=1)
    labels, squared = oracles.nearest(points.numpy(), sites.numpy())
    found = brute_force(points, sites)
    assert found[0].tolist() == labels
    np.testing.assert_allclose(found[1], squared, rtol=1e-14)


@both
def test_known_points(backend):
    sites = torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])
    points = torch.tensor([[1.0, 0, 0], [8, 1, 0], [0, 7, 2], [-5, 0, 0]])
    labels, squared = backend(points, sites)
    assert labels.tolist() == [0, 1, 2, 0]
    assert labels.dtype == torch.int64
    assert squared.tolist() == pytest.approx([1.0, 5.0, 13.0, 25.0])


@pytest.mark.slow
@both
@dtypes
@pytest.mark.parametrize("d", [1, 2, 3, 6])
def test_shapes(backend, d, dtype, subtests):
    for n, m in SIZES:
        with subtests.test(points=n, sites=m):
            points, sites = cloud("normal", n, d).to(dtype), cloud("normal", m, d, seed=1).to(dtype)
            labels, squared = backend(points, sites)
            assert labels.shape == squared.shape == (n,)
            assert_nearest(points, sites, (labels, squared))


@both
@dtypes
@pytest.mark.parametrize("kind", ["clusters", "far-flung", "line", "lattice"])
def test_clouds_of_every_kind(backend, kind, dtype):
    points, sites = cloud(kind, 2000, 3).to(dtype), cloud(kind, 300, 3, seed=1).to(dtype)
    assert_nearest(points, sites, backend(points, sites))


@both
def test_sites_among_the_points_are_at_distance_zero(backend):
    points = cloud("normal", 1000, 6)
    labels, squared = backend(points, points[::3])
    assert bool((squared[::3] == 0).all())
    assert labels[::3].tolist() == list(range(334))


@both
def test_coincident_points_and_sites(backend):
    points, sites = torch.full((300, 3), 2.5), torch.full((70, 3), 2.5)
    _, squared = backend(points, sites)
    assert not bool(squared.any())


@both
def test_results_are_deterministic_and_the_input_is_unchanged(backend):
    points, sites = cloud("clusters", 1500, 3), cloud("normal", 200, 3)
    before = points.clone(), sites.clone()
    first, second = backend(points, sites), backend(points, sites)
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])
    assert torch.equal(points, before[0])
    assert torch.equal(sites, before[1])


def test_three_sites_on_a_line():
    sites = torch.tensor([[0.0], [1.0], [9.0]])
    assert nearest_neighbors(sites, 2).tolist() == [[1, 2], [0, 2], [1, 0]]


@pytest.mark.parametrize(("m", "count"), [(1, 8), (2, 8), (9, 8), (300, 5)])
def test_neighbours_are_the_nearest_others(m, count):
    sites = torch.randn(m, 3, generator=torch.Generator().manual_seed(m), dtype=torch.float64)
    found = nearest_neighbors(sites, count)
    assert found.shape == (m, min(count, m - 1))
    distances = (sites[:, None] - sites[None]).norm(dim=2)
    distances.fill_diagonal_(torch.inf)
    wanted = distances.sort(dim=1).values[:, : found.shape[1]]
    torch.testing.assert_close(distances.gather(1, found), wanted)


def test_a_coincident_site_is_never_its_own_neighbour():
    sites = torch.zeros(50, 3)
    found = nearest_neighbors(sites, 4)
    assert found.shape == (50, 4)
    assert not bool((found == torch.arange(50)[:, None]).any())


@pytest.mark.parametrize("far", [1.0, 1e6, 1e12, 1e30])
def test_coincident_sites_are_neighbours_whatever_lies_far_away(far):
    half = torch.randn(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sites = torch.cat([half, half, torch.tensor([[far, 0, 0]], dtype=torch.float64)])
    found = nearest_neighbors(sites, 1)[:100, 0]
    assert torch.equal(found, torch.arange(100) + 100)


def test_points_far_from_nearly_all_sites_take_no_longer():
    """A tree split at medians looks at nearly all sites: 0.8 s instead of 0.04."""
    g = torch.Generator().manual_seed(0)

    def around(distances):
        ways = torch.randn(len(distances), 3, generator=g, dtype=torch.float64)
        colors = 0.05 * torch.randn(len(distances), 3, generator=g, dtype=torch.float64)
        means = torch.nn.functional.normalize(ways, dim=1) * distances[:, None]
        return torch.cat([means, colors], dim=1)

    even = torch.rand(30_000, generator=g, dtype=torch.float64)
    core = torch.where(torch.arange(30_000) % 50 == 0, 40 * even, 10 ** (-30 * even))
    seconds = []
    for points, sites in ((around(even), around(even)), (around(40 * even), around(core))):
        start = time.process_time()
        nearest_scipy(points, sites)
        seconds.append(time.process_time() - start)
    assert seconds[1] < seconds[0] + 0.1


PLANE = torch.randn(20, 2)
NOT_FINITE = torch.tensor([[0.0, torch.nan], [0.0, 1.0]])


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: nearest_site(PLANE, PLANE[:0]), "sites must hold at least one position, found "
         "shape (0, 2)."),
        (lambda: nearest_scipy(PLANE[:, :0], PLANE[:, :0]), "found shape (20, 0)."),
        (lambda: nearest_site(PLANE, PLANE[:, :1]), "sites must be a tensor of floats of shape (m, "
         "2), found torch.float32 of shape (20, 1)."),
        (lambda: nearest_site(PLANE.tolist(), PLANE), "points must be a tensor of floats of shape "
         "(n, d), found list."),
        (lambda: nearest_site(PLANE, NOT_FINITE), "points and sites must be finite, found NaN or "
         "infinite coordinates."),
        (lambda: nearest_several(NOT_FINITE, PLANE, 1), "points and sites must be finite"),
        (lambda: nearest_neighbors(PLANE / 0, 1), "points and sites must be finite"),
        (lambda: nearest_neighbors(PLANE, -1), "count must be a whole number at least 0, found "
         "-1."),
    ],
)  # fmt: skip
def test_wrong_arguments(call, text):
    with pytest.raises(InvalidArgumentError) as caught:
        call()
    assert text in str(caught.value)


def test_gradients_are_not_needed():
    traced = PLANE.clone().requires_grad_()
    for search in (nearest_site, lambda one, two: nearest_several(one, two, 2)):
        for found, wanted in zip(search(traced, traced), search(PLANE, PLANE), strict=True):
            assert torch.equal(found, wanted)
    assert torch.equal(nearest_neighbors(traced, 3), nearest_neighbors(PLANE, 3))


def test_neighbours_exist_where_squares_of_distances_overflow():
    sites = torch.tensor([[0.0], [1e160], [-1e200], [1e307]], dtype=torch.float64)
    found = nearest_neighbors(sites, 2)
    assert found.shape == (4, 2)
    assert set(found.flatten().tolist()) <= {0, 1, 2, 3}


@dtypes
def test_runs_of_equal_points_are_searched_once(dtype, monkeypatch):
    searched = []
    monkeypatch.setattr(
        "cvtgs.cvt.nearest.nearest_site",
        lambda points, sites: searched.append(points.tolist()) or nearest_site(points, sites),
    )
    points = torch.tensor([[0, 0], [0, 0], [0, 3], [0, 3], [4, 3], [0, 0]], dtype=dtype)
    sites = torch.tensor([[2, 0], [0, 5]], dtype=dtype)
    labels, squared = search_once_per_position(points, sites)
    assert searched == [[[0, 0], [0, 3], [4, 3], [0, 0]]]
    assert labels.tolist() == [0, 0, 1, 1, 0, 0]
    assert squared.tolist() == pytest.approx([4, 4, 4, 4, 13, 4])


@dtypes
def test_points_are_searched_in_chunks(dtype, monkeypatch):
    monkeypatch.setattr("cvtgs.cvt.nearest.CHUNK", 4)
    points = torch.arange(10, dtype=dtype)[:, None]
    labels, squared = nearest_site(points + 0.25, points.flip(0))
    assert labels.tolist() == list(range(9, -1, -1))
    assert squared.tolist() == [0.0625] * 10


def test_equal_sites_are_numbered_in_their_order():
    order, ranks = runs_of_equal(torch.tensor([[1.0, 2], [0, 5], [1, 2], [7, 0], [1, 2], [0, 5]]))
    assert order.tolist()[:3] == [0, 2, 4]
    assert dict(zip(order.tolist(), ranks.tolist(), strict=True)) == {
        0: 0, 1: 0, 2: 1, 3: 0, 4: 2, 5: 1
    }  # fmt: skip
    assert runs_of_equal(torch.tensor([[1.0, 2], [2, 1]])) is None
