"""Progress events: what a long call reports while it runs."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgressEvent:
    """One step of one stage.

    Attributes:
        stage: Name of the stage, for example ``"tessellate"``.
        done: Steps finished so far, 0 when the stage starts.
        total: Steps of the whole stage; ``done == total`` when it has ended.
        note: What the stage has to say so far, for example ``"+1.20 dB"``; empty if nothing.
    """

    stage: str
    done: int
    total: int
    note: str = ""


ProgressListener = Callable[[ProgressEvent], None]
"""Anything that takes a :class:`ProgressEvent`. An exception that it raises ends the call."""


def silent(event: ProgressEvent) -> None:
    """Ignore a progress event; the default listener.

    Args:
        event: The event to ignore.

    Example:
        >>> silent(ProgressEvent(stage="read", done=0, total=1))
    """
