"""Simplifier: the one call that users make."""

import copy
import math
import os
from fractions import Fraction
from typing import NamedTuple

import torch

from cvtgs.cameras import Cameras
from cvtgs.config import SimplifyConfig
from cvtgs.devices import resolve_device
from cvtgs.errors import ConfigError, InvalidArgumentError
from cvtgs.mergenet import SHIPPED, Checkpoint, MergeNet, load_checkpoint
from cvtgs.progress import ProgressListener, silent
from cvtgs.refine import join_reports, refine
from cvtgs.report import SimplifyReport, StageClock
from cvtgs.scene import GaussianScene
from cvtgs.stages import run_stages


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
    ) -> GaussianScene:
        """Make a scene smaller.

        Args:
            scene: The scene; it is not changed.
            rho: Ratio of Gaussians to keep, in (0, 1].
            count: Number of Gaussians to keep, instead of ``rho``.
            cameras: From where presets that look at the scene do so; None finds views.

        Returns:
            A scene of exactly ``ceil(rho * N)`` (or ``count``) Gaussians; fewer only if so many
            rows are invalid. With ``rho = 1``, the scene's own valid rows.

        Raises:
            InvalidArgumentError: Ratio or count is out of range, or both or neither are given.
            InvalidSceneError: The scene has no valid row.
        """
        return self.run(scene, rho, count=count, cameras=cameras).scene

    def run(
        self,
        scene: GaussianScene,
        rho: float | None = None,
        *,
        count: int | None = None,
        cameras: Cameras | None = None,
    ) -> Simplified:
        """Make a scene smaller, and report.

        Args:
            scene: The scene; it is not changed.
            rho: Ratio of Gaussians to keep, in (0, 1].
            count: Number of Gaussians to keep, instead of ``rho``.
            cameras: From where presets that look at the scene do so; None finds views.

        Returns:
            The scene and the report.

        Raises:
            InvalidArgumentError: Ratio or count is out of range, or both or neither are given.
            InvalidSceneError: The scene has no valid row.
        """
        target = target_count(len(scene), rho, count=count)
        device = self._device_for(scene)
        clock = StageClock(self._listener, device)
        small, facts = run_stages(
            scene.to(device),
            target,
            self.config,
            net=self._net_for(scene, device),
            clock=clock,
            cameras=cameras,
        )
        report = SimplifyReport(
            input_count=len(scene),
            output_count=len(small),
            target_count=target,
            rho=target / len(scene),
            device=str(device),
            checkpoint="none" if self.checkpoint is None else self.checkpoint.name,
            config=self.config,
            stages=tuple(clock.costs),
            **facts,
        )
        simplified = Simplified(small.to(scene.device), report)
        if not self.config.refine.asked_for or len(small) == len(scene):
            return simplified
        return self._refined(simplified, scene, cameras)

    def _refined(
        self, simplified: Simplified, full: GaussianScene, cameras: Cameras | None
    ) -> Simplified:
        refined = refine(
            simplified.scene,
            full,
            cameras=cameras,
            config=self.config.refine,
            seed=self.config.seed,
            device=simplified.report.device,
            listener=self._listener,
        )
        return Simplified(refined.scene, join_reports(simplified.report, refined))

    def _net_for(self, scene: GaussianScene, device: torch.device) -> MergeNet | None:
        if self.checkpoint is None:
            return None
        net = copy.deepcopy(self.checkpoint.net)
        return net.to(device=device, dtype=scene.dtype)

    def _device_for(self, scene: GaussianScene) -> torch.device:
        if self._device is not None:
            return self._device
        moves = scene.device.type == "cpu" and torch.cuda.is_available()
        return torch.device("cuda") if moves else scene.device


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
