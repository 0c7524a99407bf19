"""CostModel, which predicts the seconds of a simplification from size and configuration."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pydantic

from cvtgs.cells.partition import MOST_SAMPLED
from cvtgs.config import SimplifyConfig
from cvtgs.config.base import Record, explain, named
from cvtgs.counts import checked_whole, whole_number
from cvtgs.cvt.tessellate import MIN_SAMPLES
from cvtgs.errors import InvalidArgumentError
from cvtgs.grouping import finer_count
from cvtgs.scene import GaussianScene
from cvtgs.text import shown

CHECK, PLAN = "check", "plan"
VISIBILITY, NETWORK, MATCH, REFINE = "visibility", "network", "match", "refine"

FEATURES: Mapping[str, tuple[str, ...]] = {  # of each stage; its seconds are linear in them
    "check": ("in", "in_values"),
    "plan": ("once", "in"),
    "filter": ("in",),
    "weigh": ("once", "in"),
    "tessellate": ("once", "in", "search"),
    "allocate": ("once", "in", "pairs"),
    "merge": ("once", "in", "in_values", "out", "out_values"),
    VISIBILITY: ("once", "view_pixels", "views_in"),
    MATCH: ("once", "view_pixels", "view_pairs", "view_values"),
    REFINE: ("once", "images_in", "looks", "look_pixels", "looks_out"),
    NETWORK: ("once", "in", "sampled", "sampled_values", "out", "out_values"),
}

GROUPING = ("filter", "weigh", "tessellate", "allocate", "merge", NETWORK)
"""Stages that run twice with given cameras, by whose images cells are allocated again."""

OTHER_FEATURES = ("once", "in", "out")  # features of all other stages
SHARE_OF_A_STEP = 0.2  # cost of rendering an image without gradients, as a share of a step
STEPS_OF_A_BATCH = 8.0  # cost of generating one batch of views of any size, in steps
LEAST_SECONDS = 2e-3  # floor of measured seconds in the relative errors of a fit
PRIOR_WEIGHT = 0.3  # weight of each prior rate in a fit, in measurements
COLORS = tuple(3 * (degree + 1) ** 2 for degree in range(4))


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """The size of a simplification.

    Attributes:
        count: Number of input Gaussians, N.
        target: Number of output Gaussians, M.
        colors: Number of colour coefficients of a Gaussian: 3, 12, 27 or 48.

    Raises:
        InvalidArgumentError: A number is out of range or no whole number.
    """

    count: int
    target: int
    colors: int = 3

    def __post_init__(self) -> None:
        checked_whole(self.count, "count")
        checked_whole(self.target, "target", most=self.count, things="Gaussians of the input")
        if whole_number(self.colors) not in COLORS:
            raise InvalidArgumentError(
                f"colors must be 3, 12, 27 or 48, found {shown(self.colors)}."
            )

    @classmethod
    def of(cls, scene: GaussianScene, target: int) -> Self:
        """Return the size of the simplification of a scene to a target count.

        Example:
            >>> from cvtgs.synthetic import scene as make
            >>> Work.of(make("object", 100, sh_degree=1), 10)
            Work(count=100, target=10, colors=12)
        """
        return cls(count=len(scene), target=target, colors=3 * (scene.sh_degree + 1) ** 2)

    def features(self, stage: str, config: SimplifyConfig) -> dict[str, float]:
        """Return the feature amounts of a stage by name; its seconds are linear in them."""
        cells = finer_count(self.target, self.count, config.allocation)
        described = min(self.count, MOST_SAMPLED * self.target)
        sample = config.cvt.samples_per_site * cells
        sample = max(sample, MIN_SAMPLES) if sample else self.count
        sample = self.count if sample >= self.count // 2 else sample
        searched = 0 if cells == self.count else self.count + config.cvt.iterations * sample
        visibility, refine = config.visibility, config.refine.for_count(self.target)
        shared = visibility.views if config.shares_images else 0
        heldout = refine.heldout_of(shared) if shared else refine.heldout
        new_images = refine.new_images(refine.steps, shared=shared)
        batches = math.ceil(new_images / refine.batch) + (not shared)
        checks = 1 + math.ceil(refine.steps / refine.check_every)
        drawn = refine.steps * refine.images_per_step
        others = SHARE_OF_A_STEP * heldout * checks + STEPS_OF_A_BATCH * batches
        looks, whole_images = drawn + others, drawn / refine.thinning(self.target) ** 2 + others
        side = visibility.size / visibility.stride
        amounts = {
            "once": 1.0,
            "in": float(self.count),
            "in_values": float(self.count * self.colors),
            # Members that the network sees: of large cells only some.
            "sampled": float(described),
            "sampled_values": float(described * self.colors),
            "out": float(self.target),
            "out_values": float(self.target * self.colors),
            "view_pixels": float(visibility.views * side**2),
            "views_in": float(visibility.views * self.count),
            # Pairs of a pixel and a Gaussian: with more Gaussians, they are smaller and occluded.
            "view_pairs": visibility.views * side * math.sqrt(self.target),
            "view_values": float(visibility.views * self.target * self.colors),
            "images_in": float((0 if shared else heldout) + new_images) * self.count,
            "looks": looks,
            "look_pixels": whole_images * (refine.size / refine.stride) ** 2,
            "looks_out": looks * self.target,
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
    """The cost of simplifications on one machine: seconds = sum of rates times amounts, by stage.

    Attributes:
        rates: Seconds per unit, by stage and feature; they hold for all presets, since the amounts
            follow from the configuration.
        start: Additional seconds of the first simplification of a process, for loading libraries.
        image_start: The same for libraries that only configurations with images need.
        trials: Seconds of the trials of a calibration, by name of the trial and by stage.

    Raises:
        InvalidArgumentError: A value is negative or not finite, or a stage has no such feature.
    """

    rates: dict[str, dict[str, pydantic.NonNegativeFloat]]
    start: pydantic.NonNegativeFloat = 0.0
    image_start: pydantic.NonNegativeFloat = 0.0
    trials: dict[str, dict[str, pydantic.NonNegativeFloat]] = pydantic.Field(default_factory=dict)

    def __init__(self, /, **values: Any) -> None:
        try:
            super().__init__(**values)
        except pydantic.ValidationError as error:
            raise InvalidArgumentError(f"cost model: {explain(error)}") from None

    # Models in cache files are checked without a call of __init__, so damaged ones are replaced.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @pydantic.model_validator(mode="after")
    def _of_known_features(self) -> Self:
        for stage, rates in self.rates.items():
            known = FEATURES.get(stage, OTHER_FEATURES)
            for name in rates:
                if name not in known:
                    raise ValueError(
                        f"rates.{named(stage)} must be of {', '.join(known)}; found {shown(name)}"
                    )
        return self

    @classmethod
    def fit(
        cls,
        measured: Sequence[Measurement],
        *,
        prior: Self | None = None,
        start: float = 0.0,
        image_start: float = 0.0,
    ) -> Self:
        """Fit the rates to measurements of different sizes and configurations.

        Args:
            measured: The measurements.
            prior: Rates of another machine, whose ratios to one another hold where the
                measurements leave them open; None if there are enough measurements.
            start: As of the class.
            image_start: As of the class.
        """
        rates = {} if prior is None else dict(prior.rates)
        for stage in dict.fromkeys(stage for one in measured for stage in one.seconds):
            having = [one for one in measured if stage in one.seconds]
            rates[stage] = fit_rates(
                [one.work.features(stage, one.config) for one in having],
                [one.seconds[stage] for one in having],
                prior=rates.get(stage),
            )
        return cls(rates=rates, start=start, image_start=image_start)

    def stage_seconds(
        self, work: Work, config: SimplifyConfig, *, with_cameras: bool = False
    ) -> dict[str, float]:
        """Predict the cost of each stage that a configuration has.

        Args:
            work: Size of the simplification.
            config: Configuration of the simplification.
            with_cameras: Whether cameras are given: by their images, cells are allocated twice.

        Returns:
            Wall-clock seconds by stage; a scene that stays whole is only checked and analysed.
        """
        is_whole = work.target >= work.count
        optional = {
            VISIBILITY: config.uses_renders,
            NETWORK: config.merge.network,
            MATCH: config.uses_renders and config.match.enabled,
            REFINE: config.refine.enabled,
        }
        seconds = {}
        for stage, rates in self.rates.items():
            if stage in (CHECK, PLAN) or (not is_whole and optional.get(stage, True)):
                amounts = work.features(stage, config)
                seconds[stage] = sum(rate * amounts[name] for name, rate in rates.items())
        limit = config.refine.seconds
        if REFINE in seconds and limit:
            seconds[REFINE] = min(seconds[REFINE], limit) if config.refine.steps else limit
        allocates_again = with_cameras and config.uses_renders and config.match.error_power > 0
        if allocates_again and not is_whole:
            seconds |= {stage: 2 * seconds[stage] for stage in GROUPING if stage in seconds}
            seconds["errors"] = self._seconds_of_errors(work, config)
        return seconds

    def _seconds_of_errors(self, work: Work, config: SimplifyConfig) -> float:
        """Predict the cost of images with one gradient each: that of as many in refinement."""
        visibility, rates = config.visibility, self.rates.get(REFINE, {})
        pixels = (visibility.size / visibility.stride) ** 2
        of_one = {"looks": 1.0, "look_pixels": pixels, "looks_out": float(work.target)}
        each = sum(rates.get(name, 0.0) * amount for name, amount in of_one.items())
        return visibility.views * each

    def seconds(self, work: Work, config: SimplifyConfig, *, with_cameras: bool = False) -> float:
        """Predict the cost of a simplification.

        Args:
            work: Size of the simplification.
            config: Configuration of the simplification.
            with_cameras: As for :meth:`stage_seconds`.

        Returns:
            Wall-clock seconds of the first simplification of a process, from the scene in memory
            to the small scene in memory.

        Example:
            >>> model = CostModel(rates={"check": {"in": 4e-6, "in_values": 0.0}}, start=0.5)
            >>> model.seconds(Work(count=1_000_000, target=10_000), SimplifyConfig())
            4.5
        """
        start = self.start + (self.image_start if config.uses_images else 0.0)
        stages = self.stage_seconds(work, config, with_cameras=with_cameras)
        return start + sum(stages.values())


def fit_rates(
    rows: Sequence[Mapping[str, float]],
    seconds: Sequence[float],
    *,
    prior: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Fit the rate of each feature to measured seconds; a prior takes part in ridge regression."""
    # Non-negative least squares (Lawson and Hanson 1974) of relative errors: since no rate is
    # negative, no prediction for more work is below one for less.
    from scipy.optimize import nnls  # noqa: PLC0415 (heavy, and only for a calibration)

    names = list(rows[0])
    amounts = np.array([[row[name] for name in names] for row in rows], dtype=np.float64)
    measured = np.array(seconds, dtype=np.float64)
    weights = 1 / np.maximum(measured, LEAST_SECONDS)
    scales = 1 / np.maximum(amounts.max(axis=0), 1e-300)
    if prior is not None:
        scales = np.array([prior.get(name, 0.0) for name in names])
    table, wanted = amounts * scales * weights[:, None], measured * weights
    if prior is not None:
        predicted = np.maximum(amounts @ scales, 1e-300)
        factor = np.exp(np.mean(np.log(np.maximum(measured, LEAST_SECONDS) / predicted)))
        pull = math.sqrt(PRIOR_WEIGHT) / factor
        table = np.concatenate([table, pull * np.eye(len(names))])
        wanted = np.concatenate([wanted, np.full(len(names), pull * factor)])
    rates, _ = nnls(table, wanted)
    return dict(zip(names, (rates * scales).tolist(), strict=True))
