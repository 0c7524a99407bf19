"""Several sizes of one scene: coarser cells are made of the cells of the finest size."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs import cells, cvt
from cvtgs.config import SimplifyConfig
from cvtgs.effects import restored
from cvtgs.math.segments import segment_ids
from cvtgs.mergenet import MergeNet
from cvtgs.report import StageClock
from cvtgs.scene import GaussianScene
from cvtgs.stages.entering import left_out_facts
from cvtgs.stages.merging import merge_groups
from cvtgs.stages.placing import place_rows
from cvtgs.stages.prepared import PreparedScene
from cvtgs.stages.run import (
    Grouping,
    Reference,
    finished,
    grouping_facts,
)

NESTED_FROM = 4
"""A cell is made of cells only where there are, on average, at least so many of them in it."""


CHUNK = 1 << 18
"""Gaussians whose distance is measured together, to bound memory."""


class Sized(NamedTuple):
    """One size of a scene.

    Attributes:
        scene: The Gaussians that are left.
        facts: What the report holds beyond counts and costs.
        clock: What it cost.
        geometric_error: Root mean square distance from Gaussians to those that stand for them,
            each weighing what it does in the tessellation; scene units.
        nested: Whether its cells are made of cells of the finest size.
    """

    scene: GaussianScene
    facts: dict[str, Any]
    clock: StageClock
    geometric_error: float
    nested: bool


def run_levels(
    prepared: PreparedScene,
    targets: Sequence[int],
    *,
    clock: Callable[[], StageClock],
    on_grouping: Callable[[Grouping], None] = lambda grouping: None,
) -> list[Sized]:
    """Run the stages for several sizes, and share what they have in common.

    The finest size is that of a run of its own, bit for bit. A coarser one groups the cells of
    the finest, which are few, and merges all Gaussians in them, so its cells are made of whole
    finest ones. A size with more than a quarter of the finest cells gets a tessellation of its
    own: there whole cells are too coarse to build with.
    """
    results: list[Sized] = []
    finest: Grouping | None = None
    for target in targets:
        watch = clock()
        valid, found = prepared.valid(watch), list[Grouping]()
        nested = finest is not None and NESTED_FROM * target <= len(finest.partition)
        if finest is not None and nested:
            small, facts = _made_of(
                finest,
                target,
                prepared.config,
                original=valid,
                net=prepared.net,
                clock=watch,
                on_grouping=found.append,
            )
            facts |= prepared.facts(target)
        else:
            small, facts = prepared.run(target, clock=watch, on_grouping=found.append)
        error = 0.0
        for grouping in found:
            on_grouping(grouping)
            finest = finest or grouping
            masses = grouping.outlook.seen_areas * valid.opacities
            error = _distance(grouping, small, masses=masses)
        results.append(Sized(small, facts, watch, error, nested))
    return results


def _distance(grouping: Grouping, small: GaussianScene, *, masses: Float[Tensor, "n"]) -> float:
    """Return the root mean square distance from Gaussians to what stands for them."""
    partition, squares, total = grouping.partition, 0.0, 0.0
    ids = segment_ids(partition.offsets)
    for rows, cell in zip(partition.order.split(CHUNK), ids.split(CHUNK), strict=True):
        shifts = grouping.scene.means[rows].double() - small.means[cell].double()
        squares += float((masses[rows] * shifts.square().sum(dim=1)).sum())
        total += float(masses[rows].sum())
    return math.sqrt(squares / total) if total > 0.0 else 0.0


def _made_of(
    finest: Grouping,
    target: int,
    config: SimplifyConfig,
    *,
    original: GaussianScene,
    net: MergeNet | None,
    clock: StageClock,
    on_grouping: Callable[[Grouping], None],
) -> tuple[GaussianScene, dict[str, Any]]:
    """Group the finest cells, and merge what is in them."""
    valid, outlook, fine = finest.scene, finest.outlook, finest.merged
    with clock.stage("tessellate", config.cvt.iterations + 1) as advance:
        everything = torch.arange(len(fine), device=fine.device)
        around = outlook._replace(seen_areas=finest.weights)
        rows, points = place_rows(fine, everything, around, target, config)
        tessellation = cvt.tessellate(
            points,
            finest.weights[rows],
            target,
            config=config.cvt,
            seed=config.seed,
            on_iteration=advance,
        )
        partition = _composed(finest.partition, rows, tessellation.labels, target)
    with clock.stage("merge", target) as advance:
        merged, shown, neighbors = merge_groups(
            valid,
            partition,
            config.merge,
            areas=outlook.areas,
            with_neighbors=net is not None,
            backend=tessellation.backend,
            on_cells=advance,
        )
    on_grouping(Grouping(valid, outlook, partition, finest.weights, merged))
    reference = Reference(valid, merged, shown, neighbors, outlook.light)
    small = restored(finished(reference, net, clock=clock), original, outlook.plan)
    left_out = torch.ones(len(valid), dtype=torch.bool, device=valid.device)
    left_out[partition.order] = False
    facts = outlook.facts(valid) | grouping_facts(partition, tessellation, shown=shown)
    facts |= left_out_facts(valid, outlook, left_out)
    return small, facts | {"mass_out": float(small.masses.sum())}


def _composed(fine: cells.Partition, rows: Tensor, labels: Tensor, count: int) -> cells.Partition:
    """Return the members of cells that consist of fine cells."""
    coarse = torch.empty_like(labels)
    coarse[rows] = labels
    local = cells.Partition.from_labels(torch.repeat_interleave(coarse, fine.counts), count)
    return cells.Partition(order=fine.order[local.order], offsets=local.offsets)
