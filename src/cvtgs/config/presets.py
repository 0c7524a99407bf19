"""Named configurations, from the fastest to the best."""

from collections.abc import Mapping
from typing import Any

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "draft": {"cvt": {"iterations": 0}, "merge": {"network": False}},
    "fast": {"merge": {"network": False}},
    "standard": {},
    "matched": {
        "visibility": {"views": 24, "size": 256},
        "match": {"opacity_rounds": 1, "color_iterations": 6},
    },
    "high": {"visibility": {"views": 64}, "refine": {"steps": 200, "half_after": 60, "size": 400}},
    "max": {"visibility": {"views": 64}, "refine": {"steps": 600, "size": 400}},
    "paper": {
        "effects": {"unbounded": "off", "duplicates": "off"},
        "filter": {"max_mass_share": 1.0, "max_flyaway_share": 0.0},
        "cvt": {
            "area_power": 0.0,
            "perspective": False,
            "hidden_share": 1.0,
            "weight_floor": 0.0,
            "color": 0.0,
            "seeding": "weighted",
            "iterations": 5,
            "tolerance": 0.0,
            "samples_per_site": 0,
        },
        "allocation": {"oversampling": 1.0, "reassign": False},
        "merge": {
            "area_power": 0.0,
            "opacity": "union",
            "representatives": False,
            "align_axes": False,
            "inflation": 0.0,
            "covered_inflation": 0.0,
        },
    },
}
"""What each preset changes of the defaults: ``standard`` nothing.

``paper`` is CVT-GS (Li et al. 2026) as published, with a network that was trained here.
"""
