"""The best preset that fits into a time."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from cvtgs.budget.calibrate import cost_model
from cvtgs.budget.costs import CostModel, Work
from cvtgs.config import SimplifyConfig
from cvtgs.counts import target_count
from cvtgs.errors import GoalError, InvalidArgumentError
from cvtgs.scene import GaussianScene

MARGIN = 1.3
"""Predictions are right to 30 %: a preset fits if this many times its prediction does."""


class Choice(NamedTuple):
    """A preset that fits.

    Attributes:
        preset: Its name.
        seconds: How long it will take, predicted.
    """

    preset: str
    seconds: float


def choose_preset(
    work: GaussianScene | Work,
    seconds: float,
    *,
    rho: float | None = None,
    count: int | None = None,
    settings: Mapping[str, str] | None = None,
    model: CostModel | None = None,
) -> Choice:
    """Choose the best preset whose simplification ends in time.

    The presets are ordered from the fastest to the best; ``paper``, which is there to compare
    with, is never chosen. A preset fits only if 1.3 times its predicted seconds do.

    Args:
        work: The scene, or its size; a size knows its target, and takes no ratio and no count.
        seconds: Wall-clock seconds from the scene in memory to the small scene in memory.
        rho: Ratio of Gaussians to keep, in (0, 1].
        count: Number of Gaussians to keep, instead of ``rho``.
        settings: Changes of every preset, texts by dotted key, for example
            ``{"visibility.views": "0"}``.
        model: The cost of presets; None for :func:`cvtgs.budget.cost_model`, which measures it once
            on this machine.

    Returns:
        The preset, and how long it will take.

    Raises:
        GoalError: Not even the fastest fits; the text says how long it takes.
        InvalidArgumentError: Seconds, ratio or count are out of range.
        ConfigError: A setting is unknown or out of range.

    Example:
        >>> rates = {"standard": {"check": {"in": 4e-6, "in_values": 0.0}}}
        >>> work = Work(count=1_000_000, target=10_000)
        >>> choose_preset(work, 9.0, model=CostModel(rates=rates))
        Choice(preset='standard', seconds=4.0)
    """
    if not 0 < seconds < math.inf:
        raise InvalidArgumentError(f"the time must be above 0 and finite, found {seconds!r} s.")
    if isinstance(work, GaussianScene):
        work = Work.of(work, target_count(len(work), rho, count=count))
    elif rho is not None or count is not None:
        raise InvalidArgumentError("a size knows its target: give neither rho nor count with it.")
    known = cost_model() if model is None else model
    costs = {
        name: known.seconds(
            name, work, config=SimplifyConfig.compose(preset=name, settings=settings)
        )
        for name in known.presets
    }
    fitting = [name for name, cost in costs.items() if MARGIN * cost <= seconds]
    if not fitting:
        fastest = min(costs, key=lambda name: costs[name])
        raise GoalError(
            f"no preset fits into {seconds:.2g} s: the fastest, {fastest}, takes about "
            f"{costs[fastest]:.2g} s to make {work.target:,} of {work.count:,} Gaussians, and is "
            f"given {MARGIN:g} times that."
        )
    best = fitting[-1]
    return Choice(best, costs[best])
