"""CostModel: what a simplification costs, before it is done."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import pydantic

from cvtgs.budget.fit import fit_rates
from cvtgs.budget.work import NETWORK, REFINE, VISIBILITY, Work
from cvtgs.config import SimplifyConfig
from cvtgs.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """What one simplification cost.

    Attributes:
        work: Its size.
        config: Its configuration.
        seconds: Wall-clock seconds by stage.
    """

    work: Work
    config: SimplifyConfig
    seconds: Mapping[str, float]


class CostModel(pydantic.BaseModel):
    """What presets cost on one machine: seconds = sum of rates times amounts, stage by stage.

    Attributes:
        rates: Seconds per unit, by preset, stage and feature.
        starts: Seconds that the first simplification of a process takes on top, by preset:
            libraries are loaded.
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rates: dict[str, dict[str, dict[str, pydantic.NonNegativeFloat]]]
    starts: dict[str, pydantic.NonNegativeFloat] = {}

    @classmethod
    def fit(
        cls,
        measured: Mapping[str, Sequence[Measurement]],
        starts: Mapping[str, float] | None = None,
    ) -> Self:
        """Fit the rates to measurements.

        Args:
            measured: Measurements of simplifications of different sizes, by preset.
            starts: Seconds that the first simplification of a process takes on top.

        Returns:
            The model.
        """
        rates = {preset: _fit(some) for preset, some in measured.items()}
        return cls(rates=rates, starts=dict(starts or {}))

    @property
    def presets(self) -> tuple[str, ...]:
        """The presets that it knows."""
        return tuple(self.rates)

    def stage_seconds(
        self, preset: str, work: Work, *, config: SimplifyConfig | None = None
    ) -> dict[str, float]:
        """Predict what each stage costs.

        A stage that the preset has not, but the configuration asks for, costs what it costs in
        the best preset that has it.

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
        known = {stage: rates for name in self.rates for stage, rates in self.rates[name].items()}
        optional = _optional_stages(config)
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
        """Predict what a simplification costs.

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


def _optional_stages(config: SimplifyConfig) -> dict[str, bool]:
    """Report which of the stages that not every simplification has a configuration asks for."""
    return {
        VISIBILITY: config.uses_renders,
        NETWORK: config.merge.network,
        REFINE: config.refine.enabled,
    }


def _fit(measured: Sequence[Measurement]) -> dict[str, dict[str, float]]:
    stages = dict.fromkeys(stage for one in measured for stage in one.seconds)
    return {
        stage: fit_rates(
            [one.work.features(stage, one.config) for one in measured],
            [one.seconds.get(stage, 0.0) for one in measured],
        )
        for stage in stages
    }
