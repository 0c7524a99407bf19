"""Allocation: cells merge in pairs, cheapest first, and members move to the cell that fits."""

import math

import pytest
import torch

from cvtgs import SimplifyConfig, cvt
from cvtgs.analysis import analyze
from cvtgs.cells import Moments, gaussian_moments, group_moments, merge_pairs, reassign
from cvtgs.config import AllocationConfig
from cvtgs.grouping import (
    allocate,
    allocation_at,
    finer_count,
    tessellate_rows,
    weigh_rows,
)
from cvtgs.math.segments import smallest_rows
from cvtgs.synthetic import scene as make
from scenes import random_scene

DEFAULT = AllocationConfig()


def points(places, *, colors=None, weights=None, size=0.01):
    """Round Gaussians along the first axis."""
    count = len(places)
    means = torch.zeros(3, count).double()
    means[0] = torch.tensor(places)
    covariances = torch.zeros(6, count).double()
    covariances[[0, 3, 5]] = size**2
    weights = torch.tensor(weights or [1.0] * count).double()
    shades = torch.tensor(colors or [0.5] * count).double().expand(3, -1).contiguous()
    ones, none = torch.ones_like(weights), means[:0]
    return Moments(ones, weights, weights, means, covariances, shades, none)


def all_others(count):
    rows = torch.arange(count)
    return torch.stack([rows[rows != row] for row in rows])


def all_pairs_near(near, labels, count):
    """Neighbours of groups: those of their members, padded with the groups themselves."""
    found = [sorted({int(labels[j]) for j in near[labels == i].flatten()}) for i in range(count)]
    width = max(map(len, found))
    return torch.tensor([others + [i] * (width - len(others)) for i, others in enumerate(found)])


def scene_moments(scene):
    analysis = analyze(scene, SimplifyConfig())
    rows = torch.arange(len(scene))
    return gaussian_moments(
        scene,
        rows,
        analysis.frame,
        masses=scene.masses,
        apparent_masses=analysis.apparent_areas * scene.opacities,
    )


def divergence(members, labels, count):
    """Sum the losses of merging members: log-volumes and squared colours."""
    groups = group_moments(members, labels, count)

    def matrices(moments):
        xx, xy, xz, yy, yz, zz = moments.covariances
        rows = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=1).unflatten(1, (3, 3))
        return rows + 1e-8 * torch.eye(3)

    own = matrices(groups)[labels]
    shifts = (members.means - groups.means[:, labels]).T[:, :, None]
    inside = torch.linalg.solve(own, matrices(members) + shifts @ shifts.transpose(1, 2))
    cost = 0.5 * (inside.diagonal(dim1=1, dim2=2).sum(1) + torch.logdet(own))
    return cost + DEFAULT.color * (members.colors - groups.colors[:, labels]).square().sum(0)


def test_the_nearest_pair_merges_first():
    labels = merge_pairs(points([0.0, 1.0, 5.0, 5.5]), all_others(4), 3, DEFAULT)
    assert labels.tolist() == [0, 1, 2, 2]


def test_unlike_colours_stay_apart():
    moments = points([0.0, 0.02, 0.06], colors=[0.0, 1.0, 1.0])
    assert merge_pairs(moments, all_others(3), 2, DEFAULT).tolist() == [0, 1, 1]
    blind = AllocationConfig(color=0.0)
    assert merge_pairs(moments, all_others(3), 2, blind).tolist() == [0, 0, 1]


def test_a_pair_that_images_hardly_show_merges_first():
    """The pair on the right lies a little farther apart, and is hardly seen."""
    moments = points([0.0, 1.0, 9.0, 10.1])
    moments = moments._replace(apparent_masses=torch.tensor([1.0, 1.0, 1e-4, 1e-4]).double())
    assert merge_pairs(moments, all_others(4), 3, DEFAULT).tolist() == [0, 1, 2, 2]
    equal = AllocationConfig(mass_power=0.0)
    assert merge_pairs(moments, all_others(4), 3, equal).tolist() == [0, 0, 1, 2]


