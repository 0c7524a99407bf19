"""Work: the size of a simplification, and what the seconds of each stage grow with."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from cvtgs.config import RefineConfig, SimplifyConfig
from cvtgs.cvt.tessellate import MIN_SAMPLES
from cvtgs.scene import GaussianScene

VISIBILITY, NETWORK, REFINE = "visibility", "network", "refine"

FEATURES: Mapping[str, tuple[str, ...]] = {
    "check": ("in", "in_values"),
    "plan": ("once", "in"),
    "filter": ("in",),
    "tessellate": ("once", "in", "search"),
    "merge": ("once", "in", "in_values", "out", "out_values"),
    VISIBILITY: ("once", "view_pixels", "views_in"),
    REFINE: ("images_in", "look_pixels", "looks_out"),
    NETWORK: ("once", "in", "in_values", "out", "out_values"),
}
"""What the seconds of a stage grow with."""

SHARE_OF_A_STEP = 0.2
"""An image without gradients costs this share of a step."""

STEPS_OF_A_BATCH = 2.0
"""To find views, however many at once, costs as much as so many steps."""

OTHER_FEATURES = ("once", "in", "out")
"""The same for stages that are not named there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """The size of a simplification.

    Attributes:
        count: Gaussians in, N.
        target: Gaussians out, M.
        colors: Colour coefficients of a Gaussian: 3, 12, 27 or 48.
    """

    count: int
    target: int
    colors: int = 3

    @classmethod
    def of(cls, scene: GaussianScene, target: int) -> Self:
        """Return the size of the simplification of a scene.

        Args:
            scene: The scene.
            target: Gaussians to keep.

        Returns:
            The size.

        Example:
            >>> from cvtgs.synthetic import scene as make
            >>> Work.of(make("object", 100, sh_degree=1), 10)
            Work(count=100, target=10, colors=12)
        """
        return cls(count=len(scene), target=target, colors=3 * (scene.sh_degree + 1) ** 2)

    def features(self, stage: str, config: SimplifyConfig) -> dict[str, float]:
        """Return the amounts that the seconds of a stage grow with.

        Args:
            stage: Name of the stage.
            config: Every choice of the simplification.

        Returns:
            Amounts by name.
        """
        looked_at = config.cvt.samples_per_site * self.target
        sample = max(looked_at, MIN_SAMPLES) if looked_at else self.count
        sample = self.count if sample >= self.count // 2 else sample
        searched = self.count + config.cvt.iterations * sample
        amounts = {
            "once": 1.0,
            "in": float(self.count),
            "in_values": float(self.count * self.colors),
            "out": float(self.target),
            "out_values": float(self.target * self.colors),
            "view_pixels": float(config.visibility.views * config.visibility.size**2),
            "views_in": float(config.visibility.views * self.count),
            **self._refinement(config.refine),
            "search": searched * math.log2(self.target + 2),
        }
        return {name: amounts[name] for name in FEATURES.get(stage, OTHER_FEATURES)}

    def _refinement(self, config: RefineConfig) -> dict[str, float]:
        """Return the images of the full scene, and the looks at the small one."""
        learnt_from = math.ceil(config.steps / config.steps_per_image)
        images = config.heldout + learnt_from
        checks = 1 + math.ceil(config.steps / config.check_every)
        batches = 1 + math.ceil(learnt_from / config.batch)
        looks = config.steps + SHARE_OF_A_STEP * config.heldout * checks
        looks += STEPS_OF_A_BATCH * batches
        return {
            "images_in": images * self.count,
            "look_pixels": looks * config.size**2,
            "looks_out": looks * self.target,
        }
