"""Prepared: a scene to simplify repeatedly, with a fallback if the device lacks memory."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from typing import TypeVar

import torch
from jaxtyping import Bool
from torch import Tensor

from cvtgs.analysis import SceneAnalysis, analyze, drop_unused_bands, restore_columns
from cvtgs.analysis.analyze import measure_contributions
from cvtgs.analysis.effects import restore_comments, select_columns
from cvtgs.boxes import MaskLike, check_room, checked_mask
from cvtgs.cameras import Cameras, checked_cameras
from cvtgs.clock import StageClock
from cvtgs.config import SimplifyConfig
from cvtgs.counts import shortfall, target_count
from cvtgs.devices import chosen_device, full_precision, threads_for_chunks, within_memory
from cvtgs.edit import concatenate
from cvtgs.errors import (
    BLOCKS_ADVICE,
    CameraWarning,
    InvalidArgumentError,
    memory_errors,
    without_warnings,
)
from cvtgs.grouping import (
    OrderedRows,
    add_neighbors,
    factors_by_errors,
    factors_of_members,
    order_rows,
)
from cvtgs.mergenet import Checkpoint, Net
from cvtgs.pipeline import Reduced, level_facts, reduce_scene
from cvtgs.progress import ProgressListener, silent
from cvtgs.report import Level, Simplified, SimplifyReport, origin_of_views
from cvtgs.scene import GaussianScene
from cvtgs.text import shown
from cvtgs.validity import CheckedScene, check_rows, with_finite_opacities

Result = TypeVar("Result")


def check_cameras(cameras: Cameras | None, config: SimplifyConfig) -> None:
    """Raise if cameras were given, but too few for a configuration that renders images."""
    if cameras is None:
        return
    least = 2 if config.refine.enabled else 1
    if len(checked_cameras(cameras)) < least and config.uses_images:
        raise InvalidArgumentError(
            f"preset {config.preset} needs at least {least} "
            f"{'cameras, one of them to be held out' if least > 1 else 'camera'}; "
            f"found {len(cameras)}."
        )


class Prepared:
    """A scene to simplify repeatedly; results that do not depend on the count are cached.

    From the second run or ``warm_up`` on, 160 more bytes per Gaussian are cached (up to 256 with
    view-dependent colour), and another 48 once such a run merges pairs of single Gaussians
    (``standard`` above a ratio of 0.031).

    ``Simplifier.prepare`` creates instances. Every run gives the bits of ``Simplifier.run``; the
    report of the first run includes the shared stages.

    Args:
        scene: The input scene.
        config: The configuration.
        checkpoint: Checkpoint of the network that corrects merged Gaussians; None for no network.
        device: Device to compute on; None chooses as ``auto`` does.
        cameras: Cameras for presets that render the scene; None generates views.
        listener: Called with progress events.

    Raises:
        InvalidArgumentError: There are too few cameras for a preset that renders the scene.
    """

    def __init__(
        self,
        scene: GaussianScene,
        config: SimplifyConfig,
        *,
        checkpoint: Checkpoint | None,
        device: torch.device | None = None,
        cameras: Cameras | None = None,
        listener: ProgressListener = silent,
    ) -> None:
        check_cameras(cameras, config)
        self._scene, self._config, self._checkpoint = scene, config, checkpoint
        self._cameras, self._listener = cameras, listener
        self._device = device or chosen_device("auto", scene.device)
        self._may_leave = device is None
        self._device_note = ""  # for the current run
        self._move_note = ""  # for all runs after a fallback to another device
        self._forget()

    def __repr__(self) -> str:
        return f"Prepared({self._scene!r}, preset {self._config.preset}, device {self._device})"

    def _forget(self) -> None:
        """Release everything that is cached on the device."""
        self._net: Net | None = None
        self._checked: CheckedScene | None = None
        self._analysis: SceneAnalysis | None = None
        self._ordered: OrderedRows | None = None
        self._has_run = False

    @property
    def scene(self) -> GaussianScene:
        """The input scene."""
        return self._scene

    def run(
        self,
        rho: float | None = None,
        *,
        count: int | None = None,
        max_count: int | None = None,
        keep: MaskLike | None = None,
    ) -> Simplified:
        """Simplify the scene, and report; arguments and errors as for ``Simplifier.run``."""
        total = len(self._scene)
        target = target_count(total, rho, count=count, max_count=max_count)
        mask = None if keep is None else checked_mask(keep, total)
        return self._attempt(partial(self._run, target, mask))

    def _attempt(self, compute: Callable[[], Result]) -> Result:
        """Compute on the device, or elsewhere if it lacks memory, without gradients of inputs."""

        def compute_on(device: torch.device, note: str) -> Result:
            if note:  # after a failed attempt
                self._forget()
            if device != self._device:
                self._device, self._move_note = device, note
            self._device_note = note or self._move_note
            return compute()

        work = f"simplifying {len(self._scene):,} Gaussians"
        with (
            threads_for_chunks(),
            torch.inference_mode(mode=False),  # a refinement needs gradients of its own
            torch.no_grad(),
            full_precision(),
            memory_errors(work, BLOCKS_ADVICE),
        ):
            return within_memory(compute_on, self._device, work=work, may_leave=self._may_leave)

    def _run(self, target: int, keep: Bool[Tensor, "n"] | None) -> Simplified:
        clock = StageClock(self._listener, self._device)
        checked, analysis = self._analyze(target, clock)
        valid = checked.scene
        if keep is None or not bool(keep.any()):
            reduced = self._match(self._reduce(valid, analysis, target, clock), analysis, clock)
            return self._result(reduced, checked, analysis, target, clock)
        keep = keep.to(valid.device)
        kept = keep if checked.is_valid is None else keep[checked.is_valid]
        check_room(int(kept.sum()), target=target, total=len(valid))
        first, rest = kept.nonzero()[:, 0], (~kept).nonzero()[:, 0]
        protected = restore_comments(
            with_finite_opacities(valid.select(first)), valid, analysis.plan
        )
        part, room = analysis.select(rest), target - len(protected)
        others = self._reduce(valid.select(rest), part, room, clock, kept=protected)
        reduced = others._replace(
            scene=concatenate([protected, others.scene]),
            statistics=others.statistics.in_larger(part.masses.sum(), analysis.masses.sum()),
        )
        reduced = self._match(reduced, part, clock)
        return self._result(reduced, checked, analysis, target, clock, kept_count=len(protected))

    def warm_up(self, rho: float) -> None:
        """Compute and cache in advance the results that the second run would cache.

        Args:
            rho: The largest ratio to expect.
        """
        target = target_count(len(self._scene), rho)

        def compute() -> None:
            clock = StageClock(silent, self._device)
            checked, analysis = self._analyze(target, clock)
            self._has_run = True
            self._order(checked.scene, analysis, target, clock)

        self._attempt(compute)

    def levels(self, rhos: Sequence[float]) -> tuple[Level, ...]:
        """Simplify the scene to several levels; see ``Simplifier.levels``."""
        try:
            ratios = list(rhos)
        except TypeError:  # also a tensor of one number
            ratios = []
        if not ratios:
            raise InvalidArgumentError(f"levels need a list of ratios, found {shown(rhos)}.")
        targets = [target_count(len(self._scene), rho) for rho in ratios]
        found = self._attempt(partial(self._run_levels, targets))
        return tuple(found[target] for target in targets)

    def _run_levels(self, targets: Sequence[int]) -> dict[int, Level]:
        found: dict[int, Level] = {}
        for target in sorted(set(targets), reverse=True):
            clock = StageClock(self._listener, self._device)
            checked, analysis = self._analyze(target, clock)
            valid = checked.scene
            reduced = self._reduce(valid, analysis, target, clock)
            matched = self._match(reduced, analysis, clock)
            result = self._result(matched, checked, analysis, target, clock)
            final = reduced._replace(scene=result.scene.to(valid.device))
            error, rows, sums = level_facts(valid, analysis, final, is_valid=checked.is_valid)
            found[target] = Level(*result, error, rows, sums)
        return found

    def _analyze(self, target: int, clock: StageClock) -> tuple[CheckedScene, SceneAnalysis]:
        """Check and analyze the scene once; if all Gaussians are kept, it is planned only."""
        if self._checked is None:
            with clock.stage("check"):
                used = select_columns(self._scene, self._config.effects).to(self._device)
                # Gradients end here, and sums over other than whole rows would round another way.
                tensors = {name: x.detach().contiguous() for name, x in used.tensors().items()}
                extras = {name: column.detach() for name, column in used.extras.items()}
                used = used.with_tensors(tensors, extras)
                if self._checkpoint is not None:
                    self._net = self._checkpoint.net.copy_to(self._device, used.means.dtype)
                self._checked = check_rows(used)
        checked, analysis = self._checked, self._analysis
        if analysis is not None:
            return checked, analysis
        valid = checked.scene
        is_whole = target >= len(valid)
        if self._cameras is not None and self._config.uses_images and not is_whole:
            from cvtgs.evaluation.blind_views import check_seen  # noqa: PLC0415 (few give cameras)

            check_seen(valid, self._cameras, name="the scene", refines=self._config.refine.enabled)
        with clock.stage("plan"):
            sees = self._net is not None and self._net.sees_surroundings
            analysis = analyze(valid, self._config, with_visibility=sees and not is_whole)
        if not is_whole:
            if analysis.plan.visibility.active:
                images = self._config.visibility.views
                if self._cameras is not None:
                    images = min(images, len(self._cameras))
                with clock.stage("visibility", images) as advance:
                    analysis = measure_contributions(
                        valid, analysis, self._config, cameras=self._cameras, on_image=advance
                    )
            self._analysis = analysis
        return checked, analysis

    def _reduce(
        self,
        valid: GaussianScene,
        analysis: SceneAnalysis,
        target: int,
        clock: StageClock,
        *,
        kept: GaussianScene | None = None,
    ) -> Reduced:
        """Run the stages after the analysis, with what earlier runs have cached of whole scenes.

        With given cameras, but not generated ones, they run again: with fewer merges where it errs.
        """
        if kept is None:
            self._order(valid, analysis, target, clock)
            self._has_run = self._has_run or target < len(valid)
        reduce = partial(
            reduce_scene,
            valid,
            target=target,
            config=self._config,
            net=self._net,
            clock=clock,
            total=len(self._scene) if kept is None else len(self._scene) - len(kept),
            ordered=self._ordered if kept is None else None,
        )
        found, power, observed = reduce(analysis), self._config.match.error_power, analysis.observed
        if self._cameras is None or power == 0 or observed is None or found.partition is None:
            return found
        from cvtgs.matching import cell_contributions  # noqa: PLC0415 (few need it)
        from cvtgs.rendering import error_shares  # noqa: PLC0415 (few need it)

        with clock.stage("errors"):
            drawn = found.scene if kept is None else concatenate([kept, found.scene])
            errors = error_shares(drop_unused_bands(drawn, analysis.plan), observed)
            factors = factors_by_errors(
                found.scene.means,
                errors=errors[len(drawn) - len(found.scene) :],
                pixels=cell_contributions(observed.contributions, found.partition),
                power=power,
            )
            importance = factors_of_members(factors, found.partition, len(valid))
        return reduce(analysis, importance=importance)

    def _order(
        self, valid: GaussianScene, analysis: SceneAnalysis, target: int, clock: StageClock
    ) -> None:
        """Cache the target-independent part of grouping, from the second run on."""
        if self._has_run and self._ordered is None and target < len(valid):
            with clock.stage("order"):
                self._ordered = order_rows(valid, analysis, self._config)
        if self._ordered is not None:
            self._ordered = add_neighbors(self._ordered, target, self._config.allocation)

    def _match(self, reduced: Reduced, analysis: SceneAnalysis, clock: StageClock) -> Reduced:
        """Match the small scene to the images of the analysis, if there are any."""
        is_off = not self._config.match.enabled
        if is_off or reduced.partition is None or analysis.observed is None:
            return reduced
        from cvtgs.matching import cell_contributions, match_views  # noqa: PLC0415 (few need it)

        with clock.stage("match"):
            targets = cell_contributions(analysis.observed.contributions, reduced.partition)
            small = drop_unused_bands(reduced.scene, analysis.plan)
            kept = len(small) - len(targets)  # protected Gaussians come first, and have no cells
            matched = match_views(
                small,
                analysis.observed,
                torch.nn.functional.pad(targets, (kept, 0)),
                config=self._config.match,
                frozen=kept,
            )
            scene = restore_columns(matched.scene, reduced.scene, analysis.plan)
            scene = concatenate([reduced.scene[:kept], scene[kept:]]) if kept else scene
        return reduced._replace(scene=scene, matching=matched.report)

    def _result(
        self,
        reduced: Reduced,
        checked: CheckedScene,
        analysis: SceneAnalysis,
        target: int,
        clock: StageClock,
        *,
        kept_count: int = 0,
    ) -> Simplified:
        """Report, restore columns that were left out, and refine if the configuration says so."""
        scene, total = self._scene, len(self._scene)
        masses = [analysis.masses.sum(), reduced.scene.masses.sum()]
        mass_in, mass_out = torch.stack(masses).tolist()
        views = "none"
        is_whole = target >= total - checked.invalid_count
        if not is_whole and (self._config.refine.enabled or analysis.plan.visibility.active):
            views = origin_of_views(self._cameras)
        report = SimplifyReport(
            input_count=total,
            output_count=len(reduced.scene),
            target_count=target,
            rho=target / total,
            invalid_rows=checked.invalid_rows,
            invalid_count=checked.invalid_count,
            shortfall=shortfall(total - checked.invalid_count, total, target),
            kept_count=kept_count,
            mass_in=mass_in,
            mass_out=mass_out,
            checkpoint="none" if self._checkpoint is None else self._checkpoint.name,
            device=str(self._device),
            device_note=self._device_note,
            views=views,
            plan=analysis.plan,
            matching=reduced.matching,
            stages=tuple(clock.costs),
            config=self._config,
            **reduced.statistics.model_dump(),
        )
        small = restore_columns(reduced.scene, scene, analysis.plan).to(scene.means.device)
        result = Simplified(small, report)
        if not self._config.refine.enabled or is_whole:
            return result
        return self._refine(result, analysis)

    def _refine(self, result: Simplified, analysis: SceneAnalysis) -> Simplified:
        from cvtgs.refinement import refine  # noqa: PLC0415 (most never need it)
        from cvtgs.refinement.refine import join_reports  # noqa: PLC0415 (most never need it)

        choices, plan, kept = self._config.effects, analysis.plan, result.report.kept_count
        small, full = (
            drop_unused_bands(select_columns(scene, choices), plan)
            for scene in (result.scene, self._scene)
        )
        has_warned = self._cameras is not None or plan.visibility.active
        with without_warnings(CameraWarning) if has_warned else nullcontext():
            refined = refine(
                small,
                full,
                cameras=self._cameras,
                config=self._config.refine,
                seed=self._config.seed,
                device=self._device,
                frozen=kept,
                observed=analysis.observed if self._config.shares_images else None,
                listener=self._listener,
            )
        scene = restore_columns(refined.scene, self._scene, plan)
        scene = concatenate([result.scene[:kept], scene[kept:]]) if kept else scene
        return Simplified(scene, join_reports(result.report, refined))
