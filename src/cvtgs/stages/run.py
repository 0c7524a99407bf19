"""The stages in order: check, plan, filter, tessellate, merge, network; no algorithm here."""

from typing import Any, NamedTuple

from torch import Tensor

from cvtgs import cells, cvt, filters
from cvtgs.cameras import Cameras
from cvtgs.config import SimplifyConfig
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.morton import morton_order
from cvtgs.mergenet import MergeNet, correct_cells
from cvtgs.progress import silent
from cvtgs.report import StageClock
from cvtgs.scene import GaussianScene
from cvtgs.stages.entering import entering_rows, valid_scene
from cvtgs.stages.outlook import Outlook, look_at_pictures, look_at_scene


class Reference(NamedTuple):
    """A small scene before its network sees it, and what the network needs to see.

    Attributes:
        scene: The valid Gaussians of the input.
        merged: One Gaussian per cell.
        partition: Rows of ``scene`` that make up every cell.
        neighbors: ``(m, k)`` nearest other cells of every cell.
        light: ``(n,)`` how freely every Gaussian of ``scene`` can be seen, 0 to 1.
    """

    scene: GaussianScene
    merged: GaussianScene
    partition: cells.Partition
    neighbors: Tensor
    light: Tensor


def run_stages(
    scene: GaussianScene,
    target: int,
    config: SimplifyConfig,
    *,
    net: MergeNet | None,
    clock: StageClock,
    cameras: Cameras | None = None,
) -> tuple[GaussianScene, dict[str, Any]]:
    """Run the stages.

    Args:
        scene: The scene, on the device to compute on.
        target: Number of Gaussians to keep.
        config: Every choice.
        net: Corrects merged Gaussians, on the same device; None for no correction.
        clock: Measures each stage.
        cameras: From where a configuration that looks at the scene does so; None finds views.

    Returns:
        The small scene, and the facts that :class:`cvtgs.report.SimplifyReport` holds beyond
        counts and costs.

    Raises:
        InvalidSceneError: The scene has no valid row.
    """
    with clock.stage("check"):
        valid, facts = valid_scene(scene, target)
    if target >= len(valid):
        with clock.stage("plan"):
            facts |= look_at_scene(valid, config, with_light=False).facts(valid)
        is_whole = target == len(scene)
        small = filters.with_finite_opacities(valid) if is_whole else filters.standardized(valid)
        return small, facts | {"mass_out": float(small.masses.sum())}
    reference, more = _refer(
        valid, target, config, with_light=net is not None, clock=clock, cameras=cameras
    )
    small, facts = reference.merged, facts | more
    if net is not None:
        with clock.stage("network", target) as advance:
            small = correct_cells(
                net,
                reference.scene,
                reference.merged,
                reference.partition,
                neighbors=reference.neighbors,
                light=reference.light,
                on_cells=advance,
            )
    small = filters.standardized(small)
    return small, facts | {"mass_out": float(small.masses.sum())}


def make_reference(scene: GaussianScene, target: int, config: SimplifyConfig) -> Reference:
    """Run the stages up to the network, to train it.

    Args:
        scene: The scene, on the device to compute on.
        target: Number of Gaussians to keep, fewer than there are valid ones.
        config: Every choice.

    Returns:
        What the network is to correct.

    Raises:
        InvalidArgumentError: There are no more valid Gaussians than ``target``.
        InvalidSceneError: The scene has no valid row.
    """
    valid, _ = valid_scene(scene, target)
    if target >= len(valid):
        raise InvalidArgumentError(
            f"target must be below the {len(valid)} valid Gaussians, found {target}."
        )
    clock = StageClock(silent, scene.device)
    reference, _ = _refer(valid, target, config, with_light=True, clock=clock)
    return reference._replace(merged=filters.standardized(reference.merged))


def _refer(
    valid: GaussianScene,
    target: int,
    config: SimplifyConfig,
    *,
    with_light: bool,
    clock: StageClock,
    cameras: Cameras | None = None,
) -> tuple[Reference, dict[str, Any]]:
    """Plan, filter, tessellate and merge."""
    with clock.stage("plan"):
        outlook = look_at_scene(valid, config, with_light=with_light)
        facts = outlook.facts(valid)
    if config.visibility.views:
        with clock.stage("visibility"):
            outlook = look_at_pictures(
                valid, outlook, config.visibility, cameras=cameras, seed=config.seed
            )
    with clock.stage("filter"):
        rows, filter_facts = entering_rows(valid, outlook, target, config)
    with clock.stage("tessellate", config.cvt.iterations + 1) as advance:
        rows, points = _place(valid, rows, outlook, target, config)
        weights = cvt.tessellation_weights(
            valid.opacities[rows],
            outlook.seen_areas[rows],
            area_power=(
                config.cvt.unbounded_area_power
                if outlook.plan.unbounded.active
                else config.cvt.area_power
            ),
            floor=config.cvt.weight_floor,
        )
        tessellation = cvt.tessellate(
            points, weights, target, config=config.cvt, seed=config.seed, on_iteration=advance
        )
        del points, weights
    with clock.stage("merge", target) as advance:
        local = cells.Partition.from_labels(tessellation.labels, target)
        partition = cells.Partition(order=rows[local.order], offsets=local.offsets)
        merged = cells.merge_cells(valid, partition, config=config.merge, on_cells=advance)
        widens = config.merge.widening > 0.0 or config.merge.covered_widening > 0.0
        near = NEIGHBORS if widens or with_light else 0
        neighbors = cvt.nearest_neighbors(merged.means, near, backend=tessellation.backend)
        if widens:
            merged = cells.widen_cells(
                merged,
                partition,
                neighbors,
                everywhere=config.merge.widening,
                covered=config.merge.covered_widening,
            )
    facts |= filter_facts | {
        "single_member_cells": int((partition.counts == 1).sum()),
        "largest_cell": int(partition.counts.amax()),
        "refilled_cells": tessellation.refilled,
        "energies": tessellation.energies,
        "energy": tessellation.energy,
        "backend": tessellation.backend,
    }
    return Reference(valid, merged, partition, neighbors, outlook.light), facts


def _place(
    scene: GaussianScene, rows: Tensor, outlook: Outlook, target: int, config: SimplifyConfig
) -> tuple[Tensor, Tensor]:
    """Place Gaussians in the space of the tessellation; rows and points along a Morton curve."""
    # A curve through contracted space stays fine where the bulk is, whatever flies away.
    curve = cvt.embed(scene.means[rows], frame=outlook.frame, contracted=True)
    rows = rows[morton_order(curve, ties=outlook.seen_areas[rows] * scene.opacities[rows])]
    del curve
    points = cvt.embed(
        scene.means[rows],
        scene.sh0[rows],
        frame=outlook.frame,
        contracted=outlook.plan.unbounded.active,
        color=config.cvt.color * (target / COLOR_CELLS) ** config.cvt.color_power,
    )
    return rows, points


COLOR_CELLS = 10_000
"""The number of cells that ``cvt.color`` is meant for."""


NEIGHBORS = 8
"""Cells around a cell that may cover its ends, and that its network sees."""
