"""Goals instead of knobs: a time to keep, or a quality to reach."""

from cvtgs.budget.choose import Choice, choose_preset
from cvtgs.budget.cost_model import CostModel
from cvtgs.budget.count import Found, Tried, find_count
from cvtgs.budget.remember import cost_model
from cvtgs.budget.work import Work

__all__ = [
    "Choice",
    "CostModel",
    "Found",
    "Tried",
    "Work",
    "choose_preset",
    "cost_model",
    "find_count",
]
