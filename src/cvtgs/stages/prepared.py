"""A scene that is checked and looked at once, whatever is then made of it."""

from collections.abc import Callable
from typing import Any

from cvtgs.cameras import Cameras
from cvtgs.config import SimplifyConfig
from cvtgs.mergenet import MergeNet
from cvtgs.report import StageClock
from cvtgs.scene import GaussianScene
from cvtgs.stages.entering import check_rows
from cvtgs.stages.outlook import Outlook, look
from cvtgs.stages.run import Grouping, all_rows, run_stages


class PreparedScene:
    """A scene for several runs of the stages, which share what does not depend on the target.

    Nothing is done before it is needed, and what is done once is in the clock of the first run.

    Args:
        scene: The scene, on the device to compute on.
        config: Every choice.
        net: Corrects merged Gaussians, on the same device; None for no correction.
        cameras: From where a configuration that looks at the scene does so; None finds views.
    """

    def __init__(
        self,
        scene: GaussianScene,
        config: SimplifyConfig,
        *,
        net: MergeNet | None,
        cameras: Cameras | None = None,
    ) -> None:
        self.scene, self.config, self.net, self._cameras = scene, config, net, cameras
        self._valid: GaussianScene | None = None
        self._checked: dict[str, Any] = {}
        self._outlook: Outlook | None = None

    def valid(self, clock: StageClock) -> GaussianScene:
        """Give the valid rows.

        Args:
            clock: Measures the check, the first time.

        Returns:
            They alone.

        Raises:
            InvalidSceneError: There is none.
        """
        if self._valid is None:
            with clock.stage("check"):
                self._valid, self._checked = check_rows(self.scene)
        return self._valid

    def outlook(self, clock: StageClock) -> Outlook:
        """Give what is known of the valid rows.

        Args:
            clock: Measures the look at them, the first time.

        Returns:
            What was found.
        """
        if self._outlook is None:
            self._outlook = look(
                self.valid(clock),
                self.config,
                with_light=self.net is not None,
                clock=clock,
                cameras=self._cameras,
            )
        return self._outlook

    def facts(self, target: int) -> dict[str, Any]:
        """Give what the report says about invalid rows.

        Args:
            target: Number of Gaussians to keep.

        Returns:
            Their numbers, and why there are fewer Gaussians than asked for, if so.
        """
        if self._valid is None or not self._checked or len(self._valid) >= target:
            return self._checked
        shortfall = f"only {len(self._valid)} of {len(self.scene)} Gaussians are valid"
        return self._checked | {"shortfall": shortfall}

    def run(
        self,
        target: int,
        *,
        clock: StageClock,
        on_grouping: Callable[[Grouping], None] | None = None,
    ) -> tuple[GaussianScene, dict[str, Any]]:
        """Run the stages.

        Args:
            target: Number of Gaussians to keep.
            clock: Measures each stage.
            on_grouping: Given the cells, if there are fewer than valid Gaussians.

        Returns:
            The small scene, and the facts that :class:`cvtgs.report.SimplifyReport` holds beyond
            counts and costs.

        Raises:
            InvalidSceneError: The scene has no valid row.
        """
        valid = self.valid(clock)
        if target >= len(valid):
            is_whole = target == len(self.scene)
            small, facts = all_rows(valid, self.config, is_whole=is_whole, clock=clock)
        else:
            small, facts = run_stages(
                valid,
                target,
                self.config,
                outlook=self.outlook(clock),
                net=self.net,
                clock=clock,
                on_grouping=on_grouping,
            )
        return small, self.facts(target) | facts
