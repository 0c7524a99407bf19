"""The stages in order: check, plan, filter, tessellate, merge, network; no algorithm here."""

import warnings
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cvtgs import cells, cvt, filters
from cvtgs.config import SimplifyConfig
from cvtgs.effects import EffectPlan, plan_effects
from cvtgs.errors import DroppedDataWarning, InvalidArgumentError, InvalidSceneError
from cvtgs.math.activations import divide
from cvtgs.math.frames import RobustFrame, robust_frame
from cvtgs.math.morton import morton_order
from cvtgs.mergenet import MergeNet, correct_cells
from cvtgs.progress import silent
from cvtgs.report import StageClock
from cvtgs.scene import GaussianScene


class _Outlook(NamedTuple):
    """What one look at the scene tells: where it is, and what each Gaussian paints."""

    frame: RobustFrame
    areas: Tensor
    seen_areas: Tensor
    light: Tensor
    plan: EffectPlan

    def facts(self, scene: GaussianScene) -> dict[str, Any]:
        """Give what the report says about it."""
        return {"plan": self.plan, "mass_in": float((self.areas * scene.opacities).sum())}


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
) -> tuple[GaussianScene, dict[str, Any]]:
    """Run the stages.

    Args:
        scene: The scene, on the device to compute on.
        target: Number of Gaussians to keep.
        config: Every choice.
        net: Corrects merged Gaussians, on the same device; None for no correction.
        clock: Measures each stage.

    Returns:
        The small scene, and the facts that :class:`cvtgs.report.SimplifyReport` holds beyond
        counts and costs.

    Raises:
        InvalidSceneError: The scene has no valid row.
    """
    with clock.stage("check"):
        valid, facts = _valid_scene(scene, target)
    if target >= len(valid):
        with clock.stage("plan"):
            facts |= _look(valid, config, with_light=False).facts(valid)
        is_whole = target == len(scene)
        small = filters.with_finite_opacities(valid) if is_whole else filters.standardized(valid)
        return small, facts | {"mass_out": float(small.masses.sum())}
    reference, more = _refer(valid, target, config, with_light=net is not None, clock=clock)
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
    valid, _ = _valid_scene(scene, target)
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
) -> tuple[Reference, dict[str, Any]]:
    """Plan, filter, tessellate and merge."""
    with clock.stage("plan"):
        outlook = _look(valid, config, with_light=with_light)
        facts = outlook.facts(valid)
    with clock.stage("filter"):
        rows, filter_facts = _filter(valid, outlook, target, config)
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


def _valid_scene(scene: GaussianScene, target: int) -> tuple[GaussianScene, dict[str, Any]]:
    if len(scene) == 0:
        raise InvalidSceneError("a scene needs at least one Gaussian to be simplified; found none.")
    invalid = filters.invalid_rows(scene)
    if not invalid:
        return scene, {}
    dropped = torch.stack(list(invalid.values())).any(dim=0)
    count = int(dropped.sum())
    reasons = {name: int(mask.sum()) for name, mask in invalid.items()}
    text = ", ".join(f"{name} {number}" for name, number in reasons.items())
    left = len(scene) - count
    if left == 0:
        raise InvalidSceneError(
            f"none of the {len(scene)} Gaussians is valid; "
            f"found NaN, infinite or zero values in {text}."
        )
    warnings.warn(
        f"dropped {count} of {len(scene)} Gaussians with NaN, infinite or zero values ({text}).",
        DroppedDataWarning,
        stacklevel=2,
    )
    shortfall = f"only {left} of {len(scene)} Gaussians are valid" if left < target else ""
    facts = {"invalid_rows": reasons, "invalid_count": count, "shortfall": shortfall}
    return scene.select(~dropped), facts


def _look(scene: GaussianScene, config: SimplifyConfig, *, with_light: bool) -> _Outlook:
    frame, areas = robust_frame(scene.means), scene.areas
    masses = areas * scene.opacities
    plan = plan_effects(scene, masses, frame, unbounded=config.cvt.unbounded)
    hides = config.cvt.hidden_share < 1.0
    light = cvt.openness(scene.means, masses, frame) if hides or with_light else masses[:0]
    seen = areas
    if config.cvt.perspective:
        seen = seen * cvt.falloff(scene.means, frame)
    if hides:
        seen = seen * (config.cvt.hidden_share + (1 - config.cvt.hidden_share) * light)
    return _Outlook(frame, areas, seen, light, plan)


def _filter(
    scene: GaussianScene, outlook: _Outlook, target: int, config: SimplifyConfig
) -> tuple[Tensor, dict[str, Any]]:
    opacities = scene.opacities
    keep = filters.visible_rows(
        opacities,
        outlook.seen_areas * opacities,
        min_opacity=config.filter.min_opacity,
        max_mass_share=config.filter.max_mass_share,
        at_least=target,
    )
    keep = _without_flyaways(scene, keep, outlook, target, config)
    masses = outlook.areas * opacities
    left_out = divide(masses[~keep].sum(), masses.sum())
    facts = {"filtered_count": int((~keep).sum()), "filtered_mass_share": float(left_out)}
    return keep.nonzero()[:, 0], facts


def _without_flyaways(
    scene: GaussianScene, keep: Tensor, outlook: _Outlook, target: int, config: SimplifyConfig
) -> Tensor:
    share = config.filter.max_flyaway_share
    if share == 0.0:
        return keep
    distances = outlook.frame.distances(scene.means)
    if float(distances.amax()) <= filters.FLYAWAY_RADII:
        return keep
    seen = outlook.areas * scene.opacities * cvt.falloff(scene.means, outlook.frame)
    flown = filters.flyaway_rows(distances, seen, max_share=share)
    fewer = keep & ~flown
    return fewer if int(fewer.sum()) >= target else keep


def _place(
    scene: GaussianScene, rows: Tensor, outlook: _Outlook, target: int, config: SimplifyConfig
) -> tuple[Tensor, Tensor]:
    """Place Gaussians in the space of the tessellation; rows and points along a Morton curve."""
    # A curve through contracted space stays fine where the bulk is, whatever flies away.
    curve = cvt.embed(scene.means[rows], frame=outlook.frame, contracted=True)
    rows = rows[morton_order(curve)]
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
