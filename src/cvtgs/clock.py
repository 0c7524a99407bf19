"""StageClock: what each stage of a call costs in time and memory."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pydantic
import torch

from cvtgs.progress import ProgressEvent, ProgressListener, silent


class StageCost(pydantic.BaseModel):
    """What one stage cost.

    Attributes:
        stage: Name of the stage.
        seconds: Wall-clock seconds.
        cpu_seconds: Processor seconds of the whole process.
        peak_memory_bytes: Largest resident size of the process up to the end of the stage, or 0
            where the system does not tell; it never falls from stage to stage.
        peak_device_memory_bytes: Largest size of tensors on a CUDA device during the stage, those
            of the process before it included; 0 elsewhere.
    """

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid")

    stage: str
    seconds: float
    cpu_seconds: float
    peak_memory_bytes: int
    peak_device_memory_bytes: int = 0


class StageClock:
    """Measures stages one after the other and tells a listener about them.

    Args:
        listener: Called when a stage starts, advances and ends.
        device: Where the stages compute; CUDA work is waited for.
    """

    def __init__(self, listener: ProgressListener, device: torch.device) -> None:
        self._listener = listener
        self._device = device
        self.costs: list[StageCost] = []

    @contextmanager
    def stage(self, name: str, total: int = 1) -> Iterator[Callable[[int], None]]:
        """Measure what happens inside.

        Args:
            name: Name of the stage.
            total: Steps of the stage.

        Yields:
            A function to call with the number of steps that are done.
        """

        def advance(done: int) -> None:
            if self._listener is not silent:
                self._listener(ProgressEvent(stage=name, done=done, total=total))

        on_cuda = self._device.type == "cuda"
        advance(0)
        if on_cuda and torch.cuda.is_initialized():  # else there is no peak yet, and it would fail
            torch.cuda.reset_peak_memory_stats(self._device)
        wall, cpu = time.perf_counter(), time.process_time()
        yield advance
        if on_cuda:
            torch.cuda.synchronize(self._device)
        self.costs.append(
            StageCost(
                stage=name,
                seconds=time.perf_counter() - wall,
                cpu_seconds=time.process_time() - cpu,
                peak_memory_bytes=peak_memory_bytes(),
                peak_device_memory_bytes=(
                    torch.cuda.max_memory_allocated(self._device) if on_cuda else 0
                ),
            )
        )
        advance(total)


def peak_memory_bytes() -> int:
    """Return the largest resident size of this process so far.

    Returns:
        Bytes; 0 where the system does not tell (Windows).

    Example:
        >>> peak_memory_bytes() >= 0
        True
    """
    try:
        import resource  # noqa: PLC0415 (not on Windows)
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
