"""The stages in order: filter, tessellate, merge, network; no algorithm here."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cvtgs import cells, cvt, filters
from cvtgs.config import SimplifyConfig
from cvtgs.effects import restored, trimmed
from cvtgs.errors import InvalidArgumentError
from cvtgs.mergenet import MergeNet, correct_cells
from cvtgs.progress import silent
from cvtgs.report import StageClock
from cvtgs.scene import GaussianScene
from cvtgs.stages.entering import check_rows, entering_rows
from cvtgs.stages.merging import merge_groups
from cvtgs.stages.outlook import Outlook, look, look_at_scene
from cvtgs.stages.placing import place_rows


class Reference(NamedTuple):
    """A small scene before its network sees it, and what the network needs to see.

    Attributes:
        scene: The valid Gaussians of the input.
        merged: One Gaussian per cell.
        partition: Rows of ``scene`` that every one of these stands for.
        neighbors: ``(m, k)`` nearest other cells of every cell.
        light: ``(n,)`` how freely every Gaussian of ``scene`` can be seen, 0 to 1.
    """

    scene: GaussianScene
    merged: GaussianScene
    partition: cells.Partition
    neighbors: Tensor
    light: Tensor


class Grouping(NamedTuple):
    """Which Gaussians form which cell, and what coarser cells can be made of.

    Attributes:
        scene: The valid Gaussians of the input.
        outlook: What was found out about them.
        partition: Rows of ``scene`` that make up every cell.
        weights: ``(m,)`` what the members of every cell weigh in the tessellation, together.
        merged: One Gaussian per cell, not yet corrected.
    """

    scene: GaussianScene
    outlook: Outlook
    partition: cells.Partition
    weights: Tensor
    merged: GaussianScene


def run_stages(
    scene: GaussianScene,
    target: int,
    config: SimplifyConfig,
    *,
    outlook: Outlook,
    net: MergeNet | None,
    clock: StageClock,
    on_grouping: Callable[[Grouping], None] | None = None,
) -> tuple[GaussianScene, dict[str, Any]]:
    """Run the stages that follow a look at the scene."""
    if target >= len(scene):
        return all_rows(scene, config, is_whole=target == len(scene), clock=clock)
    reference, facts = _refer(
        scene,
        target,
        config,
        outlook=outlook,
        with_neighbors=net is not None,
        clock=clock,
        on_grouping=on_grouping,
    )
    small = restored(finished(reference, net, clock=clock), scene, facts["plan"])
    return small, facts | {"mass_out": float(small.masses.sum())}


def all_rows(
    valid: GaussianScene, config: SimplifyConfig, *, is_whole: bool, clock: StageClock
) -> tuple[GaussianScene, dict[str, Any]]:
    """Keep all Gaussians, as they are."""
    with clock.stage("plan"):
        facts = look_at_scene(valid, config, with_light=False).facts(valid)
    small = filters.with_finite_opacities(valid) if is_whole else filters.standardized(valid)
    return small, facts | {"mass_out": float(small.masses.sum())}


def finished(reference: Reference, net: MergeNet | None, *, clock: StageClock) -> GaussianScene:
    """Let the network correct merged Gaussians, and make them valid ones."""
    small = reference.merged
    if net is not None:
        with clock.stage("network", len(small)) as advance:
            small = correct_cells(
                net,
                reference.scene,
                small,
                reference.partition,
                neighbors=reference.neighbors,
                visibility=reference.light,
                on_cells=advance,
            )
    return filters.standardized(small)


def make_reference(scene: GaussianScene, target: int, config: SimplifyConfig) -> Reference:
    """Run the stages up to the network, to train it."""
    valid, _ = check_rows(scene)
    if target >= len(valid):
        raise InvalidArgumentError(
            f"target must be below the {len(valid)} valid Gaussians, found {target}."
        )
    clock = StageClock(silent, scene.device)
    outlook = look(valid, config, with_light=True, clock=clock, cameras=None)
    reference, _ = _refer(valid, target, config, outlook=outlook, with_neighbors=True, clock=clock)
    return reference._replace(merged=filters.standardized(reference.merged))


def _refer(
    valid: GaussianScene,
    target: int,
    config: SimplifyConfig,
    *,
    outlook: Outlook,
    with_neighbors: bool,
    clock: StageClock,
    on_grouping: Callable[[Grouping], None] | None = None,
) -> tuple[Reference, dict[str, Any]]:
    """Filter, tessellate and merge."""
    facts = outlook.facts(valid)
    valid = trimmed(valid, outlook.plan)
    with clock.stage("filter"):
        rows, filter_facts = entering_rows(valid, outlook, target, config)
    with clock.stage("tessellate", config.cvt.iterations + 1) as advance:
        rows, points = place_rows(valid, rows, outlook, target, config)
        weights = cvt.tessellation_weights(
            valid.opacities[rows],
            outlook.seen_areas[rows],
            area_power=outlook.area_power(config.cvt),
            floor=config.cvt.weight_floor,
        )
        tessellation = cvt.tessellate(
            points,
            weights,
            target,
            config=config.cvt,
            seed=config.seed,
            has_duplicates=outlook.plan.duplicates.active,
            on_iteration=advance,
        )
        totals = torch.bincount(tessellation.labels, weights) if on_grouping else weights[:0]
        del points, weights
    with clock.stage("merge", target) as advance:
        local = cells.Partition.from_labels(tessellation.labels, target)
        partition = cells.Partition(order=rows[local.order], offsets=local.offsets)
        merged, shown, neighbors = merge_groups(
            valid,
            partition,
            config.merge,
            areas=outlook.areas,
            with_neighbors=with_neighbors,
            backend=tessellation.backend,
            on_cells=advance,
        )
    if on_grouping is not None:
        on_grouping(Grouping(valid, outlook, partition, totals, merged))
    facts |= filter_facts | grouping_facts(partition, tessellation, shown=shown)
    return Reference(valid, merged, shown, neighbors, outlook.light), facts


def grouping_facts(
    partition: cells.Partition, tessellation: cvt.Tessellation, *, shown: cells.Partition
) -> dict[str, Any]:
    """Return what the report says about cells."""
    return {
        "single_member_cells": int((shown.counts == 1).sum()),
        "largest_cell": int(partition.counts.amax()),
        "refilled_cells": tessellation.refilled,
        "energies": tessellation.energies,
        "energy": tessellation.energy,
        "backend": tessellation.backend,
    }
