"""One tessellation over all blocks: seeds by block, then Lloyd and labels across every border."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from cvtgs.analysis import SceneAnalysis
from cvtgs.cvt import (
    centroids,
    choose_search,
    choose_seeds,
    fill_empty_cells,
    gaussian_weights,
    sample_points,
    weighted_sums,
)
from cvtgs.devices import one_thread
from cvtgs.io import atomic_output
from cvtgs.io.tensors import map_tensors, save_tensors
from cvtgs.outofcore.borders import Across, Nearest, bounds_of, nearest_anywhere
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.rows import CELL, cut_pieces, read_rows, record_type
from cvtgs.pipeline import curve_order, embed_rows


@one_thread()
def place(job: Job, block: int) -> None:
    """Choose the first sites of a block, and the Gaussians that Lloyd looks at.

    A block that is too light to keep anything gets neither; its Gaussians go to other blocks.
    """
    if job.sites_path(0, block).exists():
        return
    order, points, weights = _points(job, block)
    choices, target = job.config.cvt, job.read_survey()[1][block]
    if target == 0:
        save_tensors(job.sample_path(block), {"order": order}, {})
        return
    seeds = choose_seeds(weights, target, config=choices, seed=job.config.seed)
    sample, shares = sample_points(points, weights, choices.samples_per_site * target)
    save_tensors(job.sample_path(block), {"order": order, "points": sample, "weights": shares}, {})
    _save_sites(job, 0, block, points[seeds].double())


@one_thread()
def settle(job: Job, turn: int, block: int) -> float:
    """Add up the Gaussians of a block by their nearest site, whichever block has it."""
    if job.read_survey()[1][block] == 0:
        return 0.0
    path = job.sums_path(turn, block)
    if path.exists():
        return float(map_tensors(path)[0]["energy"])
    tensors, _ = map_tensors(job.sample_path(block))
    points, weights = tensors["points"], tensors["weights"]
    count, found = _search(job, turn, block, points)
    labels, strangers = _numbered(found, count)
    totals, sums = weighted_sums(points, weights, labels, count + len(strangers))
    energy = (weights * found.squared).sum()
    result = {"totals": totals, "sums": sums, "strangers": strangers, "energy": energy}
    save_tensors(path, result, {})
    return float(energy)


def move(job: Job, turn: int) -> None:
    """Move the sites of all blocks; memory is what lies at borders, and one block."""
    left = [block for block in job.busy() if not job.sites_path(turn + 1, block).exists()]
    border: dict[str, list[Tensor]] = {name: [] for name in ("strangers", "totals", "sums")}
    if not left:
        return
    for block in job.busy():
        tensors, _ = map_tensors(job.sums_path(turn, block))
        for name, values in border.items():
            values.append(tensors[name][len(tensors[name]) - len(tensors["strangers"]) :])
    strangers, totals, sums = (torch.cat(parts) for parts in border.values())
    for block in left:
        tensors, _ = map_tensors(job.sums_path(turn, block))
        sites = map_tensors(job.sites_path(turn, block))[0]["sites"]
        here = (strangers[:, 0] == block).nonzero()[:, 0]
        numbers = strangers[here, 1]
        total = tensors["totals"][: len(sites)].index_add(0, numbers, totals[here])
        summed = tensors["sums"][: len(sites)].index_add(0, numbers, sums[here])
        _save_sites(job, turn + 1, block, centroids(total, summed, sites))


@one_thread()
def assign(job: Job, turn: int, block: int) -> None:
    """Return every Gaussian of a block to its nearest site, and send away those of other blocks.

    Every own site keeps at least one Gaussian of the block, so no cell is empty.
    """
    if job.labels_path(block).exists():
        return
    order = map_tensors(job.sample_path(block))[0]["order"]
    order, points, weights = _points(job, block, order)
    count, found = _search(job, turn, block, points)
    found, refilled = _without_empty(found, count, weights)
    energy = (weights * found.squared).sum()
    rows = order.long()
    owners, labels = torch.empty_like(rows), torch.empty_like(rows)
    owners[rows], labels[rows] = found.blocks, found.labels
    sent = _send(job, block, owners, labels)
    labels = torch.where(owners < 0, labels, -1).int()
    result = {"labels": labels, "sent": sent, "energy": energy, "refilled": torch.tensor(refilled)}
    save_tensors(job.labels_path(block), result, {})


def _points(job: Job, block: int, order: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Gaussians of a block along a curve: rows, places in the tessellation, weights."""
    survey, targets = job.read_survey()
    scene, seen, light = read_rows(job, block, is_slim=True)
    known = SceneAnalysis(
        frame=survey.frame,
        farthest=0.0,
        opacities=scene.opacities,
        areas=seen,
        apparent_areas=seen,
        visibility=light,
        plan=survey.plan,
    )
    if order is None:
        everything = torch.arange(len(scene))
        masses = seen * scene.opacities
        order = curve_order(scene, everything, survey.frame, masses=masses).int()
    rows = order.long()
    points = embed_rows(scene, rows, known, sum(targets), job.config)
    weights = gaussian_weights(scene.opacities[rows], seen[rows], survey.power)
    return order, points, (weights / survey.unit).clamp_min(job.config.cvt.weight_floor)


