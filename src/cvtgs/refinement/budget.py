"""When a refinement has to stop: after so many steps, or so many seconds."""

import math
import time

from cvtgs.errors import InvalidArgumentError


def check_budget(seconds: float | None, *, steps: int | None) -> None:
    """Refuse times and numbers of steps that cannot be."""
    if seconds is not None and not 0 < seconds < math.inf:
        raise InvalidArgumentError(
            f"the seconds to refine for must be above 0 and finite, found {seconds!r}."
        )
    whole = isinstance(steps, int) and not isinstance(steps, bool)
    if steps is not None and not (whole and steps >= 1):
        raise InvalidArgumentError(
            f"the steps to refine for must be a whole number of at least 1, found {steps!r}."
        )


class Budget:
    """Counts steps and seconds, and knows how long one more round may take."""

    def __init__(self, seconds: float | None, *, steps: int | None) -> None:
        self._start = time.perf_counter()
        self._last = self._start
        self._seconds = seconds
        self._steps = steps
        self._slowest = {"step": 0.0, "check": 0.0}
        self.steps = 0

    @property
    def total(self) -> int:
        """Units of progress: steps, or thousandths of the time."""
        return 1000 if self._seconds is not None or self._steps is None else self._steps

    @property
    def done(self) -> int:
        """Units of progress so far, at least 1 after a step, and below :attr:`total`."""
        return max(min(int(self.share() * self.total), self.total - 1), min(self.steps, 1))

    def share(self) -> float:
        """Return how much of the budget is used up."""
        of_steps = self.steps / self._steps if self._steps else 0.0
        elapsed = time.perf_counter() - self._start if self._seconds else 0.0
        return min(1.0, max(of_steps, elapsed / self._seconds if self._seconds else 0.0))

    def begin(self) -> None:
        """Start to measure a round."""
        self._last = time.perf_counter()

    def end(self, kind: str) -> None:
        """Measure what was done since the last call."""
        now = time.perf_counter()
        self._slowest[kind] = max(self._slowest[kind], now - self._last)
        self._last = now
        self.steps += kind == "step"

    def spent(self) -> str:
        """Report what is used up.

        Time is, where one more step and one more check, as slow as the slowest so far, would not
        fit.
        """
        if self._steps is not None and self.steps >= self._steps:
            return "steps"
        if self._seconds is None:
            return ""
        needed = time.perf_counter() - self._start + sum(self._slowest.values())
        return "time" if needed > self._seconds else ""
