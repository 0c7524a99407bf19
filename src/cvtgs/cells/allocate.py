"""Allocation: merge similar cells in pairs, and move Gaussians to the cell that fits them best.

A Voronoi cell reflects where its Gaussians lie, not the error of replacing them by one. So the
tessellation makes more cells than are wanted, and the cheapest pairs merge.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.analysis import far_share
from cvtgs.cells.moments import UPPER, Moments
from cvtgs.config import AllocationConfig
from cvtgs.devices import HOST, in_chunks
from cvtgs.math.segments import label_argmin, take_columns

CHUNK = 1 << 14
"""Gaussians per chunk of the cost computation, to bound memory."""

SHARE_PER_ROUND = 0.35
"""Largest number of pairs merged before costs are recomputed, as a share of the cells."""

THICKNESS = 0.01
"""The cost of a pair adds this share of the sum of variances to each, so that the thickness of
flat Gaussians, which images hardly show, counts less than their extent."""

FLOOR = 1e-4
"""Standard deviation, in robust radii, added in quadrature so that flat shapes have a volume."""

COMMON_CONTRAST = 0.2
"""Contrast of neighbours, in units of RGB, for which weights of costs are given."""

LEAST_CONTRAST, LARGEST_CONTRAST = 0.3, 1.4
"""Limits of the contrast in weights, in units of the common one."""

VIEWERS = 3.0
"""Distance from the middle of the scene, in robust radii, from which it is often seen."""

SAMPLE = 1 << 16
"""Number of groups from which on only some of them are used to measure the contrast."""

MOST_ROUNDS = 30
"""Number of vectorised rounds that choose disjoint pairs; captures need 6 to 11."""

ROW_BITS, LAST_ROW = 32, (1 << 32) - 1
"""Keys to sort by have a row number in their lower bits."""

Rows = NDArray[np.int64]
"""Row numbers or keys."""


def merge_pairs(
    groups: Moments, neighbors: Int[Tensor, "m k"], count: int, config: AllocationConfig
) -> Int[Tensor, "m"]:
    """Merge neighbouring groups in pairs, cheapest first, until ``count`` are left.

    The cost of a pair is Runnalls' bound (2007) on the change of the mixture when both become one
    Gaussian, plus the squared colour distance, times a power of the mass as seen in images, times
    the number of Gaussians, which keeps groups balanced. The contrast of neighbouring groups
    scales the power and the weight of colour; far mass lowers the power. Pairs that would be seen
    at a wide angle cost more.

    Args:
        groups: Moments of the groups, on the CPU.
        neighbors: Groups that each group may merge with, on the CPU.
        count: Number of groups to keep, 1 to m.
        config: Weights of the cost.

    Returns:
        The new group of every group, 0 to ``count - 1``.
    """
    contrast = _relative_contrast(groups.colors, neighbors)
    far = float(far_share(torch.linalg.vector_norm(groups.means, dim=0), groups.apparent_masses))
    update = {
        "color": config.color / contrast,
        "mass_power": config.mass_power * contrast * (1.0 - config.far_relief * far),
        "widest": config.widest if far > 0.0 else 0.0,  # a bounded scene has no sky
    }
    config = config.model_copy(update=update)
    table = torch.cat([torch.atleast_2d(values).float() for values in groups])  # fast to gather
    total = len(groups.masses)
    labels = np.arange(total, dtype=np.int64)  # numpy 1 on Windows would take 32 bits
    pairs = _distinct_pairs(labels.repeat(neighbors.shape[1]), neighbors.numpy().ravel())
    while total > count:
        if len(pairs) == 0:  # no neighbouring pairs are left: merge arbitrary ones
            rows = np.arange(total, dtype=np.int64)
            pairs = _distinct_pairs(rows[:-1], rows[1:])
        first, second = pairs >> ROW_BITS, pairs & LAST_ROW
        wanted = min(total - count, max(1, int(SHARE_PER_ROUND * total)))
        costs = _pair_costs(table, torch.from_numpy(first), torch.from_numpy(second), config)
        kept, merged = _cheapest_disjoint(first, second, costs.numpy(), wanted, total)
        is_kept = np.ones(total, dtype=bool)
        is_kept[merged] = False
        target = np.cumsum(is_kept, dtype=np.int64) - 1
        target[merged] = target[kept]
        labels, total = target[labels], total - len(merged)
        if total > count:
            _join_pairs(table, kept, merged)
            table = table.index_select(1, torch.from_numpy(np.flatnonzero(is_kept)))
            del pairs, costs  # frees memory
            pairs = _distinct_pairs(target[first], target[second])
    return torch.from_numpy(labels)


def _relative_contrast(colors: Float[Tensor, "3 m"], neighbors: Int[Tensor, "m k"]) -> float:
    """Return the contrast of neighbours in units of a common one, within limits.

    The contrast is the root of half the mean squared difference of their colours, in a sample.
    """
    values, rows = colors.numpy(), np.arange(0, len(neighbors), 1 + len(neighbors) // SAMPLE)
    near = neighbors.numpy()[rows]
    squares = np.square(values[:, near] - values[:, rows, None]).sum()  # numpy uses one thread
    contrast = math.sqrt(0.5 * float(squares) / max(1, near.size)) / COMMON_CONTRAST
    return min(max(contrast, LEAST_CONTRAST), LARGEST_CONTRAST)


def _distinct_pairs(first: Rows, second: Rows) -> Rows:
    """Return a key of each unordered pair of different groups, ascending.

    The upper bits of a key are the smaller of the two groups, the lower ones the other.
    """
    keys = np.minimum(first, second)
    keys <<= ROW_BITS
    keys |= np.maximum(first, second)
    keys = keys[first != second]
    keys.sort()
    is_new = np.ones(len(keys), dtype=bool)
    np.not_equal(keys[1:], keys[:-1], out=is_new[1:])
    distinct: Rows = keys[is_new]
    return distinct


def _take(table: Float[Tensor, "c n"], groups: Int[Tensor, "k"]) -> Moments:
    """Return the moments of some groups; those of one number per group have two dimensions."""
    return Moments(*table.index_select(1, groups).split([1, 1, 1, 3, 6, 3, len(table) - 15]))


def _pair_costs(
    table: Float[Tensor, "c n"], first: Tensor, second: Tensor, config: AllocationConfig
) -> Float[Tensor, "p"]:
    """Return the cost of merging each pair, at least 0; infinite where float32 overflows."""
    volumes = _log_volume(table[6:12])  # the covariances

    def costs_of(part: slice) -> Tensor:
        i, j = first[part], second[part]
        one, two = _take(table, i), _take(table, j)
        share = one.masses / (one.masses + two.masses)
        own = share * volumes.index_select(0, i) + (1.0 - share) * volumes.index_select(0, j)
        joint = _joint_covariances(one, two, share)
        cost = 0.5 * (_log_volume(joint) - own)
        squares = (one.colors - two.colors).square().sum(0)
        squares += config.view_color * (one.view_colors - two.view_colors).square().sum(0)
        cost += config.color * share * (1.0 - share) * squares
        if config.widest:
            cost *= _fog_factor(joint, torch.lerp(two.means, one.means, share), config.widest)
        cost *= (one.apparent_masses + two.apparent_masses) ** config.mass_power
        cost *= one.counts + two.counts
        return cost[0].nan_to_num_(torch.inf, torch.inf).clamp_min_(0.0)

    return torch.cat(in_chunks(costs_of, len(first), CHUNK, HOST))


def _fog_factor(
    covariances: Float[Tensor, "6 n"], means: Float[Tensor, "3 n"], widest: float
) -> Float[Tensor, "n"]:
    """Return factors that grow where a Gaussian is wide for its distance from viewers.

    A camera sees part of such a Gaussian even if its centre is far outside of the image. There its
    projection is spread over the whole image, and drawn before what lies behind its centre.
    """
    xx, _, _, yy, _, zz = covariances
    width = (xx + yy + zz) / (means.square().sum(0) + VIEWERS**2)
    factors: Tensor = 1.0 + (width / widest**2).square().square()
    return factors


def _joint_covariances(
    one: Moments, two: Moments, share: Float[Tensor, "1 n"]
) -> Float[Tensor, "6 n"]:
    """Return the covariances of pairs, given the share of the first group in the mass."""
    rest, shifts = 1.0 - share, one.means - two.means
    spread = share * rest * shifts
    return torch.cat([
        share * one.covariances[k] + rest * two.covariances[k] + spread[r] * shifts[c]
        for k, (r, c) in enumerate(UPPER)
    ])  # fmt: skip


def _join_pairs(table: Float[Tensor, "c n"], kept: Rows, merged: Rows) -> None:
    """Replace the moments of kept groups by those of them and the merged ones, in place."""
    first, second = torch.from_numpy(kept), torch.from_numpy(merged)

    def join(part: slice) -> None:
        one, two = _take(table, first[part]), _take(table, second[part])
        masses = one.masses + two.masses
        share = one.masses / masses
        both = Moments(
            counts=one.counts + two.counts,
            masses=masses,
            apparent_masses=one.apparent_masses + two.apparent_masses,
            means=torch.lerp(two.means, one.means, share),
            covariances=_joint_covariances(one, two, share),
            colors=torch.lerp(two.colors, one.colors, share),
            view_colors=torch.lerp(two.view_colors, one.view_colors, share),
        )
        table.index_copy_(1, first[part], torch.cat(both))

    in_chunks(join, len(kept), CHUNK, HOST)


def _log_volume(covariances: Float[Tensor, "6 n"]) -> Float[Tensor, "n"]:
    """Return the logarithms of the determinants, with some thickness added."""
    xx, xy, xz, yy, yz, zz = covariances
    added = FLOOR**2 + THICKNESS * (xx + yy + zz)
    xx, yy, zz = xx + added, yy + added, zz + added
    minors = yy * zz - yz * yz, xy * zz - yz * xz, xy * yz - yy * xz
    determinants = xx * minors[0] - xy * minors[1] + xz * minors[2]
    volumes: Tensor = determinants.clamp_min(FLOOR**6).log()
    return volumes


def _cheapest_disjoint(
    first: Rows, second: Rows, costs: NDArray[np.float32], wanted: int, total: int
) -> tuple[Rows, Rows]:
    """Take disjoint pairs, cheapest first, at most ``wanted``; return them in the order of pairs.

    Each round takes every pair that is the cheapest of both its groups. The result is that of a
    greedy pass over all pairs by cost (Preis 1999), in a few vectorised rounds. Along chains of
    ascending costs there would be as many rounds as pairs, so a loop finishes what is left.
    """
    # Bits of positive floats are in the order of the floats, so these keys are in that of costs.
    keys = costs.view(np.int32).astype(np.int64)
    keys <<= ROW_BITS
    keys |= np.arange(len(keys))
    left, is_free = (first, second), np.ones(total, dtype=bool)
    taken: list[Rows] = []
    for _ in range(MOST_ROUNDS):
        least = np.full(total, np.iinfo(np.int64).max)
        for groups in left:
            np.minimum.at(least, groups, keys)
        is_chosen = (least[left[0]] == keys) & (least[left[1]] == keys)
        taken.append(keys[is_chosen])
        for groups in left:
            is_free[groups[is_chosen]] = False
        stays = np.flatnonzero(is_free[left[0]] & is_free[left[1]])
        left, keys = (left[0][stays], left[1][stays]), keys[stays]
        if len(keys) == 0:
            break
    order, free, late = np.argsort(keys), bytearray(is_free), list[int]()
    for key, i, j in zip(*(values[order].tolist() for values in (keys, *left)), strict=True):
        if free[i] and free[j]:
            free[i] = free[j] = 0
            late.append(key)
    found = np.sort(np.concatenate([*taken, np.array(late, dtype=np.int64)]))
    rows = np.sort(found[:wanted] & LAST_ROW)
    return first[rows], second[rows]


def reassign(
    members: Moments,
    labels: Int[Tensor, "n"],
    groups: Moments,
    neighbors: Int[Tensor, "m k"],
    config: AllocationConfig,
    *,
    must_stay: Bool[Tensor, "m"] | None = None,
) -> Int[Tensor, "n"]:
    """Move every member once to the group that explains it best, its own or a neighbouring one.

    The fit is the Kullback-Leibler divergence of the two Gaussians plus the squared distance of
    their colours. The best-fitting member of each group stays, so that no group with members
    becomes empty.

    Args:
        members: Moments of the members.
        labels: Group of each.
        groups: Moments of the groups; groups without members may gain some.
        neighbors: Other groups that the members of each group may move to.
        config: Weight of colour.
        must_stay: Groups that must keep a member; None for all.

    Returns:
        The new group of every member.
    """
    count = len(groups.masses)
    own = torch.arange(count, device=labels.device)
    candidates = torch.cat([own[None], neighbors.T]).contiguous()
    inverse, volumes = _inverse(groups.covariances)
    found = labels.new_empty(len(labels) + 1)  # the last is for groups without members
    own_costs = torch.empty(len(labels), dtype=torch.float64, device=labels.device)
    tables = groups.means, groups.colors, inverse, volumes

    def search(part: slice) -> None:
        cells = labels[part]
        mean, covariance = members.means[:, part], members.covariances[:, part]
        color = members.colors[:, part]
        least, best = None, cells
        for group in take_columns(cells, candidates)[0]:
            center, tint, matrix, cost = take_columns(group, *tables)
            shifts = mean - center
            cost = cost + 2 * config.color * (color - tint).square().sum(0)
            for k, (r, c) in enumerate(UPPER):
                twice = 1.0 if r == c else 2.0
                cost.addcmul_(matrix[k], covariance[k] + shifts[r] * shifts[c], value=twice)
            if least is None:
                least, own_costs[part] = cost, cost
                continue
            closer = cost < least
            least, best = torch.where(closer, cost, least), torch.where(closer, group, best)
        found[part] = best

    in_chunks(search, len(labels), CHUNK, labels.device)
    anchors = label_argmin(own_costs, labels, count)
    if must_stay is not None:
        anchors = torch.where(must_stay, anchors, len(labels))
    found[anchors] = own
    return found[:-1]


def _inverse(covariances: Float[Tensor, "6 n"]) -> tuple[Float[Tensor, "6 n"], Float[Tensor, "n"]]:
    """Return the inverse matrices and the logarithms of the determinants, with the floor added."""
    xx, xy, xz, yy, yz, zz = covariances
    xx, yy, zz = xx + FLOOR**2, yy + FLOOR**2, zz + FLOOR**2
    cofactors = torch.stack([
        yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy,
        xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy,
    ])  # fmt: skip
    determinants = (xx * cofactors[0] + xy * cofactors[1] + xz * cofactors[2]).clamp_min(FLOOR**6)
    return cofactors / determinants, determinants.log()