def _search(job: Job, turn: int, block: int, points: Tensor) -> tuple[int, Nearest]:
    """Return the number of sites of a block, and the nearest site of every point."""
    survey, targets = job.read_survey()
    _, nearest = choose_search(
        job.config.cvt, points.device, has_duplicates=survey.plan.duplicates.active
    )
    sites = points[:0].double()
    if targets[block]:
        sites = map_tensors(job.sites_path(turn, block))[0]["sites"]
    others = neighbors_of(job, block, lambda other: job.sites_path(turn, other), name="sites")
    return len(sites), nearest_anywhere(points, sites, others, nearest=nearest)


def neighbors_of(
    job: Job, block: int, path: Callable[[int], Path], *, name: str
) -> Iterator[Across]:
    """Return all other blocks."""
    for other in job.busy():
        if other != block:
            tensors, _ = map_tensors(path(other))
            yield Across(other, tensors["bounds"], partial(tensors.__getitem__, name))


def _save_sites(job: Job, turn: int, block: int, sites: Tensor) -> None:
    tensors = {"sites": sites, "bounds": bounds_of(sites)}
    save_tensors(job.sites_path(turn, block), tensors, {})


def _numbered(found: Nearest, count: int) -> tuple[Tensor, Tensor]:
    """Number the sites of other blocks behind the own ones; give block and number of each."""
    away = (found.blocks >= 0).nonzero()[:, 0]
    pairs = torch.stack([found.blocks[away], found.labels[away]], dim=1)
    strangers, numbers = torch.unique(pairs, dim=0, return_inverse=True)
    labels = found.labels.clone()
    labels[away] = count + numbers
    return labels, strangers


def _without_empty(found: Nearest, count: int, weights: Tensor) -> tuple[Nearest, int]:
    """Let every own site keep a Gaussian of its block; tell how many had none."""
    if count == len(weights):  # then seeds were all Gaussians, in their order
        own = torch.arange(count)
        return Nearest(torch.full_like(own, -1), own, torch.zeros_like(found.squared)), 0
    away = found.blocks >= 0
    labels = torch.where(away, count, found.labels)
    total = count + int(away.any())
    labels, squared, refilled = fill_empty_cells(labels, weights, found.squared, total)
    stays = labels < count
    blocks = torch.where(stays, -1, found.blocks)
    return Nearest(blocks, torch.where(stays, labels, found.labels), squared), refilled


def _send(job: Job, block: int, owners: Tensor, labels: Tensor) -> Tensor:
    """Write the rows that go to other blocks; give how many go to each."""
    kind, parts, start = record_type(job, with_cell=True), [], 0
    for rows in cut_pieces(job, block):
        here = slice(start, start + len(rows))
        leaves = (owners[here] >= 0).numpy()
        table = np.empty(int(leaves.sum()), kind)
        for name in rows.dtype.names or ():
            table[name] = rows[name][leaves]
        table[CELL] = labels[here].numpy()[leaves]
        parts.append(table)
        start += len(rows)
    away = owners[owners >= 0]
    with atomic_output(job.sent_path(block), overwrite=True) as file:
        file.write(np.concatenate(parts)[torch.sort(away, stable=True).indices.numpy()].tobytes())
    return torch.bincount(away, minlength=job.blocks)
