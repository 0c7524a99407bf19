"""Simplifier: the one call that users make."""

import copy
import os
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.config import SimplifyConfig
from cvtgs.counts import target_count
from cvtgs.devices import chosen_device, resolve_device
from cvtgs.effects import imaged, limited, restored, trimmed
from cvtgs.errors import ConfigError, InvalidArgumentError
from cvtgs.mergenet import SHIPPED, Checkpoint, MergeNet, load_checkpoint
from cvtgs.progress import ProgressListener, silent
from cvtgs.report import SimplifyReport, StageClock
from cvtgs.scene import GaussianScene
from cvtgs.simplify.prepared import Prepared
from cvtgs.simplify.results import Level, Simplified
from cvtgs.stages import PreparedScene, run_levels


class Simplifier:
    """Makes scenes smaller: N Gaussians in, exactly ``ceil(rho * N)`` standard Gaussians out.

    Args:
        ckpt: MergeNet checkpoint: ``standard`` or ``paper``, which come with the package, or a
            file; ``auto`` is the shipped one that fits the configuration's preset, ``None``
            merges by moments alone.
        config: A configuration, or the name of a preset; None is the preset of the checkpoint.
        device: Where to compute: ``auto`` stays where the scene is, but takes CUDA for scenes on
            the CPU if there is one; or any torch device. The result is where the scene was.
        listener: Told about progress.

    Raises:
        CheckpointError: The checkpoint cannot be used.
        ConfigError: There is no such preset, or it has no network but a checkpoint is given.
        DeviceError: There is no such device.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 1000, sh_degree=1, seed=0)
        >>> Simplifier("standard", device="cpu").simplify(scene, 0.01)
        GaussianScene(10 Gaussians, SH degree 1, float32, cpu)
    """

    def __init__(
        self,
        ckpt: str | os.PathLike[str] | None = "auto",
        *,
        config: SimplifyConfig | str | None = None,
        device: str | torch.device = "auto",
        listener: ProgressListener = silent,
    ) -> None:
        if isinstance(config, str):
            config = SimplifyConfig.from_preset(config)
        self.checkpoint = _checkpoint(ckpt, config)
        self.config = config or SimplifyConfig.from_preset(
            "standard" if self.checkpoint is None else self.checkpoint.info.preset
        )
        self._device = resolve_device(device)
        self._listener = listener

    def simplify(
        self,
        scene: GaussianScene,
        rho: float | None = None,
        *,
        count: int | None = None,
        cameras: Cameras | None = None,
        keep: Bool[Tensor, "n"] | None = None,
    ) -> GaussianScene:
        """Make a scene smaller.

        Args:
            scene: The scene; it is not changed.
            rho: Ratio of Gaussians to keep, in (0, 1].
            count: Number of Gaussians to keep, instead of ``rho``.
            cameras: From where presets that look at the scene do so; None finds views.
            keep: Mask of Gaussians that are kept as they are; they count, and come first.

        Returns:
            A scene of exactly ``ceil(rho * N)`` (or ``count``) Gaussians; fewer only if so many
            rows are invalid. With ``rho = 1``, the scene's own valid rows.

        Raises:
            InvalidArgumentError: Ratio or count is out of range, or both or neither are given.
            InvalidSceneError: The scene has no valid row.
        """
        return self.run(scene, rho, count=count, cameras=cameras, keep=keep).scene

    def run(
        self,
        scene: GaussianScene,
        rho: float | None = None,
        *,
        count: int | None = None,
        cameras: Cameras | None = None,
        keep: Bool[Tensor, "n"] | None = None,
    ) -> Simplified:
        """Make a scene smaller, and report.

        Args:
            scene: The scene; it is not changed.
            rho: Ratio of Gaussians to keep, in (0, 1].
            count: Number of Gaussians to keep, instead of ``rho``.
            cameras: From where presets that look at the scene do so; None finds views.
            keep: Mask of Gaussians that are kept as they are; they count, and come first.

        Returns:
            The scene and the report.

        Raises:
            InvalidArgumentError: Ratio or count is out of range, or both or neither are given.
            InvalidSceneError: The scene has no valid row.
        """
        return self.prepare(scene, cameras=cameras).run(rho, count=count, keep=keep)

    def prepare(self, scene: GaussianScene, *, cameras: Cameras | None = None) -> Prepared:
        """Get ready to make a scene smaller again and again, for a slider or a search.

        What does not depend on the number of Gaussians is done in the first run only.

        Args:
            scene: The scene; it is not changed, and must not be while this is used.
            cameras: From where presets that look at the scene do so; None finds views.

        Returns:
            What runs.

        Example:
            >>> from cvtgs.synthetic import scene as make
            >>> prepared = Simplifier(device="cpu").prepare(make("object", 1000))
            >>> [len(prepared.run(count=count).scene) for count in (10, 20)]
            [10, 20]
        """

        def reported(small: GaussianScene, facts: dict[str, Any], clock: StageClock) -> Simplified:
            return self._reported(scene, small, facts, clock, cameras)

        return Prepared(
            scene,
            self._stages(scene, cameras),
            clock=lambda: self._clock(scene),
            reported=reported,
        )

    def levels(
        self,
        scene: GaussianScene,
        rhos: Sequence[float],
        *,
        cameras: Cameras | None = None,
    ) -> tuple[Level, ...]:
        """Make a scene smaller in several sizes, in little more time than the finest takes.

        The finest size is what :meth:`run` gives, bit for bit. Cells of a coarser one consist of
        whole cells of the finest, where it is at least four times as coarse.

        Args:
            scene: The scene; it is not changed.
            rhos: Ratios of Gaussians to keep, in (0, 1], in any order.
            cameras: From where presets that look at the scene do so; None finds views.

        Returns:
            One level per ratio, in the order of the ratios; each of exactly ``ceil(rho * N)``.

        Raises:
            InvalidArgumentError: A ratio is out of range, or there is none.
            InvalidSceneError: The scene has no valid row.

        Example:
            >>> from cvtgs.synthetic import scene as make
            >>> levels = Simplifier(device="cpu").levels(make("object", 1000), [0.1, 0.01])
            >>> [len(level.scene) for level in levels]
            [100, 10]
        """
        targets = {target_count(len(scene), rho) for rho in rhos}
        if not targets:
            raise InvalidArgumentError("levels need at least one ratio, found none.")
        sizes = run_levels(
            self._stages(scene, cameras),
            sorted(targets, reverse=True),
            clock=lambda: self._clock(scene),
        )
        found = {}
        for target, size in zip(sorted(targets, reverse=True), sizes, strict=True):
            facts = size.facts | {"target_count": target}
            whole = self._reported(scene, size.scene, facts, size.clock, cameras)
            found[target] = Level(*whole, size.geometric_error, size.nested)
        return tuple(found[target_count(len(scene), rho)] for rho in rhos)

    def _stages(self, scene: GaussianScene, cameras: Cameras | None) -> PreparedScene:
        device = self._device_for(scene)
        ours = limited(scene, self.config.effects).to(device)
        net = self._net_for(scene, device)
        return PreparedScene(ours, self.config, net=net, cameras=cameras)

    def _clock(self, scene: GaussianScene) -> StageClock:
        return StageClock(self._listener, self._device_for(scene))

    def _reported(
        self,
        scene: GaussianScene,
        small: GaussianScene,
        facts: dict[str, Any],
        clock: StageClock,
        cameras: Cameras | None,
    ) -> Simplified:
        report = SimplifyReport(
            input_count=len(scene),
            output_count=len(small),
            rho=facts["target_count"] / len(scene),
            device=str(small.device),
            checkpoint="none" if self.checkpoint is None else self.checkpoint.name,
            config=self.config,
            stages=tuple(clock.costs),
            **facts,
        )
        whole = restored(small, scene, facts["plan"])
        simplified = Simplified(whole.to(scene.device), report)
        if not self.config.refine.enabled or len(small) == len(scene):
            return simplified
        return self._refined(simplified, scene, cameras)

    def _refined(
        self, simplified: Simplified, full: GaussianScene, cameras: Cameras | None
    ) -> Simplified:
        from cvtgs.refinement import join_reports, refine  # noqa: PLC0415 (most never need it)

        plan, choices = simplified.report.plan, self.config.effects
        ours, theirs = (limited(scene, choices) for scene in (simplified.scene, full))
        if plan is not None:
            used = imaged if simplified.report.kept_count else trimmed
            ours, theirs = used(ours, plan), used(theirs, plan)
        refined = refine(
            ours,
            theirs,
            cameras=cameras,
            config=self.config.refine,
            seed=self.config.seed,
            device=simplified.report.device,
            frozen=simplified.report.kept_count,
            listener=self._listener,
        )
        small = refined.scene if plan is None else restored(refined.scene, full, plan)
        return Simplified(small, join_reports(simplified.report, refined))

    def _net_for(self, scene: GaussianScene, device: torch.device) -> MergeNet | None:
        if self.checkpoint is None:
            return None
        net = copy.deepcopy(self.checkpoint.net)
        return net.to(device=device, dtype=scene.dtype)

    def _device_for(self, scene: GaussianScene) -> torch.device:
        return chosen_device(self._device or "auto", scene.device)


def _checkpoint(
    ckpt: str | os.PathLike[str] | None, config: SimplifyConfig | None
) -> Checkpoint | None:
    if ckpt is None:
        return None
    if config is not None and not config.merge.network:
        if ckpt == "auto":
            return None
        raise ConfigError(
            f"merge.network is false, so ckpt must be None or auto; found {os.fspath(ckpt)!r}."
        )
    if ckpt == "auto":
        preset = "standard" if config is None else config.preset
        return load_checkpoint(preset if preset in SHIPPED else "standard")
    return load_checkpoint(ckpt)
