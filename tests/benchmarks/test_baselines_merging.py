"""Baselines that merge, against their papers' descriptions."""

import itertools
import math

import numpy as np
import pytest
import torch

import cvtgs
import oracles
from baseline_cases import gaussians
from benchmarks.baselines import baseline, ghap, nano_gs
from cvtgs.validity import standardized
from scenes import random_scene

pytestmark = pytest.mark.slow


def divergence(mean, cov, center, spread) -> float:
    """``KL(N(mean, cov) || N(center, spread))``, from its definition."""
    inverse, gap = np.linalg.inv(spread), center - mean
    value = np.trace(inverse @ cov) + gap @ inverse @ gap - 3
    return 0.5 * (value + math.log(np.linalg.det(spread) / np.linalg.det(cov)))


def covariance_list(scene: cvtgs.GaussianScene) -> list[np.ndarray]:
    rows = zip(scene.log_scales.tolist(), scene.quats.tolist(), strict=True)
    return [oracles.covariance(scales, quat) for scales, quat in rows]


def greedy(edges, costs) -> list[tuple[int, int]]:
    """Take the cheapest edge that touches none of those taken, one by one."""
    taken, busy = [], set()
    for edge in sorted(range(len(edges)), key=lambda edge: (costs[edge], edge)):
        if not busy & set(edges[edge]):
            taken.append(tuple(edges[edge]))
            busy |= set(edges[edge])
    return taken


# GHAP


def test_quotas_are_proportional_and_exact():
    assert ghap.quotas(torch.tensor([10, 20, 30]), 6).tolist() == [1, 2, 3]
    assert ghap.quotas(torch.tensor([10, 10, 10]), 4).tolist() == [2, 1, 1]
    for count in range(1, 31):
        shares = ghap.quotas(torch.tensor([7, 8, 8, 7]), count)
        assert int(shares.sum()) == count
        assert (shares <= torch.tensor([7, 8, 8, 7])).all()


def test_blocks_are_halves_along_the_widest_axis():
    means = torch.tensor([[0.0, 9], [1, 0], [2, 9], [3, 0]]).repeat(1, 2)[:, :3]
    blocks = ghap.kd_blocks(means * torch.tensor([10.0, 1, 1]), 3)
    assert [block.tolist() for block in blocks] == [[0, 1], [2, 3]]
    everything = torch.cat(ghap.kd_blocks(torch.randn(100, 3), 8))
    assert sorted(everything.tolist()) == list(range(100))


def test_divergences_and_moments_equal_the_formulas():
    scene = standardized(random_scene(12, dtype=torch.float64))
    shapes = covariance_list(scene)
    stacked = torch.tensor(np.array(shapes))
    found = ghap.divergences(scene.means, stacked, scene.means[:5], stacked[:5])
    places = scene.means.numpy()
    for i, c in itertools.product(range(12), range(5)):
        wanted = divergence(places[i], shapes[i], places[c], shapes[c])
        assert float(found[i, c]) == pytest.approx(wanted, rel=1e-7, abs=1e-9)
    labels = torch.arange(12) % 4
    weights = scene.opacities
    centers, spreads = ghap.moments(scene.means, stacked, weights, labels=labels, count=4)
    for cluster in range(4):
        rows = range(cluster, 12, 4)
        shares = weights[cluster::4].numpy() / weights[cluster::4].numpy().sum()
        center = sum(s * places[row] for s, row in zip(shares, rows, strict=True))
        spread = sum(
            s * (shapes[row] + np.outer(places[row] - center, places[row] - center))
            for s, row in zip(shares, rows, strict=True)
        )
        assert np.allclose(centers[cluster].numpy(), center)
        assert np.allclose(spreads[cluster].numpy(), spread)


def test_ghap_by_hand():
    """Two far pairs become two: moments of the pair, appearance of the nearest original."""
    scene = gaussians(
        [[-0.1, 0, 0], [0.1, 0, 0], [9.9, 0, 0], [10.1, 0, 0]],
        opacities=[0.6, 0.2, 0.3, 0.3],
        scales=[0.5] * 4,
        colors=[[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1]],
    )
    tries = [baseline("GHAP")(scene, 2, seed=seed) for seed in range(20)]
    ordered = [small.select(small.means[:, 0].sort().indices) for small in tries]
    near = min(ordered, key=lambda small: float(small.scales.sum()))  # k-means may get stuck
    assert near.means[:, 0].tolist() == pytest.approx([-0.05, 10.0])
    assert near.opacities.tolist() == pytest.approx([0.6, 0.3])
    assert near.sh0[:, 0].tolist() == [[1.0, 0, 0], [0, 0, 1]]
    along = 0.25 + 0.75 * 0.25 * 0.2**2
    assert float(near.scales[0].amax()) == pytest.approx(math.sqrt(along))
    assert float(near.scales[0].amin()) == pytest.approx(0.5)