def cost_of_a_pair(groups, config):
    table = torch.cat([torch.atleast_2d(values).float() for values in groups])
    (cost,) = merge_pairs.__wrapped__.__globals__["_pair_costs"](
        table, torch.tensor([0]), torch.tensor([1]), config, (0.0, 0.0)
    )
    return float(cost)


def test_the_cost_of_a_pair_by_hand():
    """Two round Gaussians of variance s^2, a apart: the variance between them grows by a^2 / 4.

    To each variance, a hundredth of the sum of variances and the floor are added.
    """
    groups, config = points([0.0, 0.3], size=0.1, colors=[0.2, 0.4]), AllocationConfig(mass_power=1)
    own, added = 0.01 + 0.01 * 0.03 + 1e-8, 0.01 * (0.03 + 0.0225) + 1e-8
    across, along = 0.01 + added, 0.01 + 0.0225 + added
    wanted = 0.5 * (math.log(along) + 2 * math.log(across) - 3 * math.log(own))
    wanted += config.color * 0.25 * 3 * 0.2**2
    assert cost_of_a_pair(groups, config) == pytest.approx(2.0 * 2.0 * wanted, rel=1e-5)
    groups = groups._replace(counts=torch.tensor([3.0, 4.0]).double())
    assert cost_of_a_pair(groups, config) == pytest.approx(2.0 * 7.0 * wanted, rel=1e-5)


def test_equal_groups_cost_nothing_and_overflowing_ones_merge_last():
    config = AllocationConfig()
    assert cost_of_a_pair(points([0.5, 0.5], size=0.3), config) == pytest.approx(0.0, abs=1e-6)
    assert cost_of_a_pair(points([0.0, 1e30]), config) == math.inf
    labels = merge_pairs(points([-1e30, 0.0, 1.0, 1e30]), all_others(4), 3, DEFAULT)
    assert labels.tolist() == [0, 1, 1, 2]


@pytest.mark.parametrize("size", [1e15, 1e40, 1e70])
def test_a_giant_changes_no_costs_of_others(size):
    """Beside a mean of 1e68, the masses of all others would be 0 in float32, and pairs free."""
    scene, factors = random_scene(300), torch.ones(300).double()
    near = cvt.nearest_neighbors(scene.means[1:], 12)

    def labels_of_others():
        masses, frame = factors * scene.masses, analyze(scene, SimplifyConfig()).frame
        moments = gaussian_moments(
            scene, torch.arange(300), frame, masses=masses, apparent_masses=masses
        )
        return merge_pairs(Moments(*(values[..., 1:] for values in moments)), near, 60, DEFAULT)

    alone = labels_of_others()
    factors[0] = size
    assert torch.equal(labels_of_others(), alone)


def test_pairs_that_merged_cost_as_much_as_the_moments_of_their_members():
    """Moments of groups are kept up to date from round to round, in float32."""
    members = scene_moments(random_scene(300))
    near = cvt.nearest_neighbors(members.means.T, 12)
    labels = merge_pairs(members, near, 110, DEFAULT)
    rounds, total = members, 300
    seen = torch.arange(300)
    while total > 110:  # the same, with moments computed from the members anew in each round
        keep = max(110, total - int(0.35 * total))
        own = merge_pairs(rounds, all_pairs_near(near, seen, total), keep, DEFAULT)
        seen, total = own[seen], keep
        rounds = group_moments(members, seen, total)
    assert torch.equal(labels, seen)


@pytest.mark.parametrize("count", [1, 2, 37, 99])
def test_every_count_is_met_exactly(count):
    moments = scene_moments(random_scene(100))
    neighbors = cvt.nearest_neighbors(moments.means.T, 12)
    labels = merge_pairs(moments, neighbors, count, DEFAULT)
    assert torch.equal(torch.unique(labels), torch.arange(count))
    assert torch.equal(labels, merge_pairs(moments, neighbors, count, DEFAULT))


def test_groups_without_neighbours_merge_too():
    """Neighbours that all became one group leave no pair; the count is met nevertheless."""
    near = torch.tensor([[1], [0], [3], [2]])
    labels = merge_pairs(points([0.0, 0.1, 7.0, 7.1]), near, 1, DEFAULT)
    assert labels.tolist() == [0, 0, 0, 0]


