"""Cells become Gaussians, block by block, each seeing its neighbours across every border."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cvtgs import cells, cvt, validity
from cvtgs.analysis import drop_unused_bands, restore_columns, select_columns
from cvtgs.devices import one_thread
from cvtgs.io import atomic_output, save
from cvtgs.io.tensors import add_prefix, map_tensors, save_tensors, under_prefix
from cvtgs.mergenet import correct_cells
from cvtgs.outofcore.borders import bounds_of, halo
from cvtgs.outofcore.job import Job
from cvtgs.outofcore.rows import read_members
from cvtgs.outofcore.sites import neighbors_of
from cvtgs.pipeline import merge_members, neighbor_count, shape_merged
from cvtgs.scene import GaussianScene

EXTRA = "extra/"
"""Columns beyond the standard ones are stored under this."""


class Around(NamedTuple):
    """The cells of a block, and those of other blocks that its own may see.

    Attributes:
        scene: One Gaussian per cell, the own ones first; no extra columns.
        sizes: ``(m + h,)`` members of each.
        own: Number of own cells, m.
    """

    scene: GaussianScene
    sizes: Tensor
    own: int


class Block(NamedTuple):
    """The Gaussians in the cells of a block.

    Attributes:
        original: All that is known of them.
        scene: What is computed with.
        light: ``(n,)`` how freely each can be seen, 0 to 1.
        partition: Rows that make up every cell.
    """

    original: GaussianScene
    scene: GaussianScene
    light: Tensor
    partition: cells.Partition


@one_thread()
def merge(job: Job, block: int) -> None:
    """Merge the cells of a block."""
    if job.merged_path(block).exists():
        return
    _, scene, _, partition = read_cells(job, block)
    merged, shown = merge_members(scene, partition, job.config.merge, areas=scene.areas)
    first = shown.order[shown.offsets[:-1]]
    own = {
        "sizes": shown.counts,
        "lone": torch.where(shown.counts < partition.counts, first, -1),
        "bounds": bounds_of(merged.means),
    }
    tensors = merged.tensors() | add_prefix(EXTRA, merged.extras) | own
    save_tensors(job.merged_path(block), tensors, {})


@one_thread()
def widen(job: Job, block: int) -> None:
    """Find the neighbours of the cells of a block, and widen what must cover its cell."""
    path = job.wide_path(block)
    if path.exists():
        return
    own, _ = map_tensors(job.merged_path(block))
    near = neighbor_count(job.config.merge, with_network=job.has_network)
    backend, _ = cvt.nearest_backend(job.config.cvt.backend, own["means"].device)
    others = neighbors_of(job, block, job.merged_path, name="means")
    strangers = halo(own["means"], others, count=near, backend=backend)
    around = _around(job, block, strangers, job.merged_path)
    neighbors = cvt.nearest_neighbors(around.scene.means, near, backend=backend)[: around.own]
    # It is asked how many members there are, not which.
    offsets = torch.nn.functional.pad(own["sizes"].cumsum(0), (1, 0))
    shown = cells.Partition(order=own["sizes"][:0], offsets=offsets)
    wide = shape_merged(around.scene, shown, neighbors, job.config.merge)
    shapes = {"quats": wide.quats, "log_scales": wide.log_scales}
    tensors = own | {name: values[: around.own] for name, values in shapes.items()}
    save_tensors(path, tensors | {"neighbors": neighbors, "strangers": strangers}, {})


@one_thread()
def finish(job: Job, block: int) -> None:
    """Let the network correct the cells of a block, and write it, unless that was done before."""
    if job.small_path(block).exists():
        return
    survey, _ = job.read_survey()
    original, scene, light, partition = read_cells(job, block)
    own, _ = map_tensors(job.wide_path(block))
    shown = partition.keep_only(own["lone"])
    around = _around(job, block, own["strangers"], job.wide_path)
    small, checkpoint = around.scene, job.network
    if checkpoint is not None:
        small = correct_cells(
            checkpoint.net.to(scene.dtype),
            scene,
            small,
            shown,
            neighbors=own["neighbors"],
            visibility=light,
            sizes=around.sizes,
        )
    tensors = {name: values[: around.own] for name, values in small.tensors().items()}
    small = scene.with_tensors(tensors, under_prefix(EXTRA, own))
    small = restore_columns(validity.standardized(small), original, survey.plan)
    labels, _ = map_tensors(job.labels_path(block))
    facts = {
        "single_member_cells": int((shown.counts == 1).sum()),
        "largest_cell": int(partition.counts.amax()),
        "refilled_cells": int(labels["refilled"]),
        "energy": float(labels["energy"]),
        "backend": cvt.nearest_backend(job.config.cvt.backend, light.device)[0],
        "mass_out": float(small.masses.sum()),
    }
    save_block(job, block, small, {"input_count": len(scene), "facts": facts})


def save_block(job: Job, block: int, small: GaussianScene, said: dict[str, Any]) -> None:
    """Write a block that is done."""
    with atomic_output(job.facts_path(block), overwrite=True) as file:
        file.write(json.dumps(said).encode())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        save(small, job.small_path(block), overwrite=True)


def read_cells(job: Job, block: int) -> Block:
    """Read the Gaussians in the cells of a block."""
    survey, targets = job.read_survey()
    rows, labels = read_members(job, block)
    original = select_columns(rows.scene, job.config.effects)
    partition = cells.Partition.from_labels(labels, targets[block])
    return Block(original, drop_unused_bands(original, survey.plan), rows.light, partition)


def _around(job: Job, block: int, strangers: Tensor, path: Callable[[int], Path]) -> Around:
    """Read the cells of a block and some of others, in the order of the latter."""
    own, _ = map_tensors(path(block))
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN", "sizes")
    parts = {name: [own[name]] for name in names}
    for other in torch.unique(strangers[:, 0]).tolist():
        tensors, _ = map_tensors(path(other))
        numbers = strangers[strangers[:, 0] == other, 1]
        for name, values in parts.items():
            values.append(tensors[name].index_select(0, numbers))
    tensors = {name: torch.cat(values) for name, values in parts.items()}
    sizes = tensors.pop("sizes")
    return Around(
        GaussianScene(**tensors, extras={}, comments=(), layout=()), sizes, len(own["sizes"])
    )
