"""The public entry points of a simplification; :mod:`cvtgs.pipeline` has its stages."""

import os
from collections.abc import Sequence

import torch

from cvtgs.boxes import MaskLike
from cvtgs.cameras import Cameras
from cvtgs.clock import check_listener
from cvtgs.config import SimplifyConfig
from cvtgs.devices import chosen_device
from cvtgs.errors import InvalidArgumentError
from cvtgs.mergenet.checkpoint import Checkpoint, checkpoint_for
from cvtgs.prepared import Prepared
from cvtgs.progress import ProgressListener, silent
from cvtgs.report import Level, Simplified
from cvtgs.scene import GaussianScene, SceneLike, as_scene
from cvtgs.text import shown
from cvtgs.views import find_own_cameras


class Simplifier:
    """A simplifier: N Gaussians in, exactly ``ceil(rho * N)`` standard Gaussians out.

    Args:
        ckpt: MergeNet checkpoint: ``standard`` or ``paper``, which come with the package, or a
            file. ``auto`` takes the shipped one that fits the preset of the configuration;
            None or ``none`` merges by moments alone. A network corrects the cells of the preset
            that it was trained on; with a configuration of another one, results are untested.
        config: A configuration, or the name of a preset; None takes the preset of the checkpoint.
        preset: The name of a preset, instead of a configuration.
        device: Any torch device, or ``auto``: the device of the scene, but CUDA, if available, for
            a scene on the CPU. The result is on the device of the scene.
        listener: Called with progress events.

    Raises:
        CheckpointError: The checkpoint cannot be used.
        ConfigError: There is no such preset, or it has no network but a checkpoint is given.
        DeviceError: The device cannot be used.
        InvalidArgumentError: An argument has another type, or both preset and config are given.

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
        preset: str | None = None,
        device: str | torch.device = "auto",
        listener: ProgressListener = silent,
    ) -> None:
        check_listener(listener)
        chosen = _chosen_config(config, preset)
        self.checkpoint: Checkpoint | None = checkpoint_for(ckpt, chosen)
        self.config: SimplifyConfig = chosen or SimplifyConfig(
            preset="standard" if self.checkpoint is None else self.checkpoint.info.preset
        )
        self._device = None if device == "auto" else chosen_device(device)
        self._listener = listener

    def __repr__(self) -> str:
        name = "none" if self.checkpoint is None else self.checkpoint.name
        where = self._device or "auto"
        return f"Simplifier(preset {self.config.preset}, checkpoint {name}, device {where})"

    def simplify(
        self,
        scene: SceneLike,
        rho: float | None = None,
        *,
        count: int | None = None,
        max_count: int | None = None,
        cameras: Cameras | None = None,
        keep: MaskLike | None = None,
    ) -> GaussianScene:
        """Simplify a scene.

        Args:
            scene: The scene, which is not changed, or the path of its file or folder.
            rho: Ratio of Gaussians to keep, in (0, 1].
            count: Number of Gaussians to keep, instead of ``rho``.
            max_count: Maximum number to keep; a smaller scene is not reduced.
            cameras: Cameras for presets that render the scene; None finds or generates views.
            keep: Mask of Gaussians to keep unchanged: a tensor, an array or a list of bools. They
                count towards the target and come first.

        Returns:
            A scene of exactly ``ceil(rho * N)`` (or the count) Gaussians; fewer only if invalid
            rows leave fewer. With ``rho = 1``, the scene's own valid rows, in its memory.

        Raises:
            InvalidArgumentError: Ratio or count is out of range, or not exactly one is given.
            InvalidSceneError: The scene has no valid row.
            InputError, FileFormatError: A path cannot be read, as for :func:`cvtgs.load`.
        """
        prepared = self.prepare(scene, cameras=cameras)
        return prepared.run(rho, count=count, max_count=max_count, keep=keep).scene

    def run(
        self,
        scene: SceneLike,
        rho: float | None = None,
        *,
        count: int | None = None,
        max_count: int | None = None,
        cameras: Cameras | None = None,
        keep: MaskLike | None = None,
    ) -> Simplified:
        """Simplify a scene, and report; arguments and errors as for :meth:`simplify`.

        Returns:
            The scene and the report.
        """
        return self.prepare(scene, cameras=cameras).run(
            rho, count=count, max_count=max_count, keep=keep
        )

    def levels(
        self, scene: SceneLike, rhos: Sequence[float], *, cameras: Cameras | None = None
    ) -> tuple[Level, ...]:
        """Simplify a scene to several levels, in less time than separate runs.

        Every level equals the result of :meth:`run` at its ratio, bit for bit; what does not depend
        on the ratio is computed once.

        Args:
            scene: The scene, which is not changed, or the path of its file or folder.
            rhos: Ratios of Gaussians to keep, in (0, 1], in any order.
            cameras: Cameras for presets that render the scene; None finds or generates views.

        Returns:
            One level per ratio, in the order of the ratios, of exactly ``ceil(rho * N)`` Gaussians.

        Raises:
            InvalidArgumentError: A ratio is out of range, or there is none.
            InvalidSceneError: The scene has no valid row.

        Example:
            >>> from cvtgs.synthetic import scene as make
            >>> levels = Simplifier(device="cpu").levels(make("object", 1000), [0.1, 0.01])
            >>> [len(level.scene) for level in levels]
            [100, 10]
        """
        return self.prepare(scene, cameras=cameras).levels(rhos)

    def prepare(self, scene: SceneLike, *, cameras: Cameras | None = None) -> Prepared:
        """Prepare a scene to be simplified repeatedly, for a slider or a search.

        Steps that do not depend on the target count run once only.

        Args:
            scene: The scene, which is not changed and must not be modified while the result is in
                use, or the path of its file or folder.
            cameras: Cameras for presets that render the scene; None takes those beside the file or
                in the folder (:func:`cvtgs.views.find_own_cameras`), or else generates views.

        Returns:
            The prepared scene.

        Raises:
            InvalidArgumentError: It is neither a scene nor a path, or ``cameras`` are none.

        Example:
            >>> from cvtgs.synthetic import scene as make
            >>> prepared = Simplifier(device="cpu").prepare(make("object", 1000))
            >>> [len(prepared.run(count=count).scene) for count in (10, 20)]
            [10, 20]
        """
        full = as_scene(scene)
        if cameras is None and not isinstance(scene, GaussianScene) and self.config.uses_images:
            own = find_own_cameras(full, scene)
            cameras = None if own is None else own.cameras
        return Prepared(
            full,
            self.config,
            checkpoint=self.checkpoint,
            device=self._device,
            cameras=cameras,
            listener=self._listener,
        )


def _chosen_config(
    config: SimplifyConfig | str | None, preset: str | None
) -> SimplifyConfig | None:
    if preset is not None and config is not None:
        raise InvalidArgumentError("give either preset or config, found both.")
    if preset is not None:
        return SimplifyConfig(preset=preset)
    if isinstance(config, str):
        return SimplifyConfig(preset=config)
    if config is None:
        return None
    if isinstance(config, SimplifyConfig):  # pydantic's model_copy checks nothing
        return SimplifyConfig.from_mapping(config.model_dump(warnings=False))
    raise InvalidArgumentError(
        f"config must be a SimplifyConfig or the name of a preset, found {shown(config)}."
    )


def simplify(
    scene: SceneLike,
    rho: float | None = None,
    *,
    count: int | None = None,
    max_count: int | None = None,
    preset: str = "standard",
    device: str | torch.device = "auto",
) -> GaussianScene:
    """Simplify a scene.

    :class:`cvtgs.Simplifier` does the same, with more options and a report.

    Args:
        scene: The scene, or the path of a file or folder that :func:`cvtgs.load` reads.
        rho: Ratio of Gaussians to keep, in (0, 1].
        count: Number of Gaussians to keep, instead of ``rho``.
        max_count: Maximum number to keep; a smaller scene is not reduced.
        preset: Name of the preset, from ``draft``, the fastest, to ``high``, the best.
        device: Device to compute on, as for :class:`cvtgs.Simplifier`.

    Returns:
        A scene of exactly ``ceil(rho * N)`` (or the count) Gaussians; fewer only if invalid rows
        leave fewer.

    Raises:
        InputError: The file is missing (:class:`cvtgs.errors.InputNotFoundError`) or unreadable.
        FileFormatError: The file violates its format.
        ConfigError: There is no such preset.
        DeviceError: The device cannot be used.
        InvalidArgumentError: Ratio or count is out of range, or not exactly one is given.
        InvalidSceneError: The scene has no valid row.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> len(simplify(make("object", 1000), 0.01, device="cpu"))
        10
    """
    simplifier = Simplifier(preset=preset, device=device)
    return simplifier.simplify(scene, rho, count=count, max_count=max_count)
