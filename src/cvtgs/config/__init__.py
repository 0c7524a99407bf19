"""Configurations: frozen, from presets, TOML files and single settings."""

from cvtgs.config.base import Section, explain, read_toml
from cvtgs.config.presets import PRESETS
from cvtgs.config.refine import Rates, RefineConfig
from cvtgs.config.sections import (
    AllocationConfig,
    EffectsConfig,
    FilterConfig,
    MatchConfig,
    MergeConfig,
    TessellationConfig,
    VisibilityConfig,
)
from cvtgs.config.simplify import SimplifyConfig

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
