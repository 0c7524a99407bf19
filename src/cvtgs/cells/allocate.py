"""Allocation: merge similar cells in pairs, and move Gaussians to the cell that fits them best.

A Voronoi cell reflects where its Gaussians lie, not the error of replacing them by one. So the
tessellation makes more cells than are wanted, and the cheapest pairs merge.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cvtgs.analysis.effects import far_share
from cvtgs.cells.moments import UPPER, Moments, join_pairs, joint_covariances, take_moments
from cvtgs.checks import checked
from cvtgs.config import AllocationConfig
from cvtgs.counts import checked_whole
from cvtgs.devices import in_chunks
from cvtgs.math.segments import label_argmin, take_columns

CHUNK = 1 << 15  # Gaussians per chunk of the cost computation, to bound memory

SHARE_PER_ROUND = 0.35  # of the cells: most pairs merged before costs are recomputed

THICKNESS = 0.01
"""The cost of a pair adds this share of the sum of variances to each, so that the thickness of
flat Gaussians, which images hardly show, counts less than their extent."""

FLOOR = 1e-4  # standard deviation, in robust radii, that gives flat shapes a volume
COMMON_CONTRAST = 0.2  # of neighbours, in units of RGB, for which weights of costs are given
LEAST_CONTRAST, LARGEST_CONTRAST = 0.3, 1.4  # limits in weights, in units of the common one
MOSTLY_FAR = 0.3  # share of far mass from which on the limit of heavy pairs applies in full
VIEWERS = 3.0  # distance from the middle of the scene, in robust radii, from which it is often seen

LEAST_VISIBLE, MOST_VISIBLE = 1.5, 2.5
"""Far mass this many times as visible as near mass begins to count more; counts most."""

SAMPLE = 1 << 16  # number of groups from which on only some of them show the contrast
MOST_ROUNDS = 30  # number of vectorised rounds that choose disjoint pairs; captures need 6 to 11
ROW_BITS, LAST_ROW = 32, (1 << 32) - 1  # keys to sort by have a row number in their lower bits


@checked
def merge_pairs(
    groups: Moments,
    neighbors: Int[Tensor, "m k"],
    count: int,
    config: AllocationConfig,
    *,
    area: float | None = None,
) -> Int[Tensor, "m"]:
    """Merge neighbouring groups in pairs, cheapest first, until ``count`` are left.

    The cost of a pair is Runnalls' bound (2007) on the change of the mixture when both become one
    Gaussian, plus the squared colour distance, times a power of the mass as seen in images, times
    the number of Gaussians, which keeps groups balanced. The contrast of neighbouring groups
    scales the power and the weight of colour; far mass lowers the power. Pairs that would be seen
    at a wide angle cost more, and so do heavy ones where much mass is far, and far ones where less
    of the far mass is hidden than of the near mass. Where no neighbours are left to merge, groups
    of adjacent rows do.

    Args:
        groups: Moments of the groups.
        neighbors: Groups that each group may merge with.
        count: Number of groups to keep, 1 to m.
        config: Weights of the cost.
        area: Apparent mass of all groups, squared robust radii; None if it is not known, and far
            mass is taken to be as hidden as near mass.

    Returns:
        The new group of every group, 0 to ``count - 1``.

    Raises:
        InvalidArgumentError: ``count`` is outside 1 to m, or types do not fit.

    Example:
        >>> ones, x = torch.ones(3), torch.tensor([[0.0, 0.1, 5.0], [0.0] * 3, [0.0] * 3])
        >>> groups = Moments(
        ...     ones, ones, ones, x, torch.full((6, 3), 1e-4), torch.zeros(3, 3), torch.zeros(0, 3)
        ... )
        >>> others = torch.tensor([[1, 2], [0, 2], [0, 1]])
        >>> merge_pairs(groups, others, 2, AllocationConfig()).tolist()
        [0, 0, 1]
    """
    count = checked_whole(count, "count", most=len(groups.masses), things="groups")
    contrast = _relative_contrast(groups.colors, neighbors)
    masses, distances = groups.apparent_masses, torch.linalg.vector_norm(groups.means, dim=0)
    far, mass = torch.stack([far_share(distances, masses), masses.double().sum()]).tolist()
    gain = _far_gain(far, area, config)
    if gain > 1.0:
        outer = (2.0 * (distances - VIEWERS) + 1.0).clamp(0.0, 1.0)
        groups = groups._replace(apparent_masses=masses * gain**outer)
        mass *= 1.0 - far + far * gain
    update = {
        "color": config.color / contrast,
        "mass_power": config.mass_power * contrast * (1.0 - config.far_relief * far),
        "widest": config.widest if far > 0.0 else 0.0,  # a bounded scene has no sky
    }
    config = config.model_copy(update=update)
    heavy = config.heaviest * mass / count, min(1.0, far / MOSTLY_FAR)
    table = torch.cat([torch.atleast_2d(values).float() for values in groups])  # fast to gather
    total, device = len(groups.masses), groups.masses.device
    labels = torch.arange(total, device=device)
    pairs = _distinct_pairs(labels[:, None].expand_as(neighbors), neighbors)
    while total > count:
        if len(pairs) == 0:  # no neighbouring pairs are left: merge arbitrary ones
            rows = torch.arange(total, device=device)
            pairs = _distinct_pairs(rows[:-1], rows[1:])
        first, second = pairs >> ROW_BITS, pairs & LAST_ROW
        wanted = min(total - count, max(1, int(SHARE_PER_ROUND * total)))
        costs = _pair_costs(table, first, second, config, heavy)
        kept, merged = _cheapest_disjoint(first, second, costs, wanted, total)
        is_kept = torch.ones(total, dtype=torch.bool, device=device)
        is_kept[merged] = False
        target = is_kept.cumsum(0) - 1
        target[merged] = target[kept]
        labels, total = target.index_select(0, labels), total - len(merged)
        if total > count:
            join_pairs(table, kept, merged)
            table = table.index_select(1, is_kept.nonzero()[:, 0])
            del pairs, costs  # frees memory
            pairs = _distinct_pairs(target.index_select(0, first), target.index_select(0, second))
    return labels


def _far_gain(share: float, area: float | None, config: AllocationConfig) -> float:
    """Return the factor on far masses: above 1 if less of them is hidden than of near masses."""
    if share == 0.0 or area is None:
        return 1.0
    visible = far_visibility(share, area) - LEAST_VISIBLE
    strength = min(1.0, max(0.0, visible / (MOST_VISIBLE - LEAST_VISIBLE)))
    return float(config.far_gain**strength)


def far_visibility(share: float, area: float) -> float:
    """Return how much of the far mass is visible, relative to how much of the near mass is.

    ``share`` is that of far mass, ``area`` is all mass, squared robust radii.
    """
    area = min(area, 1e30)
    # Far mass lies around the scene, near mass on a disc of one robust radius.
    layers = area * share / (4.0 * math.pi), area * (1.0 - share) / math.pi
    far, near = (-math.expm1(-x) / x if x > 0.0 else 1.0 for x in layers)  # mass hides mass
    return far / near


def _relative_contrast(colors: Float[Tensor, "3 m"], neighbors: Int[Tensor, "m k"]) -> float:
    """Return the contrast of the colours of neighbours in units of a common one, within limits."""
    rows = torch.arange(0, len(neighbors), 1 + len(neighbors) // SAMPLE, device=colors.device)
    near = neighbors.index_select(0, rows)
    steps = (colors[:, near] - colors.index_select(1, rows)[:, :, None]).cpu().numpy()
    squares = np.square(steps).sum()  # in one order on any device; numpy uses one thread
    contrast = math.sqrt(0.5 * float(squares) / max(1, near.numel())) / COMMON_CONTRAST
    return min(max(contrast, LEAST_CONTRAST), LARGEST_CONTRAST)


def _distinct_pairs(first: Tensor, second: Tensor) -> Int[Tensor, "q"]:
    """Return keys of pairs of different groups, ascending: the smaller group in upper bits."""

    def keys_of(part: slice) -> Tensor:
        one, two = first[part], second[part]
        keys = (torch.minimum(one, two) << ROW_BITS).bitwise_or_(torch.maximum(one, two))
        return torch.masked_select(keys, one != two)

    keys = torch.cat(in_chunks(keys_of, len(first), CHUNK, first.device))
    if keys.device.type == "cpu":
        keys.numpy().sort(kind="stable")  # in place, and fast, since long runs are in order
    else:
        keys = torch.sort(keys).values
    is_new = torch.ones(len(keys), dtype=torch.bool, device=keys.device)
    torch.ne(keys[1:], keys[:-1], out=is_new[1:])
    return keys.index_select(0, is_new.nonzero()[:, 0])


def _pair_costs(
    table: Float[Tensor, "c n"],
    first: Tensor,
    second: Tensor,
    config: AllocationConfig,
    heavy: tuple[float, float],
) -> Float[Tensor, "p"]:
    """Return the cost of merging each pair, at least 0; infinite where float32 overflows.

    ``heavy`` is the mass of a heavy pair, 0 for none, and the power by which its cost grows.
    """
    heavy_mass, power = heavy
    volumes = _log_volume(table[6:12])  # the covariances

    def costs_of(part: slice) -> Tensor:
        i, j = first[part], second[part]
        one, two = take_moments(table, i), take_moments(table, j)
        share = one.masses / (one.masses + two.masses)
        own = share * volumes.index_select(0, i) + (1.0 - share) * volumes.index_select(0, j)
        joint = joint_covariances(one, two, share)
        cost = 0.5 * (_log_volume(joint) - own)
        squares = (one.colors - two.colors).square().sum(0)
        squares += config.view_color * (one.view_colors - two.view_colors).square().sum(0)
        cost += config.color * share * (1.0 - share) * squares
        if config.widest:
            cost *= _fog_factor(joint, torch.lerp(two.means, one.means, share), config.widest)
        mass = one.apparent_masses + two.apparent_masses
        cost *= mass**config.mass_power
        if heavy_mass > 0.0 and power > 0.0:
            cost *= (1.0 + mass / heavy_mass) ** power
        cost *= one.counts + two.counts
        return cost[0].nan_to_num_(torch.inf, torch.inf).clamp_min_(0.0)

    return torch.cat(in_chunks(costs_of, len(first), CHUNK, table.device))


def _fog_factor(
    covariances: Float[Tensor, "6 n"], means: Float[Tensor, "3 n"], widest: float
) -> Float[Tensor, "n"]:
    """Return factors that grow where a Gaussian is wide for its distance from viewers."""
    # Cameras see such Gaussians spread over the image, even if the centre is far outside of it.
    xx, _, _, yy, _, zz = covariances
    width = (xx + yy + zz) / (means.square().sum(0) + VIEWERS**2)
    factors: Tensor = 1.0 + (width / widest**2).square().square()
    return factors


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
    first: Int[Tensor, "p"],
    second: Int[Tensor, "p"],
    costs: Float[Tensor, "p"],
    wanted: int,
    total: int,
) -> tuple[Int[Tensor, "k"], Int[Tensor, "k"]]:
    """Take disjoint pairs, cheapest first, at most ``wanted``; return them in the order of pairs.

    A greedy pass over all pairs by cost (Preis 1999), in a few vectorised rounds.
    """
    # Bits of positive floats are in the order of the floats, so these keys are in that of costs.
    keys = costs.view(torch.int32).long()
    keys <<= ROW_BITS
    keys |= torch.arange(len(keys), device=keys.device)
    i, j, is_free = first, second, torch.ones(total, dtype=torch.bool, device=keys.device)
    taken, count = list[Tensor](), 0
    for _ in range(MOST_ROUNDS):
        least = torch.full((total,), torch.iinfo(torch.int64).max, device=keys.device)
        least.scatter_reduce_(0, i, keys, "amin").scatter_reduce_(0, j, keys, "amin")
        # Every pair that is the cheapest of both its groups is taken.
        is_cheapest = (least.index_select(0, i) == keys) & (least.index_select(0, j) == keys)
        chosen = is_cheapest.nonzero()[:, 0]
        taken.append(keys.index_select(0, chosen))
        is_free.index_fill_(0, i.index_select(0, chosen), False)
        is_free.index_fill_(0, j.index_select(0, chosen), False)
        is_left = is_free.index_select(0, i) & is_free.index_select(0, j)
        if count < wanted <= count + len(chosen):  # costlier pairs do not matter
            is_left &= keys < torch.sort(torch.cat(taken)).values[wanted - 1]
        count += len(chosen)
        left = is_left.nonzero()[:, 0]
        i, j, keys = i.index_select(0, left), j.index_select(0, left), keys.index_select(0, left)
        if len(keys) == 0:
            break
    # Along chains of ascending costs, there would be as many rounds as pairs.
    taken.append(_greedy_pass(i, j, keys, is_free))
    found = torch.sort(torch.cat(taken)).values
    rows = torch.sort(found[:wanted] & LAST_ROW).values
    return first.index_select(0, rows), second.index_select(0, rows)


def _greedy_pass(
    first: Int[Tensor, "p"], second: Int[Tensor, "p"], keys: Int[Tensor, "p"], is_free: Tensor
) -> Int[Tensor, "k"]:
    """Take disjoint pairs of free groups in the order of their keys, one by one."""
    if len(keys) == 0:
        return keys
    ascending, order = torch.sort(keys)
    columns = torch.stack([ascending, first[order], second[order]]).tolist()
    free, taken = bytearray(is_free.cpu().numpy()), list[int]()
    for key, i, j in zip(*columns, strict=True):
        if free[i] and free[j]:
            free[i] = free[j] = 0
            taken.append(key)
    return torch.tensor(taken, dtype=torch.int64, device=keys.device)


@checked
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

    Example:
        >>> from cvtgs.cells.moments import group_moments
        >>> ones, x = torch.ones(5), torch.tensor([[0.0, 0.1, 0.2, 5.0, 5.1], [0.0] * 5, [0.0] * 5])
        >>> shapes = 0.01 * torch.tensor([1.0, 0, 0, 1, 0, 1])[:, None].expand(6, 5)
        >>> members = Moments(ones, ones, ones, x, shapes, torch.zeros(3, 5), torch.zeros(0, 5))
        >>> labels = torch.tensor([0, 0, 1, 1, 1])
        >>> groups, others = group_moments(members, labels, 2), torch.tensor([[1], [0]])
        >>> reassign(members, labels, groups, others, AllocationConfig()).tolist()
        [0, 0, 0, 1, 1]
    """
    count = len(groups.masses)
    own = torch.arange(count, device=labels.device)
    candidates = torch.cat([own[None], neighbors.T]).contiguous()
    inverse, volumes = _inverse(groups.covariances)
    found = labels.new_empty(len(labels) + 1)  # the last is for groups without members
    own_costs = torch.empty(len(labels), dtype=torch.float64, device=labels.device)
    table = torch.cat([groups.means, groups.colors, volumes[None], inverse])

    def search(part: slice) -> None:
        cells = labels[part]
        mean, covariance = members.means[:, part], members.covariances[:, part]
        color = members.colors[:, part]
        least, best = None, cells
        for group in take_columns(cells, candidates):
            center, tint, (cost,), matrix = take_columns(group, table).split([3, 3, 1, 6])
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
