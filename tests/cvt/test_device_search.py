"""The search on a device: the nearest sites of brute force, whatever the scales and duplicates."""

import pytest
import torch

from cvtgs.cvt import device_search, nearest, nearest_neighbors, nearest_site
from cvtgs.cvt.device_search import (
    box_corners,
    boxes_of,
    home_leaves,
    nearest_in_tiles,
    rounded_outwards,
    split_sites,
)
from cvtgs.cvt.nearest import nearest_several
from pretended_device import pretended_cuda


@pytest.fixture(autouse=True, params=[0, device_search.PAIRS], ids=["from the root", "deeper"])
def start(request, monkeypatch):
    """Search from the root of the tree, and from the level that a small scene starts at."""
    monkeypatch.setattr(device_search, "PAIRS", request.param)


def cloud(count, axes, seed=0):
    generator = torch.Generator().manual_seed(100 * count + seed)
    return torch.randn(count, axes, generator=generator, dtype=torch.float64)


def smallest(points, sites, count):
    """Return the smallest distances of every point."""
    distances = (points.double()[:, None] - sites.double()).norm(dim=2)
    return distances.sort(dim=1).values[:, :count]


def assert_found(points, sites, count):
    rows, squared = nearest_in_tiles(points, sites, count)
    assert rows.shape == squared.shape == (len(points), count)
    wanted = smallest(points, sites, count)
    torch.testing.assert_close(squared.sqrt(), wanted, rtol=1e-9, atol=0)
    own = (points.double()[:, None] - sites.double()[rows]).norm(dim=2)
    torch.testing.assert_close(own, wanted, rtol=1e-9, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("axes", [1, 3, 6])
@pytest.mark.parametrize("count", [1, 4, 9])
@pytest.mark.parametrize("sites", [9, 17, 100, 1000])
def test_the_nearest_are_found(sites, count, axes):
    places = cloud(sites, axes)
    points = torch.cat([2 * cloud(300, axes, seed=1), places[:50]])  # some outside, some on sites
    assert_found(points, places, count)


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1.0, 1e6, 1e30])
def test_scenes_of_any_scale(scale):
    assert_found(scale * cloud(500, 3), scale * cloud(200, 3, seed=1), 4)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 9])
@pytest.mark.parametrize("far", [1e3, 1e12, 1e30])
def test_a_few_sites_and_points_far_away(far, count):
    sites = torch.cat([cloud(2000, 3), far * cloud(3, 3, seed=1)])
    assert_found(sites.float(), sites.float(), count)


def test_distances_over_many_decades():
    generator = torch.Generator().manual_seed(0)
    points, sites = (
        cloud(n, 3) * 10 ** (6 * torch.rand(n, 1, generator=generator, dtype=torch.float64))
        for n in (2000, 300)
    )
    assert_found(points, sites, 1)


def test_coincident_sites_are_not_compared_with_all_points(monkeypatch):
    """A tile has one list of leaves; of coincident ones, only those of its own points."""
    listed = []
    search = device_search._candidates

    def counted(*arguments):
        found = search(*arguments)
        listed.append(len(found[0]))
        return found

    monkeypatch.setattr(device_search, "_candidates", counted)
    sites = torch.zeros(5000, 3)
    rows, squared = nearest_in_tiles(sites, sites, 9)
    assert not squared.any()
    assert all(len(set(row)) == 9 for row in rows.tolist())
    assert listed[0] < 1000  # of 157 tiles times 256 leaves


def test_no_points():
    rows, squared = nearest_in_tiles(torch.zeros(0, 3), torch.zeros(5, 3), 2)
    assert (rows.shape, squared.shape) == ((0, 2), (0, 2))


def test_chunks_give_the_same(monkeypatch):
    points, sites = cloud(3000, 6), cloud(700, 6, seed=1)
    wanted = nearest_in_tiles(points, sites, 4)
    monkeypatch.setattr(device_search, "TILES", 3)
    monkeypatch.setattr(device_search, "DISTANCES", 1000)
    for found, same in zip(nearest_in_tiles(points, sites, 4), wanted, strict=True):
        assert torch.equal(found, same)


