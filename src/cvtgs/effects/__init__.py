"""What a scene calls for; what it does not call for is not computed."""

from cvtgs.effects.figures import (
    UNBOUNDED_DISTANCE,
    band_losses,
    duplicate_share,
    far_share,
)
from cvtgs.effects.limits import imaged, limited, restored, trimmed
from cvtgs.effects.plan import (
    BAND_LOSS,
    DUPLICATE_SHARE,
    FULLY_UNBOUNDED_SHARE,
    UNBOUNDED_SHARE,
    BandsEffect,
    Effect,
    EffectPlan,
    GradedEffect,
    plan_effects,
    with_haze,
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
    "band_losses",
    "duplicate_share",
    "far_share",
    "imaged",
    "limited",
    "plan_effects",
    "restored",
    "trimmed",
    "with_haze",
]
