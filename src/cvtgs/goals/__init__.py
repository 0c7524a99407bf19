"""Goals instead of knobs: a time to keep, or a quality to reach."""

from cvtgs.goals.choose import Choice, choose_preset
from cvtgs.goals.cost_model import CostModel
from cvtgs.goals.count import Found, Tried, find_count
from cvtgs.goals.remember import cost_model
from cvtgs.goals.work import Work

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