def test_entries_of_like_numbers_or_few_together_share_a_group():
    negative = [-100, -60, -50, -40, -9, -8, -3, -3, -1]
    groups = device_search._alike(negative, longest=160)
    assert groups == [
        (slice(0, 1), 100), (slice(1, 3), 60), (slice(3, 4), 40), (slice(4, 6), 9),
        (slice(6, 9), 3),
    ]  # fmt: skip
    assert device_search._alike([-5, -4, -3], longest=1) == [
        (slice(0, 1), 5), (slice(1, 2), 4), (slice(2, 3), 3),
    ]  # fmt: skip


def test_a_search_on_the_device_stays_there():
    points, sites = cloud(400, 6), cloud(100, 6, seed=1)
    with pretended_cuda() as traffic:
        there = points.to("cuda"), sites.to("cuda")
        traffic.copies.clear()
        _, squared = nearest_in_tiles(*there, 3)
        assert not traffic.copies
        assert traffic.waits.total() <= 9, traffic.waits
        torch.testing.assert_close(squared.cpu().sqrt(), smallest(points, sites, 3))


def low(boxes):
    return boxes.chunk(2, dim=1)[0]


def high(boxes):
    return -boxes.chunk(2, dim=1)[1]


@pytest.mark.parametrize("count", [1, 16, 17, 100, 1000])
def test_leaves_hold_every_site_and_its_home(count):
    sites = cloud(count, 3)
    leaves = split_sites(sites, 16)
    assert leaves.rows.shape[1] <= 16
    assert leaves.rows[~leaves.is_filling].sort().values.tolist() == list(range(count))
    assert torch.equal(leaves.sites, sites[leaves.rows])
    homes = home_leaves(sites, leaves.splits)
    assert (leaves.rows[homes] == torch.arange(count)[:, None]).any(dim=1).all()
    first, last = boxes_of(leaves.sites)[0], boxes_of(leaves.sites)[-1]
    assert len(low(first)) <= 8
    assert len(low(last)) == len(leaves.rows)
    assert torch.equal(low(first).amin(0), sites.amin(0))
    assert torch.equal(high(last).amax(0), sites.amax(0))


def test_boxes_are_rounded_outwards():
    sites = 1e-3 * cloud(4000, 3)
    boxes = box_corners(sites.view(-1, 1, 3))
    found = rounded_outwards(boxes, torch.tensor(0.1).double())
    assert found.dtype == torch.float32
    assert (low(found).double() <= low(boxes) / torch.tensor(0.1)).all()
    assert (high(found).double() >= high(boxes) / torch.tensor(0.1)).all()


def test_sites_at_one_position_have_neighbours_of_their_own():
    """Tiles break ties alike for all their points, which would then share a few neighbours."""
    places = torch.cat([torch.zeros(200, 3), cloud(100, 3).float()])
    with pretended_cuda():
        rows = nearest_neighbors(places.to("cuda"), 6).cpu()
    assert len(rows[:200].unique()) > 150
    assert bool((rows != torch.arange(300)[:, None]).all())


def test_several_sites_at_one_position_are_all_found():
    places = torch.cat([torch.zeros(200, 3), cloud(100, 3).float()])
    with pretended_cuda():
        found = nearest_several(places.to("cuda"), places.to("cuda"), 7)
        rows, distances = (values.cpu() for values in found)
    assert all(len(set(row)) == 7 for row in rows.tolist())
    torch.testing.assert_close(distances, smallest(places, places, 7), rtol=1e-6, atol=1e-7)


def test_a_search_among_sites_at_one_position_looks_at_one(monkeypatch):
    searched = []

    def search(points, sites, count):
        searched.append(len(sites))
        return nearest_in_tiles(points, sites, count)

    monkeypatch.setattr(nearest, "nearest_in_tiles", search)
    points, sites = cloud(100, 3), torch.cat([torch.zeros(500, 3), torch.ones(1, 3)]).double()
    with pretended_cuda():
        found = nearest_site(points.to("cuda"), sites.to("cuda"))
        labels, squared = (values.cpu() for values in found)
    assert searched == [2]
    wanted = smallest(points, sites, 1)[:, 0]
    torch.testing.assert_close(squared.sqrt(), wanted)
    torch.testing.assert_close((points - sites[labels]).norm(dim=1), wanted)