def greedy(first, second, costs, wanted):
    used, taken = set(), []
    for pair in sorted(range(len(costs)), key=lambda pair: (float(costs[pair]), pair)):
        ends = {int(first[pair]), int(second[pair])}
        if not used & ends and len(taken) < wanted:
            used |= ends
            taken.append(pair)
    return [(int(first[pair]), int(second[pair])) for pair in sorted(taken)]


@pytest.mark.parametrize("kind", ["random", "ties", "ascending"])
@pytest.mark.parametrize("wanted", [1, 12, 19, 500])
def test_disjoint_pairs_equal_those_of_a_loop_over_all_pairs(kind, wanted):
    """Along a chain of ascending costs, a round finds one pair only, and a loop the rest."""
    g = torch.Generator().manual_seed(0)
    first, second = torch.combinations(torch.arange(40)).T
    costs = torch.rand(len(first), generator=g)
    if kind == "ties":
        costs = (4 * costs).round()
    if kind == "ascending":
        first, second = torch.arange(199), torch.arange(1, 200)
        costs = torch.arange(199.0)
    take = merge_pairs.__wrapped__.__globals__["_cheapest_disjoint"]
    found = take(first, second, costs, wanted, 200)
    pairs = list(zip(*(ends.tolist() for ends in found), strict=True))
    assert pairs == greedy(first, second, costs, wanted)


def test_each_pair_appears_once_in_ascending_order():
    pairs_of = merge_pairs.__wrapped__.__globals__["_distinct_pairs"]
    first, second = torch.tensor([4, 2, 9, 2, 3, 0]), torch.tensor([2, 4, 0, 9, 3, 9])
    keys = pairs_of(first, second)
    assert [(key >> 32, key % 2**32) for key in keys.tolist()] == [(0, 9), (2, 4), (2, 9)]
    assert len(pairs_of(first[:0], first[:0])) == 0


@pytest.mark.parametrize("count", [1, 30, 49, 60, 200])
def test_only_the_cheapest_pairs_are_sorted(count: int) -> None:
    """Ties at the threshold keep the order of the pairs, as in a sort of all pairs."""
    costs = torch.randint(0, 12, (100,), generator=torch.Generator().manual_seed(3)).double()
    found = smallest_rows(costs, count)
    wanted = sorted(range(100), key=lambda pair: (float(costs[pair]), pair))[:count]
    assert found.tolist() == wanted


def test_moments_of_groups_equal_those_of_the_merge():
    """Two passes about the mean keep precision far from the origin, too."""
    members = points([100.0, 100.5, 300.0], weights=[1.0, 3.0, 2.0], size=0.1)
    groups = group_moments(members, torch.tensor([0, 0, 1]), 2)
    assert groups.masses.tolist() == [4.0, 2.0]
    assert groups.means[0].tolist() == pytest.approx([100.375, 300.0])
    spread = 0.01 + 0.25 * 0.75 * 0.25
    assert groups.covariances[0].tolist() == pytest.approx([spread, 0.01])


def test_members_move_to_the_group_that_fits_them_best():
    members = points([0.0, 0.1, 0.9, 1.0, 1.1], size=0.1)
    labels = torch.tensor([0, 0, 0, 1, 1])
    groups = group_moments(members, labels, 2)
    found = reassign(members, labels, groups, torch.tensor([[1], [0]]), DEFAULT)
    assert found.tolist() == [0, 0, 1, 1, 1]


def test_colour_counts_twice_its_weight_against_squared_distances():
    """At 2 and 1 standard deviations: group 0 where ``4 + 6 v^2 < 1 + 6 (1 - v)^2``, v < 1/4."""
    groups = points([0.0, 0.03], colors=[0.0, 1.0])
    members = points([0.0, 0.03, 0.02, 0.02], colors=[0.0, 1.0, 0.24, 0.26])
    config = AllocationConfig(color=1.0)
    found = reassign(members, torch.tensor([0, 1, 1, 0]), groups, torch.tensor([[1], [0]]), config)
    assert found.tolist() == [0, 1, 0, 1]


def test_no_group_becomes_empty():
    members = points([0.0, 0.01, 0.02], size=0.1)
    labels = torch.tensor([0, 1, 2])
    groups = group_moments(members, labels, 3)
    found = reassign(members, labels, groups, all_others(3), DEFAULT)
    assert sorted(found.tolist()) == [0, 1, 2]


