"""Configurations: frozen, from presets, TOML files and single settings."""

from cvtgs.config.base import Section, explain, read_toml
from cvtgs.config.presets import PRESETS
from cvtgs.config.sections import FilterConfig, MergeConfig, TessellationConfig
from cvtgs.config.simplify import SimplifyConfig

__all__ = [
    "PRESETS",
    "FilterConfig",
    "MergeConfig",
    "Section",
    "SimplifyConfig",
    "TessellationConfig",
    "explain",
    "read_toml",
]
