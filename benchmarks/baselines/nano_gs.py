"""NanoGS (Xiong, Liu, Zhou, Chen, Fan, Feng: arXiv 2603.16103, 2026): greedy merging of pairs.

Gaussians with opacities below 0.1 are dropped. Then each pass builds the graph of the 16 nearest
neighbours, computes a cost for every edge, takes disjoint edges greedily, cheapest first, and
replaces each pair by one Gaussian. A pass at most halves the scene; passes repeat until M are left,
and the last pass merges only as many pairs as needed.

- Merge by "mass-preserved moment matching": weights are opacity times volume; mean, covariance and
  SH coefficients are weighted means (the covariance with the spread of the means); the opacity is
  ``a + b - a b``.
- Cost: the Kullback-Leibler divergence from the pair's mixture to its merge, plus the squared
  difference of the SH coefficients.

Differences, since we had neither the paper's equations nor its code (whose licence forbids
copying; its behaviour is known from a description):

- The divergence of a mixture has no closed form. We use the upper bound of Runnalls (2007):
  ``log det S_merged / 2 - sum of w_i log det S_i / 2`` with weights that sum to 1, which needs no
  samples or random numbers.
- The squared difference of SH coefficients has the factor 1.
- We infer that the original drops faint Gaussians: it loses haze, and without the filter ours is
  far behind. On the scene guitar at rho 0.1 / 0.01 / 0.001 the original measured 26.9 / 22.1 /
  20.2 dB, ours 26.6 / 21.9 / 18.7 with the filter and 24.1 / 21.3 / 18.3 without. If fewer than M
  would remain, the heaviest of the faint Gaussians stay too.
"""

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from benchmarks.baselines.gaussians import covariances_of, from_moments, usable
from cvtgs.filters import visible_rows
from cvtgs.math import parameters
from cvtgs.scene import GaussianScene

MIN_OPACITY = 0.1
NEIGHBORS = 16
COLOR = 1.0
CHUNK = 1 << 18


def simplify(scene: GaussianScene, count: int, *, seed: int = 0) -> GaussianScene:
    """Merge pairs until ``count`` Gaussians are left; nothing is random."""
    small = visible(usable(scene, count), count)
    while len(small) > count:
        edges = neighbor_edges(small.means)
        pairs = disjoint_edges(edges, edge_costs(small, edges), nodes=len(small))
        small = merge_pairs(small, pairs[: len(small) - count])
    return small


def visible(scene: GaussianScene, at_least: int) -> GaussianScene:
    """Drop faint Gaussians, but keep at least ``at_least`` Gaussians."""
    return scene.select(
        visible_rows(
            scene.opacities,
            scene.masses,
            min_opacity=MIN_OPACITY,
            max_mass_share=1.0,
            at_least=at_least,
        )
    )


def neighbor_edges(means: Float[Tensor, "n 3"]) -> Int[Tensor, "e 2"]:
    """Return the edges to the nearest neighbours, each once with the smaller row first."""
    places = means.double().numpy()
    near = min(NEIGHBORS + 1, len(places))
    found = torch.from_numpy(KDTree(places).query(places, k=near)[1])
    rows = torch.arange(len(places))[:, None].expand_as(found)
    pairs = torch.stack([torch.minimum(rows, found), torch.maximum(rows, found)], dim=2)
    pairs = pairs.flatten(0, 1)
    edges: Tensor = torch.unique(pairs[pairs[:, 0] < pairs[:, 1]], dim=0)
    return edges


def edge_costs(scene: GaussianScene, edges: Int[Tensor, "e 2"]) -> Float[Tensor, "e"]:
    """Return the cost of merging the two ends of each edge. Memory: 1 kB per edge of a chunk."""
    shapes, log_weights = covariances_of(scene), log_masses(scene)
    log_dets = torch.logdet(shapes)
    costs = []
    for part in edges.split(CHUNK):
        shares = log_weights[part].softmax(dim=1)
        _, merged = merged_moments(scene.means.double()[part], shapes[part], shares)
        geometry = (torch.logdet(merged) - (shares * log_dets[part]).sum(dim=1)) / 2
        first, second = (scene.sh[part[:, end]].double() for end in (0, 1))
        costs.append(geometry + COLOR * (first - second).square().sum(dim=(1, 2)))
    return torch.cat(costs)


def log_masses(scene: GaussianScene) -> Float[Tensor, "n"]:
    """Return the logarithm of opacity times volume, up to a constant."""
    return scene.opacities.double().log() + scene.log_scales.double().sum(dim=1)


def merged_moments(
    means: Float[Tensor, "e 2 3"], shapes: Float[Tensor, "e 2 3 3"], shares: Float[Tensor, "e 2"]
) -> tuple[Float[Tensor, "e 3"], Float[Tensor, "e 3 3"]]:
    """Compute mean and covariance of pairs; the shares of a pair sum to 1."""
    gap = means[:, 1] - means[:, 0]
    center = means[:, 0] + shares[:, 1:] * gap
    inner = (shares[:, :, None, None] * shapes).sum(dim=1)
    spread = shares.prod(dim=1)[:, None, None] * gap[:, :, None] * gap[:, None, :]
    return center, inner + spread


def disjoint_edges(
    edges: Int[Tensor, "e 2"], costs: Float[Tensor, "e"], *, nodes: int
) -> Int[Tensor, "m 2"]:
    """Take edges without common ends greedily, cheapest first; return them sorted by cost.

    Edges that are the cheapest at both ends are taken together, and edges that touch them are
    removed (locally dominant edges, Preis 1999). The result is that of sequential greedy search.
    """
    ranked = edges[torch.sort(costs, stable=True).indices]
    left = torch.arange(len(ranked))
    taken = []
    while len(left) > 0:
        ends = ranked[left]
        best = torch.full((nodes,), len(ranked))
        best.scatter_reduce_(0, ends.flatten(), left.repeat_interleave(2), "amin")
        dominant = (best[ends] == left[:, None]).all(dim=1)
        taken.append(left[dominant])
        busy = torch.zeros(nodes, dtype=torch.bool)
        busy[ends[dominant].flatten()] = True
        left = left[~busy[ends].any(dim=1)]
    return ranked[torch.cat(taken).sort().values]


def merge_pairs(scene: GaussianScene, pairs: Int[Tensor, "m 2"]) -> GaussianScene:
    """Replace each pair by one Gaussian; the others stay unchanged and come first."""
    shares = log_masses(scene)[pairs].softmax(dim=1)
    means, shapes = merged_moments(
        scene.means.double()[pairs], covariances_of(scene)[pairs], shares
    )
    depths = parameters.optical_depth_from_logit(scene.logit_opacities.double()[pairs])
    mean = {
        name: (shares[:, :, None, None] * getattr(scene, name).double()[pairs]).sum(dim=1)
        for name in ("sh0", "shN")
    }
    # 1 - (1 - a)(1 - b): optical depths add up.
    opacity = {"logit_opacities": parameters.logit_from_optical_depth(depths.sum(dim=1))}
    merged = from_moments(scene, means, shapes, mean | opacity)
    alone = torch.ones(len(scene), dtype=torch.bool)
    alone[pairs.flatten()] = False
    others = scene.select(alone).tensors()
    return scene.with_tensors(
        {name: torch.cat([others[name], values]) for name, values in merged.tensors().items()}, {}
    )
