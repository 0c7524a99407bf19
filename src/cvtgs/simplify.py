"""Simplifier: puts the stages in order and holds no algorithm of its own."""

import math
import warnings
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cvtgs import cells, cvt, filters
from cvtgs.config import SimplifyConfig
from cvtgs.devices import resolve_device
from cvtgs.effects import EffectPlan, plan_effects
from cvtgs.errors import (
    CheckpointError,
    DroppedDataWarning,
    InvalidArgumentError,
    InvalidSceneError,
)
from cvtgs.math.activations import divide
from cvtgs.math.frames import RobustFrame, robust_frame
from cvtgs.math.morton import morton_order
from cvtgs.progress import ProgressListener, silent
from cvtgs.report import SimplifyReport, StageClock
from cvtgs.scene import GaussianScene


class Simplified(NamedTuple):
    """A small scene, and how it came about.

    Attributes:
        scene: The small scene.
        report: Counts, mass, energies, and the cost of every stage.
    """

    scene: GaussianScene
    report: SimplifyReport


class Simplifier:
    """Makes scenes smaller: N Gaussians in, exactly ``ceil(rho * N)`` standard Gaussians out.

    Args:
        ckpt: MergeNet checkpoint. This version has none: ``None`` merges by moments.
        config: A configuration, or the name of a preset.
        device: Where to compute: ``auto`` stays where the scene is, but takes CUDA for scenes on
            the CPU if there is one; or any torch device. The result is where the scene was.
        listener: Told about progress.

    Raises:
        CheckpointError: A checkpoint was given.
        ConfigError: There is no such preset.
        DeviceError: There is no such device.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 1000, sh_degree=1, seed=0)
        >>> Simplifier(device="cpu").simplify(scene, 0.01)
        GaussianScene(10 Gaussians, SH degree 1, float32, cpu)
    """

    def __init__(
        self,
        ckpt: str | Path | None = None,
        *,
        config: SimplifyConfig | str = "standard",
        device: str | torch.device = "auto",
        listener: ProgressListener = silent,
    ) -> None:
        if ckpt is not None:
            raise CheckpointError(
                f"this version merges without a network; ckpt must be None, found {str(ckpt)!r}."
            )
        self.config = SimplifyConfig.from_preset(config) if isinstance(config, str) else config
        self._device = resolve_device(device)
        self._listener = listener

    def simplify(
        self, scene: GaussianScene, rho: float | None = None, *, count: int | None = None
    ) -> GaussianScene:
        """Make a scene smaller.

        Args:
            scene: The scene; it is not changed.
            rho: Ratio of Gaussians to keep, in (0, 1].
            count: Number of Gaussians to keep, instead of ``rho``.

        Returns:
            A scene of exactly ``ceil(rho * N)`` (or ``count``) Gaussians; fewer only if so many
            rows are invalid. With ``rho = 1``, the scene's own valid rows.

        Raises:
            InvalidArgumentError: Ratio or count is out of range, or both or neither are given.
            InvalidSceneError: The scene has no valid row.
        """
        return self.run(scene, rho, count=count).scene

    def run(
        self, scene: GaussianScene, rho: float | None = None, *, count: int | None = None
    ) -> Simplified:
        """Make a scene smaller, and report.

        Args:
            scene: The scene; it is not changed.
            rho: Ratio of Gaussians to keep, in (0, 1].
            count: Number of Gaussians to keep, instead of ``rho``.

        Returns:
            The scene and the report.

        Raises:
            InvalidArgumentError: Ratio or count is out of range, or both or neither are given.
            InvalidSceneError: The scene has no valid row.
        """
        target = target_count(len(scene), rho, count=count)
        device = self._device_for(scene)
        clock = StageClock(self._listener, device)
        small, facts = _simplify(scene.to(device), target, self.config, clock)
        report = SimplifyReport(
            input_count=len(scene),
            output_count=len(small),
            target_count=target,
            rho=target / len(scene),
            device=str(device),
            config=self.config,
            stages=tuple(clock.costs),
            **facts,
        )
        return Simplified(small.to(scene.device), report)

    def _device_for(self, scene: GaussianScene) -> torch.device:
        if self._device is not None:
            return self._device
        moves = scene.device.type == "cpu" and torch.cuda.is_available()
        return torch.device("cuda") if moves else scene.device


