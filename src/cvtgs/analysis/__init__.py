"""What a scene is like: frame, areas, visibility, and the effects that it calls for."""

from cvtgs.analysis.analyze import SceneAnalysis, analyze, apparent_areas, measure_visibility
from cvtgs.analysis.columns import (
    drop_mip_tag,
    drop_unused_bands,
    restore_columns,
    select_columns,
)
from cvtgs.analysis.effects import (
    BAND_LOSS,
    DUPLICATE_SHARE,
    FULLY_UNBOUNDED_SHARE,
    UNBOUNDED_DISTANCE,
    UNBOUNDED_SHARE,
    BandsEffect,
    Effect,
    EffectPlan,
    GradedEffect,
    band_losses,
    duplicate_share,
    far_share,
    plan_effects,
    plan_haze,
)
from cvtgs.analysis.visibility import (
    add_depths,
    ambient_visibility,
    empty_depth_grid,
    perspective_falloff,
    visibility_at,
    visibility_grid,
)

__all__ = [
    "BAND_LOSS",
    "DUPLICATE_SHARE",
    "FULLY_UNBOUNDED_SHARE",
    "UNBOUNDED_DISTANCE",
    "UNBOUNDED_SHARE",
    "BandsEffect",
    "Effect",
    "EffectPlan",
    "GradedEffect",
    "SceneAnalysis",
    "add_depths",
    "ambient_visibility",
    "analyze",
    "apparent_areas",
    "band_losses",
    "drop_mip_tag",
    "drop_unused_bands",
    "duplicate_share",
    "empty_depth_grid",
    "far_share",
    "measure_visibility",
    "perspective_falloff",
    "plan_effects",
    "plan_haze",
    "restore_columns",
    "select_columns",
    "visibility_at",
    "visibility_grid",
]
