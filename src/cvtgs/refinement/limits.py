"""Limits of a refinement in steps and seconds."""

import math
import time
from typing import Literal

from cvtgs.errors import InvalidArgumentError


def check_limits(seconds: float | None, *, steps: int | None) -> None:
    """Raise an error if seconds or steps are not positive."""
    if seconds is not None and not 0 < seconds < math.inf:
        raise InvalidArgumentError(
            f"the refinement time in seconds must be above 0 and finite, found {seconds!r}."
        )
    whole = isinstance(steps, int) and not isinstance(steps, bool)
    if steps is not None and not (whole and steps >= 1):
        raise InvalidArgumentError(
            f"the number of refinement steps must be a whole number of at least 1, found {steps!r}."
        )


class Limits:
    """Counters of steps and seconds, which decide whether one more step fits."""

    def __init__(self, seconds: float | None, *, steps: int | None) -> None:
        self._start = time.perf_counter()
        self._last = self._start
        self._seconds = seconds
        self._steps = steps
        self._slowest = {"step": 0.0, "check": 0.0}
        self.steps = 0

    @property
    def total(self) -> int:
        """Total units of progress: steps, or thousandths of the time."""
        return 1000 if self._seconds is not None or self._steps is None else self._steps

    @property
    def done(self) -> int:
        """Units of progress so far, at least 1 after a step, and below :attr:`total`."""
        return max(min(int(self.share() * self.total), self.total - 1), min(self.steps, 1))

    def share(self) -> float:
        """Return the used share of the steps or seconds, whichever is larger."""
        of_steps = self.steps / self._steps if self._steps else 0.0
        elapsed = time.perf_counter() - self._start if self._seconds else 0.0
        return min(1.0, max(of_steps, elapsed / self._seconds if self._seconds else 0.0))

    def begin(self) -> None:
        """Start to time a step or check."""
        self._last = time.perf_counter()

    def end(self, kind: Literal["step", "check"]) -> None:
        """Record the time since the last call, and count a step."""
        now = time.perf_counter()
        self._slowest[kind] = max(self._slowest[kind], now - self._last)
        self._last = now
        self.steps += kind == "step"

    def reached(self) -> str:
        """Return the limit that is reached: ``steps``, ``time``, or an empty string.

        ``time`` means that one more step and check, as slow as the slowest so far, would not fit.
        """
        if self._steps is not None and self.steps >= self._steps:
            return "steps"
        if self._seconds is None:
            return ""
        needed = time.perf_counter() - self._start + sum(self._slowest.values())
        return "time" if needed > self._seconds else ""
