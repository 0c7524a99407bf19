"""A large scene in, a small one out."""

from cvtgs.counts import target_count
from cvtgs.simplify.prepared import Prepared
from cvtgs.simplify.results import Level, Simplified
from cvtgs.simplify.simplifier import Simplifier

__all__ = ["Level", "Prepared", "Simplified", "Simplifier", "target_count"]
