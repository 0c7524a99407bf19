"""Analysis of a scene: frame, areas, visibility, and the effects that it calls for."""

from cvtgs.analysis.analyze import (
    SceneAnalysis,
    analyze,
    drop_unused_bands,
    restore_columns,
)
from cvtgs.analysis.effects import (
    BandsEffect,
    Effect,
    EffectPlan,
    GradedEffect,
    plan_effects,
)
from cvtgs.analysis.visibility import (
    ambient_visibility,
    perspective_falloff,
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
