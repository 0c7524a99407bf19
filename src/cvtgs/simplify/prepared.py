"""Prepared: a scene to be made smaller again and again."""

from collections.abc import Callable
from typing import Any

from jaxtyping import Bool
from torch import Tensor

from cvtgs.counts import target_count
from cvtgs.report import StageClock
from cvtgs.scene import GaussianScene
from cvtgs.simplify.results import Simplified
from cvtgs.stages import PreparedScene, run_protected


class Prepared:
    """A scene and a way to simplify it; what does not depend on the count is done only once.

    :meth:`cvtgs.simplify.Simplifier.prepare` makes these. Every run gives the bits of
    :meth:`cvtgs.simplify.Simplifier.run`; the report of the first one has the stages that are
    shared.

    Args:
        scene: The scene as it came.
        stages: The same on the device to compute on.
        clock: Gives a clock for every run.
        reported: Makes the result, of a small scene, facts about it, and what it cost.
    """

    def __init__(
        self,
        scene: GaussianScene,
        stages: PreparedScene,
        *,
        clock: Callable[[], StageClock],
        reported: Callable[[GaussianScene, dict[str, Any], StageClock], Simplified],
    ) -> None:
        self._scene, self._stages, self._clock, self._reported = scene, stages, clock, reported

    def run(
        self,
        rho: float | None = None,
        *,
        count: int | None = None,
        keep: Bool[Tensor, "n"] | None = None,
    ) -> Simplified:
        """Make the scene smaller, and report.

        Args:
            rho: Ratio of Gaussians to keep, in (0, 1].
            count: Number of Gaussians to keep, instead of ``rho``.
            keep: Mask of Gaussians that are kept as they are; they count, and come first.

        Returns:
            The scene and the report.

        Raises:
            InvalidArgumentError: Ratio or count is out of range, or both or neither are given.
            InvalidSceneError: The scene has no valid row.
        """
        target, clock = target_count(len(self._scene), rho, count=count), self._clock()
        if keep is None:
            small, facts = self._stages.run(target, clock=clock)
        else:
            small, facts = run_protected(self._stages, target, keep=keep, clock=clock)
        return self._reported(small, facts | {"target_count": target}, clock)
