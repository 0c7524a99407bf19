"""Analysis of a scene: frame, areas, visibility, and the effects that it calls for."""

from cvtgs.analysis.analyze import SceneAnalysis, ambient_visibility, analyze, perspective_falloff
from cvtgs.analysis.effects import (
    BandsEffect,
    Effect,
    EffectPlan,
    GradedEffect,
    drop_unused_bands,
    plan_effects,
    restore_columns,
)

__all__ = [
    "BandsEffect",
    "Effect",
    "EffectPlan",
    "GradedEffect",
    "SceneAnalysis",
    "ambient_visibility",
    "analyze",
    "drop_unused_bands",
    "perspective_falloff",
    "plan_effects",
    "restore_columns",
]
