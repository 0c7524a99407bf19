"""Frozen configurations, built from presets, TOML files and single settings."""

from cvtgs.config.base import Section, explain, read_toml
from cvtgs.config.sections import (
    AllocationConfig,
    EffectsConfig,
    FilterConfig,
    MatchConfig,
    MergeConfig,
    Rates,
    RefineConfig,
    TessellationConfig,
    VisibilityConfig,
)
from cvtgs.config.simplify import PRESETS, SimplifyConfig

__all__ = [
    "PRESETS",
    "AllocationConfig",
    "EffectsConfig",
    "FilterConfig",
    "MatchConfig",
    "MergeConfig",
    "Rates",
    "RefineConfig",
    "Section",
    "SimplifyConfig",
    "TessellationConfig",
    "VisibilityConfig",
    "explain",
    "read_toml",
]
