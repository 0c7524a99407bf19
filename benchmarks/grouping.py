"""k-NN grouping, the simple way to make cells that the tessellation is compared with."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

import cvtgs
from cvtgs import cells, cvt
from cvtgs.mergenet import MergeNet, correct_cells
from cvtgs.pipeline import merge_cells
from cvtgs.train.cases import MergedScene, merge_scene
from cvtgs.validity import standardized


def nearest_groups(points: Float[Tensor, "n d"], count: int, *, seed: int) -> Int[Tensor, "n"]:
    """Group points around random ones: each seed takes its nearest free points.

    Seeds are drawn uniformly, without replacement. In the order of the draw each takes the
    ``floor(n / count) - 1`` points nearest to it that are neither a seed nor taken. The fewer than
    ``count`` points that are left over join their nearest seed. No weights, no colours, no
    iterations: groups are of nearly equal size, and late ones are not compact, since they find
    their surroundings taken. Memory: two k-d trees, some ``150 n`` bytes.

    "k-NN grouping" is what the alternative to the tessellation is called; this is our reading of
    the name.

    Args:
        points: Positions.
        count: Number of groups, 1 to n.
        seed: Seed of the draw.

    Returns:
        Group of every point, 0 to ``count - 1``; none is empty.

    Example:
        >>> nearest_groups(torch.tensor([[0.0], [1.0], [9.0], [8.0]]), 2, seed=1).tolist()
        [0, 0, 1, 1]
    """
    places = points.double().numpy()
    draw = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))
    seeds = draw[:count].numpy()
    labels = np.full(len(points), -1)
    labels[seeds] = np.arange(count)
    wanted = len(points) // count - 1
    rows = np.arange(len(points))
    tree = KDTree(places)
    taken = count
    for group, place in enumerate(places[seeds]) if wanted else ():
        # A tree of which at least half is free finds free points without looking at many.
        if 2 * (len(points) - taken) < len(rows):
            rows = rows[labels[rows] < 0]
            tree = KDTree(places[rows])
        labels[nearest_free(tree, rows, place, labels=labels, count=wanted)] = group
        taken += wanted
    left = (labels < 0).nonzero()[0]
    labels[left] = KDTree(places[seeds]).query(places[left])[1]
    return torch.from_numpy(labels)


def nearest_free(
    tree: KDTree, rows: np.ndarray, place: np.ndarray, *, labels: np.ndarray, count: int
) -> np.ndarray:
    """Find the nearest rows of a tree that have no label, looking ever further."""
    looked_at = 2 * count
    while True:
        looked_at = min(looked_at, len(rows))
        found = rows[np.atleast_1d(tree.query(place, k=looked_at)[1])]
        free: np.ndarray = found[labels[found] < 0]
        if len(free) >= count or looked_at == len(rows):
            return free[:count]
        looked_at *= 2


def grouped_simplifier(
    config: cvtgs.SimplifyConfig, net: MergeNet | None
) -> Callable[[cvtgs.GaussianScene, float], cvtgs.GaussianScene]:
    """Simplify with k-NN groups instead of the tessellation; all else as configured."""

    def simplify(scene: cvtgs.GaussianScene, rho: float) -> cvtgs.GaussianScene:
        count = cvtgs.target_count(len(scene), rho)
        all_members = config.merge.model_copy(update={"representatives": False})
        whole = config.model_copy(update={"merge": all_members})
        reference = merge_scene(scene, count, whole)
        rows = reference.partition.order.sort().values  # those that passed the filter
        labels = nearest_groups(reference.scene.means[rows], count, seed=config.seed)
        local = cells.Partition.from_labels(labels, count)
        partition = cells.Partition(order=rows[local.order], offsets=local.offsets)
        return regroup(reference, partition, config, net=net)

    return simplify


def regroup(
    reference: MergedScene,
    partition: cells.Partition,
    config: cvtgs.SimplifyConfig,
    *,
    net: MergeNet | None,
) -> cvtgs.GaussianScene:
    """Merge, widen and correct the cells of any grouping, as the stages do.

    With the partition of the reference itself this gives what ``Simplifier`` gives.
    """
    scene = reference.scene
    merged = merge_cells(
        scene,
        partition,
        config.merge,
        areas=scene.areas,
        backend=cvt.nearest_backend(config.cvt.backend, scene.device)[0],
        with_network=net is not None,
    )
    if net is None:
        return standardized(merged.scene)
    corrected = correct_cells(
        net,
        scene,
        merged.scene,
        merged.partition,
        neighbors=merged.neighbors,
        visibility=reference.visibility,
    )
    return standardized(corrected)