def target_count(total: int, rho: float | None, *, count: int | None = None) -> int:
    """Give the number of Gaussians to keep.

    ``rho`` is taken as the decimal number that was written: 0.07 of 100 Gaussians are 7, though
    the nearest double times 100 is a little more.

    Args:
        total: Number of Gaussians, N.
        rho: Ratio to keep, in (0, 1].
        count: Number to keep, 1 to N, instead of ``rho``.

    Returns:
        ``ceil(rho * N)``, or ``count``.

    Raises:
        InvalidArgumentError: Ratio or count is out of range, or both or neither are given.

    Example:
        >>> target_count(250, 0.01), target_count(10, 1e-9)
        (3, 1)
    """
    if (rho is None) == (count is None):
        raise InvalidArgumentError("give either rho or count, not both and not neither.")
    if count is not None:
        if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= total:
            raise InvalidArgumentError(
                f"count must be a whole number between 1 and the {total} Gaussians of the scene; "
                f"found {count!r}."
            )
        return count
    if not 0.0 < float(rho or 0.0) <= 1.0:
        raise InvalidArgumentError(f"rho must be above 0 and at most 1; found {rho!r}.")
    return math.ceil(Fraction(str(float(rho or 0.0))) * total)


class _Outlook(NamedTuple):
    """What one look at the scene tells: where it is, and what each Gaussian paints."""

    frame: RobustFrame
    masses: Tensor
    seen_masses: Tensor
    plan: EffectPlan


def _simplify(
    scene: GaussianScene, target: int, config: SimplifyConfig, clock: StageClock
) -> tuple[GaussianScene, dict[str, Any]]:
    """Run the stages; give the small scene and the facts for the report."""
    with clock.stage("check"):
        valid, facts = _valid_scene(scene, target)
    if target >= len(valid):
        return filters.with_finite_opacities(valid), facts
    with clock.stage("plan"):
        outlook = _look(valid, config)
    with clock.stage("filter"):
        rows, filter_facts = _filter(valid, outlook, target, config)
    with clock.stage("tessellate", config.cvt.iterations + 1) as advance:
        rows, points = _place(valid, rows, outlook, config)
        weights = cvt.tessellation_weights(
            valid.opacities[rows],
            outlook.seen_masses[rows],
            weight=config.cvt.weight,
            floor=config.cvt.weight_floor,
        )
        tessellation = cvt.tessellate(
            points, weights, target, config=config.cvt, seed=config.seed, on_iteration=advance
        )
    with clock.stage("merge", target) as advance:
        local = cells.Partition.from_labels(tessellation.labels, target)
        partition = cells.Partition(order=rows[local.order], offsets=local.offsets)
        small = cells.merge_cells(
            valid, partition, outlook.masses, config=config.merge, on_cells=advance
        )
        small = filters.standardized(small)
    facts |= filter_facts | {
        "single_member_cells": int((partition.counts == 1).sum()),
        "largest_cell": int(partition.counts.amax()),
        "refilled_cells": tessellation.refilled,
        "mass_in": float(outlook.masses.sum()),
        "mass_out": float(small.masses.sum()),
        "energies": tessellation.energies,
        "energy": tessellation.energy,
        "backend": tessellation.backend,
        "plan": outlook.plan,
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
    frame, masses = robust_frame(scene.means), scene.masses
    plan = plan_effects(scene, masses, frame, unbounded=config.cvt.unbounded)
    seen = masses * cvt.falloff(scene.means, frame) if plan.unbounded.active else masses
    return _Outlook(frame, masses, seen, plan)


def _filter(
    scene: GaussianScene, outlook: _Outlook, target: int, config: SimplifyConfig
) -> tuple[Tensor, dict[str, Any]]:
    keep = filters.visible_rows(
        scene.opacities,
        outlook.seen_masses,
        min_opacity=config.filter.min_opacity,
        max_mass_share=config.filter.max_mass_share,
        at_least=target,
    )
    left_out = float(divide(outlook.masses[~keep].sum(), outlook.masses.sum()))
    facts = {"filtered_count": int((~keep).sum()), "filtered_mass_share": left_out}
    return keep.nonzero()[:, 0], facts


def _place(
    scene: GaussianScene, rows: Tensor, outlook: _Outlook, config: SimplifyConfig
) -> tuple[Tensor, Tensor]:
    """Place Gaussians in the space of the tessellation; rows and points along a Morton curve."""
    place = partial(cvt.embed, frame=outlook.frame, contracted=outlook.plan.unbounded.active)
    means, colors = scene.means[rows], scene.sh0[rows]
    order = morton_order(place(means, colors, color=0.0))
    return rows[order], place(means[order], colors[order], color=config.cvt.color)
