"""Choice of a preset for a time budget, and of a count for a quality."""

from cvtgs.budget.calibrate import cost_model, shipped_model
from cvtgs.budget.costs import CostModel, Work
from cvtgs.budget.count import Choice, Found, choose_preset, find_count

__all__ = [
    "Choice",
    "CostModel",
    "Found",
    "Work",
    "choose_preset",
    "cost_model",
    "find_count",
    "shipped_model",
]