@pytest.mark.parametrize("kind", ["object", "courtyard"])
def test_moving_members_lowers_the_divergence(kind):
    members = scene_moments(make(kind, 2000, sh_degree=0, seed=1))
    near = cvt.nearest_neighbors(members.means.T, 12)
    labels = merge_pairs(members, near, 200, DEFAULT)
    groups = group_moments(members, labels, 200)
    near = cvt.nearest_neighbors(groups.means.T, 7)
    found = reassign(members, labels, groups, near, DEFAULT)
    assert 0 < int((found != labels).sum()) < 1800
    before, after = divergence(members, labels, 200), divergence(members, found, 200)
    assert float((members.masses * after).sum()) < float((members.masses * before).sum())


def test_merged_cells_lose_less_than_those_of_the_tessellation():
    scene, target = make("object", 4000, sh_degree=0, seed=2), 200
    members, losses = scene_moments(scene), []
    for oversampling in (DEFAULT.oversampling, 1.0):
        allocation = {"oversampling": oversampling, "reassign": False}
        config = SimplifyConfig.from_mapping({"allocation": allocation})
        analysis = analyze(scene, config)
        points = weigh_rows(scene, torch.arange(len(scene)), analysis, config)
        tessellation = tessellate_rows(points, analysis, target, config)
        labels = torch.empty(len(scene), dtype=torch.int64)
        labels[points.rows] = allocate(points, tessellation, analysis, target, config.allocation)
        losses.append(float(divergence(members, labels, target).sum()))
    assert losses[0] < losses[1]


def test_without_allocation_the_cells_of_the_tessellation_are_kept():
    off = AllocationConfig(oversampling=1.0, reassign=False)
    scene, config = make("object", 50, sh_degree=0, seed=0), SimplifyConfig()
    analysis = analyze(scene, config)
    points = weigh_rows(scene, torch.arange(50), analysis, config)
    tessellation = cvt.tessellate(scene.means, points.weights, 5, config=config.cvt)
    assert allocate(points, tessellation, analysis, 5, off) is tessellation.labels
    assert finer_count(10, 12, off) == 10
    assert finer_count(10, 320, DEFAULT) == 80
    assert finer_count(10, 319, DEFAULT) == 319


def test_colours_count_more_where_cells_are_small():
    config = AllocationConfig(color=100.0, color_power=0.5)
    assert allocation_at(0.25, config, unbounded=0.0).color == pytest.approx(50.0)
    assert allocation_at(0.01, config, unbounded=0.0).color == pytest.approx(10.0)


def test_contrast_is_that_of_neighbours_by_hand():
    """Half of the mean squared difference: one of two neighbours differs by 0.3 in each channel."""
    contrast = merge_pairs.__wrapped__.__globals__["_relative_contrast"]
    near = torch.tensor([[1], [0], [3], [2]])
    groups = points([0.0, 1.0, 5.0, 5.5], colors=[0.1, 0.4, 0.7, 0.7])
    assert contrast(groups.colors, near) == pytest.approx(math.sqrt(0.5 * 0.5 * 3 * 0.3**2) / 0.2)
    alike = points([0.0, 1.0, 5.0, 5.5])
    assert contrast(alike.colors, near) == 0.3
    assert contrast(10 * groups.colors, near) == 1.4
    assert contrast(alike.colors[:, :1], near[:1, :0]) == 0.3


def watched_costs(monkeypatch, *names):
    """Return a list that gets these weights whenever costs of pairs are computed."""
    seen = []
    costs = merge_pairs.__wrapped__.__globals__["_pair_costs"]

    def noted(table, first, second, config, heavy):
        seen.append(tuple(getattr(config, name) for name in names))
        return costs(table, first, second, config, heavy)

    monkeypatch.setitem(merge_pairs.__wrapped__.__globals__, "_pair_costs", noted)
    return seen


