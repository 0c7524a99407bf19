"""Progress events, which long calls report while they run."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgressEvent:
    """One step of one stage.

    Attributes:
        stage: Name of the stage, for example ``"tessellate"``.
        done: Number of finished steps; 0 when the stage starts.
        total: Number of steps of the stage; ``done == total`` when it has ended.
        note: Intermediate result of the stage, for example ``"+1.20 dB"``; empty if none.
    """

    stage: str
    done: int
    total: int
    note: str = ""


ProgressListener = Callable[[ProgressEvent], object]
"""A callable that takes a :class:`ProgressEvent`. An exception that it raises ends the call."""


def silent(event: ProgressEvent) -> None:
    """Ignore a progress event; the default listener."""
