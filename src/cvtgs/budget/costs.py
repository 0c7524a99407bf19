"""CostModel, which predicts the seconds of a simplification from size and configuration."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import pydantic

from cvtgs.config import SimplifyConfig
from cvtgs.config.base import Record
from cvtgs.cvt.tessellate import MIN_SAMPLES
from cvtgs.errors import ConfigError
from cvtgs.grouping import finer_count
from cvtgs.scene import GaussianScene

VISIBILITY, NETWORK, MATCH, REFINE = "visibility", "network", "match", "refine"

FEATURES: Mapping[str, tuple[str, ...]] = {
    "check": ("in", "in_values"),
    "plan": ("once", "in"),
    "filter": ("in",),
    "tessellate": ("once", "in", "search", "pairs"),
    "merge": ("once", "in", "in_values", "out", "out_values"),
    VISIBILITY: ("once", "view_pixels", "views_in"),
    MATCH: ("once", "view_pixels", "view_pairs", "view_values"),
    REFINE: ("images_in", "look_pixels", "looks_out"),
    NETWORK: ("once", "in", "in_values", "out", "out_values"),
}
"""Features of each stage; its seconds are linear in their amounts."""

OTHER_FEATURES = ("once", "in", "out")
"""Features of all other stages."""

SHARE_OF_A_STEP = 0.2
"""Cost of rendering an image without gradients, as a share of a step."""

STEPS_OF_A_BATCH = 8.0
"""Cost of generating one batch of views of any size, in steps."""

LEAST_SECONDS = 2e-3
"""Floor of measured seconds in the relative errors of a fit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """The size of a simplification.

    Attributes:
        count: Number of input Gaussians, N.
        target: Number of output Gaussians, M.
        colors: Number of colour coefficients of a Gaussian: 3, 12, 27 or 48.
    """

    count: int
    target: int
    colors: int = 3

    @classmethod
    def of(cls, scene: GaussianScene, target: int) -> Self:
        """Return the size of the simplification of a scene.

        Args:
            scene: The scene.
            target: Number of Gaussians to keep.

        Returns:
            The size.

        Example:
            >>> from cvtgs.synthetic import scene as make
            >>> Work.of(make("object", 100, sh_degree=1), 10)
            Work(count=100, target=10, colors=12)
        """
        return cls(count=len(scene), target=target, colors=3 * (scene.sh_degree + 1) ** 2)

    def features(self, stage: str, config: SimplifyConfig) -> dict[str, float]:
        """Return the feature amounts of a stage; its seconds are linear in them.

        Args:
            stage: Name of the stage.
            config: Configuration of the simplification.

        Returns:
            Amounts by name.
        """
        cells = finer_count(self.target, self.count, config.allocation)
        sample = config.cvt.samples_per_site * cells
        sample = max(sample, MIN_SAMPLES) if sample else self.count
        sample = self.count if sample >= self.count // 2 else sample
        searched = 0 if cells == self.count else self.count + config.cvt.iterations * sample
        visibility, refine = config.visibility, config.refine
        shared = visibility.views if config.shares_images else 0
        heldout = refine.heldout_of(shared) if shared else refine.heldout
        learned = shared - heldout if shared else 0
        new_images = refine.new_images(refine.steps, given=learned)
        batches = math.ceil(new_images / refine.batch) + (not shared)
        checks = 1 + math.ceil(refine.steps / refine.check_every)
        renders = refine.steps + SHARE_OF_A_STEP * heldout * checks
        renders += STEPS_OF_A_BATCH * batches
        side = visibility.size / visibility.stride
        amounts = {
            "once": 1.0,
            "in": float(self.count),
            "in_values": float(self.count * self.colors),
            "out": float(self.target),
            "out_values": float(self.target * self.colors),
            "view_pixels": float(visibility.views * side**2),
            "views_in": float(visibility.views * self.count),
            # Pairs of a pixel and a Gaussian: with more Gaussians, they are smaller and occluded.
            "view_pairs": visibility.views * side * math.sqrt(self.target),
            "view_values": float(visibility.views * self.target * self.colors),
            "images_in": float((0 if shared else heldout) + new_images) * self.count,
            "look_pixels": renders * (refine.size / refine.stride) ** 2,
            "looks_out": renders * self.target,
            "search": searched * math.log2(cells + 2),
            "pairs": float(cells if cells > self.target else 0),
        }
        return {name: amounts[name] for name in FEATURES.get(stage, OTHER_FEATURES)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """The cost of one simplification.

    Attributes:
        work: Size of the simplification.
        config: Configuration of the simplification.
        seconds: Wall-clock seconds by stage.
    """

    work: Work
    config: SimplifyConfig
    seconds: Mapping[str, float]


class CostModel(Record, allow_inf_nan=False):
    """The cost of presets on one machine: seconds = sum of rates times amounts, for each stage.

    Attributes:
        rates: Seconds per unit, by preset, stage and feature.
        starts: Additional seconds of the first simplification of a process, by preset, for loading
            libraries.
    """

    rates: dict[str, dict[str, dict[str, pydantic.NonNegativeFloat]]]
    starts: dict[str, pydantic.NonNegativeFloat] = pydantic.Field(default_factory=dict)

    @classmethod
    def fit(
        cls,
        measured: Mapping[str, Sequence[Measurement]],
        starts: Mapping[str, float] | None = None,
    ) -> Self:
        """Fit the rates to measurements.

        Args:
            measured: Measurements of simplifications of different sizes, by preset.
            starts: Additional seconds of the first simplification of a process, by preset.

        Returns:
            The model.
        """
        rates: dict[str, dict[str, dict[str, float]]] = {}
        for preset, some in measured.items():
            stages = dict.fromkeys(stage for one in some for stage in one.seconds)
            rates[preset] = {
                stage: fit_rates(
                    [one.work.features(stage, one.config) for one in some],
                    [one.seconds.get(stage, 0.0) for one in some],
                )
                for stage in stages
            }
        return cls(rates=rates, starts=dict(starts or {}))

    @property
    def presets(self) -> tuple[str, ...]:
        """The presets that were measured."""
        return tuple(self.rates)

    def stage_seconds(
        self, preset: str, work: Work, *, config: SimplifyConfig | None = None
    ) -> dict[str, float]:
        """Predict the cost of each stage.

        A stage that only the configuration has, but not the preset, is assumed to cost as much as
        in the best preset that has it.

        Args:
            preset: Name of the preset.
            work: Size of the simplification.
            config: The preset with other settings changed; None for the preset as it is.

        Returns:
            Wall-clock seconds by stage.

        Raises:
            ConfigError: The preset was not measured.
        """
        if preset not in self.rates:
            raise ConfigError(
                f"preset must be one of {', '.join(self.rates)}, whose cost was measured; "
                f"found {preset!r}."
            )
        config = config or SimplifyConfig.from_preset(preset)
        optional = {
            VISIBILITY: config.uses_renders,
            NETWORK: config.merge.network,
            MATCH: config.uses_renders and config.match.enabled,
            REFINE: config.refine.enabled,
        }
        known = {stage: rates for name in self.rates for stage, rates in self.rates[name].items()}
        seconds = {}
        for stage, rates in (known | self.rates[preset]).items():
            if optional.get(stage, stage in self.rates[preset]):
                amounts = work.features(stage, config)
                seconds[stage] = sum(rate * amounts[name] for name, rate in rates.items())
        limit = config.refine.seconds
        if REFINE in seconds and limit:
            seconds[REFINE] = min(seconds[REFINE], limit) if config.refine.steps else limit
        return seconds

    def seconds(self, preset: str, work: Work, *, config: SimplifyConfig | None = None) -> float:
        """Predict the cost of a simplification.

        Args:
            preset: Name of the preset.
            work: Size of the simplification.
            config: The preset with other settings changed; None for the preset as it is.

        Returns:
            Wall-clock seconds of the first simplification of a process, from the scene in memory
            to the small scene in memory.

        Raises:
            ConfigError: The preset was not measured.
        """
        stages = self.stage_seconds(preset, work, config=config)
        return self.starts.get(preset, 0.0) + sum(stages.values())


def fit_rates(rows: Sequence[Mapping[str, float]], seconds: Sequence[float]) -> dict[str, float]:
    """Fit the rate of each feature to measured seconds.

    This is non-negative least squares (Lawson and Hanson 1974) of relative errors. No rate is
    negative, so no prediction for more work is below one for less.
    """
    from scipy.optimize import nnls  # noqa: PLC0415 (heavy, and only for a calibration)

    names = list(rows[0])
    amounts = np.array([[row[name] for name in names] for row in rows], dtype=np.float64)
    measured = np.array(seconds, dtype=np.float64)
    weights = 1 / np.maximum(measured, LEAST_SECONDS)
    scales = np.maximum(amounts.max(axis=0), 1e-300)
    rates, _ = nnls(amounts / scales * weights[:, None], measured * weights)
    return dict(zip(names, (rates / scales).tolist(), strict=True))
