"""The stages in order: check, plan, filter, tessellate, merge; no algorithm of its own."""

import warnings
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cvtgs import cells, cvt, filters
from cvtgs.config import SimplifyConfig, TessellationConfig
from cvtgs.effects import EffectPlan, plan_effects
from cvtgs.errors import DroppedDataWarning, InvalidSceneError
from cvtgs.math.activations import divide
from cvtgs.math.frames import RobustFrame, robust_frame
from cvtgs.math.morton import morton_order
from cvtgs.report import StageClock
from cvtgs.scene import GaussianScene


class _Outlook(NamedTuple):
    """What one look at the scene tells: where it is, and what each Gaussian paints."""

    frame: RobustFrame
    areas: Tensor
    seen_areas: Tensor
    plan: EffectPlan


def run_stages(
    scene: GaussianScene, target: int, config: SimplifyConfig, *, clock: StageClock
) -> tuple[GaussianScene, dict[str, Any]]:
    """Run the stages.

    Args:
        scene: The scene, on the device to compute on.
        target: Number of Gaussians to keep.
        config: Every choice.
        clock: Measures each stage.

    Returns:
        The small scene, and the facts that :class:`cvtgs.report.SimplifyReport` holds beyond
        counts and costs.

    Raises:
        InvalidSceneError: The scene has no valid row.
    """
    with clock.stage("check"):
        valid, facts = _valid_scene(scene, target)
    with clock.stage("plan"):
        outlook = _look(valid, config)
        mass = float((outlook.areas * valid.opacities).sum())
        facts |= {"plan": outlook.plan, "mass_in": mass}
    if target >= len(valid):
        is_whole = target == len(scene)
        small = filters.with_finite_opacities(valid) if is_whole else filters.standardized(valid)
        return small, facts | {"mass_out": float(small.masses.sum())}
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
        small = cells.merge_cells(valid, partition, config=config.merge, on_cells=advance)
        small = filters.standardized(_widen(small, partition, config, tessellation.backend))
    facts |= filter_facts | {
        "single_member_cells": int((partition.counts == 1).sum()),
        "largest_cell": int(partition.counts.amax()),
        "refilled_cells": tessellation.refilled,
        "mass_out": float(small.masses.sum()),
        "energies": tessellation.energies,
        "energy": tessellation.energy,
        "backend": tessellation.backend,
    }
    return small, facts


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


def _look(scene: GaussianScene, config: SimplifyConfig) -> _Outlook:
    frame, areas = robust_frame(scene.means), scene.areas
    plan = plan_effects(scene, areas * scene.opacities, frame, unbounded=config.cvt.unbounded)
    return _Outlook(frame, areas, _seen_areas(scene, areas, frame, config.cvt), plan)


def _seen_areas(
    scene: GaussianScene, areas: Tensor, frame: RobustFrame, config: TessellationConfig
) -> Tensor:
    """Give areas as they look from the middle, enclosed ones reduced."""
    seen = areas
    if config.perspective:
        seen = seen * cvt.falloff(scene.means, frame)
    if config.hidden_share < 1.0:
        light = cvt.openness(scene.means, areas * scene.opacities, frame)
        seen = seen * (config.hidden_share + (1 - config.hidden_share) * light)
    return seen


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


def _widen(
    small: GaussianScene, partition: cells.Partition, config: SimplifyConfig, backend: str
) -> GaussianScene:
    merge = config.merge
    if merge.widening == 0.0 and merge.covered_widening == 0.0:
        return small
    return cells.widen_cells(
        small,
        partition,
        cvt.nearest_neighbors(small.means, WIDENING_NEIGHBORS, backend=backend),
        everywhere=merge.widening,
        covered=merge.covered_widening,
    )


WIDENING_NEIGHBORS = 8
"""Cells around a cell that may cover its ends."""
