"""Simplify a scene or a file of one in a single call."""

import torch

from cvtgs.scene import GaussianScene, SceneLike
from cvtgs.simplifier import Simplifier

__all__ = ["simplify"]


def simplify(
    scene: SceneLike,
    rho: float | None = None,
    *,
    count: int | None = None,
    max_count: int | None = None,
    preset: str = "standard",
    device: str | torch.device = "auto",
) -> GaussianScene:
    """Make a scene smaller.

    :class:`cvtgs.Simplifier` does the same, with more choices and a report.

    Args:
        scene: The scene, or a file or folder that :func:`cvtgs.load` reads.
        rho: Ratio of Gaussians to keep, in (0, 1].
        count: Number of Gaussians to keep, instead of ``rho``.
        max_count: Number to keep if there are more; a smaller scene stays as it is.
        preset: Name of the preset, from ``draft``, the fastest, to ``max``, the best.
        device: Where to compute, as for :class:`cvtgs.Simplifier`.

    Returns:
        A scene of exactly ``ceil(rho * N)`` (or the count) Gaussians; fewer only if so many rows
        are invalid.

    Raises:
        InputError: The file cannot be read.
        FileFormatError: The file is not what its format promises.
        ConfigError: There is no such preset.
        InvalidArgumentError: Ratio or count is out of range, or not exactly one is given.
        InvalidSceneError: The scene has no valid row.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> len(simplify(make("object", 1000), 0.01, device="cpu"))
        10
    """
    simplifier = Simplifier(preset=preset, device=device)
    return simplifier.simplify(scene, rho, count=count, max_count=max_count)
