"""GHAP, Gaussian Herding across Pens (Wang, Li, Zeng, Meng, Zhang: arXiv 2506.09534, NeurIPS 2025).

The geometry of a scene is an unnormalised Gaussian mixture ``sum a_i N(mean_i, cov_i)`` with the
opacities as weights. A k-d tree cuts it into blocks. In each block a smaller mixture minimises the
composite transport divergence, by majorisation and minimisation (Zhang et al. 2020):

    assign    c(i) = argmin over c of KL(N_i || N_c)
    minimise  mean_c and cov_c match the moments of the members, weighted by opacity

which is k-means on means and covariances: moments minimise the weighted sum of those divergences.
Colour and opacity are copied from the original Gaussian with the nearest mean.

Differences from the paper:

- The paper's second stage, fine-tuning of the appearance on training images, is left out.
- Each block gets its share of M in proportion to its number of Gaussians, by largest remainders, so
  that the count is exact; the tree is shallower if there are too few Gaussians for 1024 blocks.
- Centres start at members drawn uniformly at random; a centre that loses its members restarts at
  the member with the largest divergence. There are at most ten iterations.
"""

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from benchmarks.baselines.gaussians import covariances_of, from_moments, usable
from cvtgs.scene import GaussianScene

BLOCKS = 1024
MEMBERS = 64
"""Smallest number of Gaussians in a block."""

ITERATIONS = 10


def simplify(scene: GaussianScene, count: int, *, seed: int = 0) -> GaussianScene:
    """Reduce the mixture to ``count`` Gaussians; the seed determines the initial centres."""
    valid = usable(scene, count)
    means, shapes = valid.means.double(), covariances_of(valid)
    generator = torch.Generator().manual_seed(seed)
    blocks = kd_blocks(means, max(1, min(BLOCKS, len(valid) // MEMBERS, count)))
    sizes = torch.tensor([len(block) for block in blocks])
    reduced = [
        reduce_block(
            means[block], shapes[block], valid.opacities[block].double(), count=quota, g=generator
        )
        for block, quota in zip(blocks, quotas(sizes, count).tolist(), strict=True)
        if quota > 0
    ]
    new_means, new_shapes = (torch.cat(parts) for parts in zip(*reduced, strict=True))
    nearest = torch.from_numpy(KDTree(means.numpy()).query(new_means.numpy())[1])
    appearance = {name: getattr(valid, name)[nearest] for name in ("logit_opacities", "sh0", "shN")}
    return from_moments(valid, new_means, new_shapes, appearance)


def kd_blocks(means: Float[Tensor, "n 3"], most: int) -> list[Int[Tensor, "b"]]:
    """Halve blocks at the median of their widest axis while at most ``most`` blocks result."""
    blocks = [torch.arange(len(means))]
    while 2 * len(blocks) <= most:
        blocks = [half for block in blocks for half in halves(means, block)]
    return blocks


def halves(means: Float[Tensor, "n 3"], block: Int[Tensor, "b"]) -> tuple[Tensor, Tensor]:
    places = means[block]
    axis = int((places.amax(dim=0) - places.amin(dim=0)).argmax())
    order = torch.sort(places[:, axis], stable=True).indices
    middle = len(block) // 2
    return block[order[:middle]], block[order[middle:]]


def quotas(sizes: Int[Tensor, "b"], count: int) -> Int[Tensor, "b"]:
    """Split ``count`` in proportion to sizes, by largest remainders."""
    exact = sizes.double() * count / sizes.sum()
    shares = exact.floor().long()
    remainders = torch.sort(exact - shares, descending=True, stable=True).indices
    shares[remainders[: count - int(shares.sum())]] += 1
    return shares


def reduce_block(
    means: Float[Tensor, "n 3"],
    shapes: Float[Tensor, "n 3 3"],
    weights: Float[Tensor, "n"],
    *,
    count: int,
    g: torch.Generator,
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3 3"]]:
    """Minimise the composite transport divergence from random centres."""
    middle = means.mean(dim=0)
    local = means - middle
    drawn = torch.randperm(len(means), generator=g)[:count]
    centers, spreads = local[drawn], shapes[drawn]
    labels = None
    for _ in range(ITERATIONS):
        costs = divergences(local, shapes, centers, spreads)
        last, labels = labels, filled(costs.argmin(dim=1), costs, count)
        if last is not None and bool((last == labels).all()):
            break
        centers, spreads = moments(local, shapes, weights, labels=labels, count=count)
    return centers + middle, spreads


def divergences(
    means: Float[Tensor, "n 3"],
    shapes: Float[Tensor, "n 3 3"],
    centers: Float[Tensor, "m 3"],
    spreads: Float[Tensor, "m 3 3"],
) -> Float[Tensor, "n m"]:
    """Return ``KL(N_i || N_c)`` of all pairs, in nats.

    ``(tr(S_c^-1 S_i) + (x_i - x_c)^T S_c^-1 (x_i - x_c) - 3 + log det S_c - log det S_i) / 2``.
    """
    inverse = torch.linalg.inv(spreads)
    trace = shapes.flatten(1) @ inverse.flatten(1).T
    offsets = means[:, None] - centers
    distance = torch.einsum("nmi,mij,nmj->nm", offsets, inverse, offsets)
    logs = torch.logdet(spreads) - torch.logdet(shapes)[:, None]
    found: Tensor = (trace + distance - 3 + logs) / 2
    return found


def filled(labels: Int[Tensor, "n"], costs: Float[Tensor, "n m"], count: int) -> Int[Tensor, "n"]:
    """Give every empty cluster the costliest member of a cluster with more than one."""
    labels = labels.clone()
    sizes = labels.bincount(minlength=count)
    for empty in (sizes == 0).nonzero()[:, 0].tolist():
        own = costs.gather(1, labels[:, None])[:, 0]
        worst = int(torch.where(sizes[labels] > 1, own, -torch.inf).argmax())
        sizes[labels[worst]] -= 1
        sizes[empty] += 1
        labels[worst] = empty
    return labels


def moments(
    means: Float[Tensor, "n 3"],
    shapes: Float[Tensor, "n 3 3"],
    weights: Float[Tensor, "n"],
    *,
    labels: Int[Tensor, "n"],
    count: int,
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3 3"]]:
    """Compute mean and covariance of every cluster's mixture."""
    totals = torch.zeros(count, dtype=weights.dtype).index_add_(0, labels, weights)
    shares = weights / totals[labels]
    centers = torch.zeros(count, 3, dtype=means.dtype)
    centers.index_add_(0, labels, shares[:, None] * means)
    offsets = means - centers[labels]
    inner = shapes + offsets[:, :, None] * offsets[:, None, :]
    spreads = torch.zeros(count, 3, 3, dtype=means.dtype)
    return centers, spreads.index_add_(0, labels, shares[:, None, None] * inner)
