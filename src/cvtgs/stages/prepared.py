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
        """Return the valid rows."""
        if self._valid is None:
            with clock.stage("check"):
                self._valid, self._checked = check_rows(self.scene)
        return self._valid

    def outlook(self, clock: StageClock) -> Outlook:
        """Return what is known of the valid rows."""
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
        """Return what the report says about invalid rows."""
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
        """Run the stages."""
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
