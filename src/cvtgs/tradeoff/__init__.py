"""Seconds and quality of every preset on one scene."""

from cvtgs.tradeoff.files import write_tradeoff
from cvtgs.tradeoff.measure import Measured, measure_tradeoff
from cvtgs.tradeoff.results import Failure, Tradeoff, TradeoffResult

__all__ = [
    "Failure",
    "Measured",
    "Tradeoff",
    "TradeoffResult",
    "measure_tradeoff",
    "write_tradeoff",
]
