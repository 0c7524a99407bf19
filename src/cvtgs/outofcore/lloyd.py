"""One tessellation of all blocks: seeds per block, then Lloyd iterations across blocks."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.cvt import choose_seeds, gaussian_weights, nearest_site
from cvtgs.cvt.nearest import search_once_per_position
from cvtgs.cvt.tessellate import centroids, sample_points, weighted_sums
from cvtgs.devices import one_thread
from cvtgs.grouping import curve_order, embed_rows
from cvtgs.math.segments import label_argmin, sort_by_label
from cvtgs.outofcore.allocate import cell_parts
from cvtgs.outofcore.halo import (
    Assignment,
    assign_points,
    bounding_box,
    number_remote,
    other_blocks,
)
from cvtgs.outofcore.images import read_apparent_rows
from cvtgs.outofcore.job import Job


class RemoteSums(NamedTuple):
    """Number of each site with points of another block, that block, and weight and sum of these."""

    numbers: Int[Tensor, "r"]
    blocks: Int[Tensor, "r"]
    totals: Float[Tensor, "r"]
    sums: Float[Tensor, "r d"]


@one_thread()
def seed(job: Job, block: int) -> None:
    """Choose the first sites of a block, if it has cells, and the points that Lloyd samples."""
    if job.has("sites", block, 0) and job.has("sample", block):
        return
    order, points, weights = _embedded_rows(job, block)
    config, count = job.config.cvt, job.cells[block]
    if count == 0:
        job.write("sample", block, {"order": order})
        return
    seeds = choose_seeds(weights, count, config=config, seed=job.config.seed)
    sample, shares = sample_points(points, weights, config.samples_per_site * count)
    job.write("sample", block, {"order": order, "points": sample, "weights": shares})
    _save_sites(job, 0, block, points[seeds].double())


@one_thread()
def accumulate(job: Job, iteration: int, block: int) -> float:
    """Sum the points of a block per nearest site, own or remote; return their energy."""
    if job.cells[block] == 0:
        return 0.0
    if job.has("sums", block, iteration):
        return float(job.read("sums", block, iteration)["energy"])
    tensors = job.read("sample", block)
    points, weights = tensors["points"], tensors["weights"]
    sites, found = _assign(job, iteration, block, points)
    count = len(sites)
    labels, remote = number_remote(found.blocks, found.labels, count)
    totals, sums = weighted_sums(points, weights, labels, count + len(remote))
    energy = (weights * found.squared).sum()
    own = {"totals": totals[:count], "sums": sums[:count]}
    others = {"remote": remote, "remote_totals": totals[count:], "remote_sums": sums[count:]}
    facts = {"energy": energy, "spare": torch.tensor(len(points) - count - 1)}
    job.write("sums", block, own | others | facts, iteration)
    return float(energy)


def move_sites(job: Job, iteration: int) -> None:
    """Move the sites of all blocks to their centroids; memory: one block and all remote sums."""
    blocks = job.blocks_with_sites()
    left = [block for block in blocks if not job.has("sites", block, iteration + 1)]
    if not left:
        return
    remote = _remote_sums(job, iteration)
    leaving, arriving = _change_blocks(job, iteration, remote)
    for block in left:
        sites = _centroids(job, iteration, block, remote[block])
        stays = torch.ones(len(sites), dtype=torch.bool)
        stays[leaving[block]] = False
        _save_sites(job, iteration + 1, block, torch.cat([sites[stays], *arriving[block]]))


def _remote_sums(job: Job, iteration: int) -> dict[int, RemoteSums]:
    """Read the sums over the points of other blocks, for the sites of each block."""
    blocks, parts = job.blocks_with_sites(), list[tuple[Tensor, ...]]()
    for block in blocks:
        tensors = job.read("sums", block, iteration)
        owners, numbers = tensors["remote"].unbind(1)
        values = (tensors["remote_totals"], tensors["remote_sums"])
        parts.append((owners, numbers, torch.full_like(owners, block), *values))
    owners, *columns = (torch.cat(values) for values in zip(*parts, strict=True))
    order, offsets = sort_by_label(owners, job.blocks)
    rows = {block: order[offsets[block] : offsets[block + 1]] for block in blocks}
    return {block: RemoteSums(*(values[rows[block]] for values in columns)) for block in blocks}


def _centroids(job: Job, iteration: int, block: int, remote: RemoteSums) -> Tensor:
    tensors = job.read("sums", block, iteration)
    sites = job.read("sites", block, iteration)["sites"]
    totals = tensors["totals"].index_add(0, remote.numbers, remote.totals)
    sums = tensors["sums"].index_add(0, remote.numbers, remote.sums)
    return centroids(totals, sums, sites)


def _change_blocks(
    job: Job, iteration: int, remote: Mapping[int, RemoteSums]
) -> tuple[dict[int, list[int]], dict[int, list[Tensor]]]:
    """Choose the sites that change blocks: numbers that leave, and centroids that arrive.

    A site without points of its block goes to the one with most of its weight, where
    :func:`assign` need not add a far one. Blocks keep a site, and get fewer than they have points.
    """
    leaving: dict[int, list[int]] = {block: [] for block in remote}
    arriving: dict[int, list[Tensor]] = {block: [] for block in remote}
    spare = {block: int(job.read("sums", block, iteration)["spare"]) for block in remote}
    for block, sums in remote.items():
        own = job.read("sums", block, iteration)["totals"]
        heaviest = label_argmin(-sums.totals, sums.numbers, len(own))
        lonely = ((own == 0) & (heaviest < len(sums.totals))).nonzero()[: len(own) - 1, 0]
        if len(lonely) == 0:
            continue
        sites = _centroids(job, iteration, block, sums)
        others = sums.blocks[heaviest[lonely]]
        for number, other in zip(lonely.tolist(), others.tolist(), strict=True):
            if spare[other] > 0:
                spare[other] -= 1
                leaving[block].append(number)
                arriving[other].append(sites[[number]])
    return leaving, arriving


@one_thread()
def assign(job: Job, iterations: int, block: int) -> None:
    """Write the cell of every Gaussian of a block, and the moments of its part of each cell."""
    if job.has("parts", block):
        return
    order = job.read("sample", block)["order"]
    order, points, weights = _embedded_rows(job, block, order)
    sites, found = _assign(job, iterations, block, points)
    found, refilled = _fill_empty(found, points, sites, weights)
    energy = (weights * found.squared).sum()
    rows = order.long()
    owners, labels = torch.empty_like(rows), torch.empty_like(rows)
    owners[rows], labels[rows] = found.blocks, found.labels
    del order, points, weights, found, rows
    is_slim = job.read_scan().view_components.shape[1] == 0
    members = read_apparent_rows(job, block, is_slim=is_slim)
    parts = cell_parts(job, members, owners, labels, len(sites))
    facts = {"energy": energy, "refilled": torch.tensor(refilled)}
    job.write("parts", block, parts | facts)


def _embedded_rows(
    job: Job, block: int, order: Tensor | None = None
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n d"], Float[Tensor, "n"]]:
    """Return rows of a block along a Morton curve or in a given order, embedded, and weights."""
    scan = job.read_scan()
    scene, areas, _ = read_apparent_rows(job, block)
    opacities = scene.opacities
    if order is None:
        everything = torch.arange(len(scene))
        order = curve_order(scene, everything, scan.frame, masses=areas * opacities).int()
    rows, total = order.long(), job.read_manifest().total
    points = embed_rows(scene, rows, total, job.config, frame=scan.frame, plan=scan.plan)
    config = job.config.cvt
    weights = gaussian_weights(opacities[rows], areas[rows], area_power=config.area_power)
    weights = (weights / scan.mean_weight).clamp_min(config.weight_floor)
    return order, points, weights


def _assign(job: Job, iteration: int, block: int, points: Tensor) -> tuple[Tensor, Assignment]:
    """Return the own sites, and the nearest site of any block for every point."""
    has_duplicates = job.read_scan().plan.duplicates.active
    nearest = search_once_per_position if has_duplicates else nearest_site
    sites = points[:0].double()
    if job.cells[block]:
        sites = job.read("sites", block, iteration)["sites"]
    numbers = [other for other in job.blocks_with_sites() if other != block]
    others = other_blocks(job, "sites", "sites", numbers, iteration)
    return sites, assign_points(points, sites, others, nearest=nearest)


def _fill_empty(
    found: Assignment, points: Tensor, sites: Tensor, weights: Tensor
) -> tuple[Assignment, int]:
    """Assign the nearest spare point of the block to own sites without one; return their number.

    They may have points of other blocks, so a far point, such as the costliest, makes a huge cell.
    """
    count = len(sites)
    if count == len(points):  # then all points are seeds, in the same order
        own = torch.arange(count)
        return Assignment(torch.full_like(own, -1), own, torch.zeros_like(found.squared)), 0
    owned = torch.where(found.blocks < 0, found.labels, count)
    stays = label_argmin(weights * found.squared, owned, count + 1)[:count]
    empty = left = (stays == len(points)).nonzero()[:, 0]
    blocks, labels, squared = found.blocks.clone(), found.labels.clone(), found.squared.clone()
    movable = torch.ones(len(points), dtype=torch.bool)
    movable[stays[stays < len(points)]] = False
    while len(left):
        rows = movable.nonzero()[:, 0]
        near, distances = nearest_site(sites[left], points[rows])
        several, numbers = torch.unique(near, return_inverse=True)
        closest = label_argmin(distances, numbers, len(several))  # a point for one site only
        moved = rows[several]
        blocks[moved], labels[moved], squared[moved] = -1, left[closest], distances[closest]
        movable[moved] = False
        remains = torch.ones(len(left), dtype=torch.bool)
        remains[closest] = False
        left = left[remains]
    return Assignment(blocks, labels, squared), len(empty)


def _save_sites(job: Job, iteration: int, block: int, sites: Tensor) -> None:
    job.write("sites", block, {"sites": sites, "bounds": bounding_box(sites)}, iteration)
