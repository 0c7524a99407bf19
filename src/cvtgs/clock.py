"""StageClock, which measures the time and memory of each stage of a call."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import pydantic
import torch

from cvtgs.errors import InvalidArgumentError
from cvtgs.progress import ProgressEvent, ProgressListener, silent
from cvtgs.text import shown


def check_listener(listener: object) -> None:
    """Raise unless a listener can be called."""
    if not callable(listener):
        raise InvalidArgumentError(
            f"listener must be a function of a progress event, found {shown(listener)}."
        )


class StageCost(pydantic.BaseModel, frozen=True, extra="forbid"):
    """The cost of one stage.

    Attributes:
        stage: Name of the stage.
        seconds: Wall-clock seconds.
        cpu_seconds: CPU seconds of the whole process.
        peak_memory_bytes: Peak resident size of the process up to the end of the stage, so it
            never falls from stage to stage; 0 if the system does not report it.
        peak_device_memory_bytes: Peak size of all tensors of the process on a CUDA device during
            the stage, including those allocated earlier; 0 on other devices.
    """

    stage: str
    seconds: float
    cpu_seconds: float
    peak_memory_bytes: int
    peak_device_memory_bytes: int = 0


class StageClock:
    """A clock that measures consecutive stages and reports progress; CUDA is synchronised.

    Args:
        listener: Called when a stage starts, advances and ends.
        device: Device that the stages compute on, whose memory is measured.
    """

    def __init__(self, listener: ProgressListener, device: torch.device) -> None:
        check_listener(listener)
        self._listener = listener
        self._device = device
        self._costs: list[StageCost] = []

    @contextmanager
    def stage(self, name: str, total: int = 1) -> Iterator[Callable[[int], None]]:
        """Measure the body of the ``with`` statement; yield a function of the finished steps.

        The event of the last step is sent when the stage ends. A stage that runs again adds to its
        cost.
        """

        def send(done: int) -> None:
            if self._listener is not silent:
                self._listener(ProgressEvent(stage=name, done=done, total=total))

        def advance(done: int) -> None:
            if done < total:
                send(done)

        on_cuda = self._device.type == "cuda"
        send(0)
        if on_cuda and torch.cuda.is_initialized():  # fails otherwise; there is no peak yet
            torch.cuda.reset_peak_memory_stats(self._device)
        wall, cpu = time.perf_counter(), time.process_time()
        yield advance
        if on_cuda:
            torch.cuda.synchronize(self._device)
        cost = StageCost(
            stage=name,
            seconds=time.perf_counter() - wall,
            cpu_seconds=time.process_time() - cpu,
            peak_memory_bytes=peak_memory_bytes(),
            peak_device_memory_bytes=(
                torch.cuda.max_memory_allocated(self._device) if on_cuda else 0
            ),
        )
        self._costs.append(cost)
        send(total)

    @property
    def costs(self) -> list[StageCost]:
        """The costs of the stages so far, in the order of their first runs."""
        return join_costs(self._costs)


def join_costs(costs: Iterable[StageCost]) -> list[StageCost]:
    """Add the costs of stages that ran several times, in the order of their first runs."""
    joined: dict[str, StageCost] = {}
    for cost in costs:
        before = joined.setdefault(cost.stage, cost)
        if before is not cost:
            joined[cost.stage] = StageCost(
                stage=cost.stage,
                seconds=before.seconds + cost.seconds,
                cpu_seconds=before.cpu_seconds + cost.cpu_seconds,
                peak_memory_bytes=max(before.peak_memory_bytes, cost.peak_memory_bytes),
                peak_device_memory_bytes=max(
                    before.peak_device_memory_bytes, cost.peak_device_memory_bytes
                ),
            )
    return list(joined.values())


def peak_memory_bytes() -> int:
    """Return the peak resident size of this process so far; 0 on Windows, which has none."""
    if sys.platform == "win32":
        return 0
    import resource  # noqa: PLC0415 (not on Windows)

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