def test_masses_count_more_and_colours_less_where_neighbours_differ(monkeypatch):
    """Weights are those of the configuration at the common contrast."""
    seen = watched_costs(monkeypatch, "mass_power", "color")
    config = AllocationConfig(mass_power=0.6, color=30.0)
    step = 0.2 * math.sqrt(2 / 3)  # of a contrast of 0.2
    for factor in (0.0, 0.5, 1.0, 9.0):
        shades = [0.0, factor * step, 0.0, factor * step]
        moments = points([0.0, 1.0, 2.0, 3.0], colors=shades)
        near = torch.tensor([[1], [0], [3], [2]])
        merge_pairs(moments, near, 3, config)
    wanted = [(0.6 * s, 30.0 / s) for s in (0.3, 0.5, 1.0, 1.4)]
    assert seen == [pytest.approx(pair) for pair in wanted]


@pytest.mark.parametrize("place", [0.0, 40.0])
def test_pairs_that_viewers_see_at_a_wide_angle_cost_more(place):
    """Both together have variances of s^2 + a^2 / 4 and twice s^2; viewers are 3 radii around."""
    size, apart = 8.0, 12.0
    pair = points([place - 6.0, place + 6.0], size=size)
    width = (3 * size**2 + apart**2 / 4) / (place**2 + 9.0)
    plain = cost_of_a_pair(pair, AllocationConfig(widest=0.0))
    for widest in (0.3, 0.55, 5.0):
        wanted = plain * (1.0 + (width / widest**2) ** 4)
        assert cost_of_a_pair(pair, AllocationConfig(widest=widest)) == pytest.approx(wanted, 1e-4)


def test_a_wide_sky_merges_after_near_groups():
    """By divergence alone, the two wide ones on the right are the cheaper pair."""
    moments = points([0.0, 0.2, 20.0, 26.0])
    sizes = torch.tensor([0.1, 0.1, 12.0, 12.0]).double()
    covariances = moments.covariances.clone()
    covariances[[0, 3, 5]] = sizes.square()
    moments = moments._replace(covariances=covariances)
    unlimited = AllocationConfig(widest=0.0)
    assert merge_pairs(moments, all_others(4), 3, unlimited).tolist() == [0, 1, 2, 2]
    assert merge_pairs(moments, all_others(4), 3, DEFAULT).tolist() == [0, 0, 1, 2]


def test_far_mass_lowers_the_power_of_masses(monkeypatch):
    """Without any, nothing is wide enough to be a sky."""
    seen = watched_costs(monkeypatch, "mass_power", "widest")
    config = AllocationConfig(mass_power=1.0, far_relief=0.5, widest=0.6)
    for place, mass in ((2.9, 1.0), (3.1, 1.0), (3.1, 7.0), (3.1, 0.0)):
        moments = points([0.0, 0.1, place])
        moments = moments._replace(apparent_masses=torch.tensor([0.5, 0.5, mass]).double())
        merge_pairs(moments, all_others(3), 2, config)
    wanted = [(0.3, 0.0), (0.3 * 0.75, 0.6), (0.3 * (1 - 0.5 * 0.875), 0.6), (0.3, 0.0)]
    assert seen == [pytest.approx(pair) for pair in wanted]


def test_far_mass_counts_less_below_a_tenth():
    config = AllocationConfig(far_relief=0.5)
    found = [allocation_at(rho, config, unbounded=1.0).far_relief for rho in (0.3, 0.05, 0.001)]
    assert found == pytest.approx([0.5, 0.25, 0.005])


def test_large_groups_merge_last():
    """By divergence alone, the group of thirty and its neighbour are the cheapest pair."""
    moments = points([0.0, 0.1, 9.0, 9.5], size=0.1)
    assert merge_pairs(moments, all_others(4), 3, DEFAULT).tolist() == [0, 0, 1, 2]
    moments = moments._replace(counts=torch.tensor([30.0, 1.0, 1.0, 1.0]).double())
    assert merge_pairs(moments, all_others(4), 3, DEFAULT).tolist() == [0, 1, 2, 2]


def test_rounds_keep_groups_balanced():
    """By divergence alone, four near ones would become one before the pairs on the right merge."""
    moments = points([0.0, 0.1, 0.2, 0.3, 5.0, 5.25, 9.0, 9.25], size=0.1)
    labels = merge_pairs(moments, all_others(8), 4, DEFAULT)
    assert labels.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