# NanoGS


def test_edges_join_nearest_neighbours_once():
    line = torch.tensor([[float(x), 0, 0] for x in range(40)])
    edges = [tuple(edge) for edge in nano_gs.neighbor_edges(line).tolist()]
    assert len(set(edges)) == len(edges)
    assert all(a < b for a, b in edges)
    assert all((20, 20 + step) in edges for step in range(1, 9))
    assert (0, 16) in edges  # at the end all 16 are on one side
    assert (0, 17) not in edges


def test_costs_are_divergence_and_squared_difference_of_colours():
    scene = standardized(random_scene(6, dtype=torch.float64, degree=1))
    edges = torch.tensor([[0, 1], [2, 5], [3, 4]])
    found = nano_gs.edge_costs(scene, edges)
    shapes, places = covariance_list(scene), scene.means.numpy()
    masses = scene.opacities.numpy() * np.exp(scene.log_scales.sum(dim=1).numpy())
    for cost, pair in zip(found.tolist(), edges.tolist(), strict=True):
        shares = masses[pair] / masses[pair].sum()
        center = sum(s * places[row] for s, row in zip(shares, pair, strict=True))
        spread = sum(
            s * (shapes[row] + np.outer(places[row] - center, places[row] - center))
            for s, row in zip(shares, pair, strict=True)
        )
        wanted = sum(
            s * divergence(places[row], shapes[row], center, spread)
            for s, row in zip(shares, pair, strict=True)
        )
        colors = scene.sh[pair].numpy()
        assert cost == pytest.approx(wanted + ((colors[0] - colors[1]) ** 2).sum())


@pytest.mark.parametrize("seed", range(5))
def test_disjoint_edges_are_those_of_the_greedy_search(seed):
    g = torch.Generator().manual_seed(seed)
    edges = nano_gs.neighbor_edges(torch.randn(60, 3, generator=g))
    costs = torch.randint(0, 30, (len(edges),), generator=g).double()  # with ties
    found = nano_gs.disjoint_edges(edges, costs, nodes=60)
    assert [tuple(edge) for edge in found.tolist()] == greedy(edges.tolist(), costs.tolist())


def test_merging_a_pair_by_hand():
    """Masses 0.5 and 0.25 * 8 share as 1 to 4; opacity 0.5 + 0.25 - 0.125."""
    scene = gaussians(
        [[0.0, 0, 0], [5.0, 0, 0]],
        opacities=[0.5, 0.25],
        scales=[1.0, 2.0],
        colors=[[1.0, 0, 0], [0, 1, 0]],
    )
    small = baseline("NanoGS")(scene, 1)
    assert small.means.tolist()[0] == pytest.approx([4.0, 0, 0])
    assert small.opacities.tolist() == pytest.approx([0.625])
    assert small.sh0[0, 0].tolist() == pytest.approx([0.2, 0.8, 0])
    within = 0.2 * 1 + 0.8 * 4
    axes = [math.sqrt(within + 0.2 * 0.8 * 25), math.sqrt(within), math.sqrt(within)]
    assert small.scales.tolist()[0] == pytest.approx(axes)


def test_similar_neighbours_merge_first_and_the_rest_stay_bit_for_bit():
    """Of three equally spaced ones, those of one colour merge."""
    scene = gaussians(
        [[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]],
        opacities=[0.5] * 3,
        scales=[0.5] * 3,
        colors=[[1.0, 0, 0], [0, 1, 0], [0, 1, 0]],
    )
    small = baseline("NanoGS")(scene, 2)
    assert small.means[:, 0].tolist() == pytest.approx([0.0, 1.5])
    assert torch.equal(small.sh0[0], scene.sh0[0])


def test_faint_gaussians_are_dropped_first_unless_they_are_needed():
    """One of four is visible; where two are to stay, the heaviest faint one is the second."""
    scene = gaussians(
        [[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0]],
        opacities=[0.5, 0.05, 0.06, 0.07],
        scales=[0.5, 2.0, 0.5, 0.5],
    )
    assert baseline("NanoGS")(scene, 1).means[:, 0].tolist() == [0.0]
    assert baseline("NanoGS")(scene, 2).means[:, 0].tolist() == [0.0, 1.0]
