"""The device to compute on: by name, its memory, and the number of its threads."""

import gc
import os
import platform
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TypeVar

import torch

from cvtgs.errors import DeviceError, OutOfMemoryError, is_out_of_memory

LONGER_CHUNKS = 32
"""How many times as much as on a CPU is computed together on another device, at most."""

CHUNK_BYTES = 1 << 28
"""Device memory for each chunk as long as on a CPU, which takes a quarter of it at most."""

Item = TypeVar("Item")
Result = TypeVar("Result")
_SHORT_CHUNKS = ContextVar("short_chunks", default=False)


def resolve_device(device: str | torch.device) -> torch.device | None:
    """Return the device of a name, None for ``auto``; raise DeviceError if it is not there."""
    return None if device == "auto" else usable_device(device)


def usable_device(device: str | torch.device) -> torch.device:
    """Return the device of a name; raise DeviceError if it is not there."""
    try:
        resolved = torch.device(device)
        torch.empty(0, device=resolved)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).split("\n")[0].rstrip(".")
        raise DeviceError(f"device {str(device)!r} cannot be used here: {reason}.") from None
    return resolved


def chosen_device(device: str | torch.device, home: str | torch.device = "cpu") -> torch.device:
    """Return the device of a name; for ``auto`` CUDA if the data are on the CPU, else ``home``."""
    resolved, home = resolve_device(device), torch.device(home)
    if resolved is not None:
        return resolved
    return torch.device("cuda") if home.type == "cpu" and torch.cuda.is_available() else home


def device_name(device: torch.device) -> str:
    """Name what a device is made of."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    if device.type != "cpu":
        return device.type
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def chunk_length(length: int, device: torch.device) -> int:
    """Return how much to compute together on a device.

    A chunk that fits the caches of a CPU is too short for a GPU, where every chunk costs the
    launches of its operations. It depends on the memory that a device has, not on what is free,
    so that the same device gives the same bits.

    Args:
        length: What a CPU computes together.
        device: Where it is computed.

    Returns:
        The length on a CPU; elsewhere 32 times as much, or less on CUDA with less than 8 GiB, and
        not more in the second attempt of :func:`within_memory`.

    Example:
        >>> chunk_length(100, torch.device("cpu"))
        100
    """
    if device.type == "cpu" or _SHORT_CHUNKS.get():
        return length
    if device.type != "cuda":
        return LONGER_CHUNKS * length
    memory = torch.cuda.get_device_properties(device).total_memory
    return max(1, min(LONGER_CHUNKS, memory // CHUNK_BYTES)) * length


def within_memory(
    compute: Callable[[torch.device, str], Result],
    device: torch.device,
    *,
    work: str,
    may_leave: bool,
) -> Result:
    """Compute on a device; if its memory ends, in short chunks, and then on the CPU if that may be.

    Args:
        compute: Takes the device, and a note for the report: empty, or what happened.
        device: Where to compute.
        work: What is computed, for the error.
        may_leave: Whether the CPU may be taken instead of the device.

    Returns:
        What ``compute`` returns.

    Raises:
        OutOfMemoryError: The device has too little memory, and it is the only one.

    Example:
        >>> within_memory(
        ...     lambda device, note: f"{device}{note}", torch.device("cpu"), work="a test",
        ...     may_leave=False,
        ... )
        'cpu'
    """
    note = ""
    for is_short in (False, True):
        token = _SHORT_CHUNKS.set(is_short)
        try:
            return compute(device, note)
        except RuntimeError as error:
            if device.type == "cpu" or not is_out_of_memory(error):
                raise
        finally:
            _SHORT_CHUNKS.reset(token)
        note = f"{device} ran out of memory; computed there in short chunks"
        gc.collect()  # what the failed attempt held
        if device.type == "cuda":
            torch.cuda.empty_cache()
    if not may_leave:
        raise OutOfMemoryError(
            f"{work} needs more memory than {device} has, in short chunks too; free some there, "
            f"or compute with device='cpu' (--device cpu)."
        )
    return compute(torch.device("cpu"), f"{device} ran out of memory; computed on the CPU")


def core_count() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def thread_count() -> int:
    """Return how many threads a search may use: one for each core, or ``OMP_NUM_THREADS``."""
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(core_count(), int(limit))) if limit.isdecimal() else core_count()


def in_threads(
    function: Callable[[Item], Result], items: Iterable[Item], device: torch.device
) -> Iterator[Result]:
    """Call a function for chunks, as many at a time as torch uses threads; each call uses one.

    Chunks are too short for torch to split its operations on them well. Every chunk gives the
    same bits whatever the number of threads.

    Args:
        function: Computes on one chunk; several calls run at the same time.
        items: The chunks.
        device: Where it computes: others than CPUs get one chunk after the other.

    Returns:
        The results, in the order of the items, each computed when it is asked for or before.

    Example:
        >>> list(in_threads(abs, [-1, 2, -3], torch.device("cpu")))
        [1, 2, 3]
    """
    threads = torch.get_num_threads()
    if device.type != "cpu" or threads == 1 or thread_count() == 1:
        return map(function, items)
    return _in_pool(function, items, min(threads, thread_count()))


def _in_pool(
    function: Callable[[Item], Result], items: Iterable[Item], threads: int
) -> Iterator[Result]:
    before, has_gradients = torch.get_num_threads(), torch.is_grad_enabled()

    def start() -> None:
        torch.set_num_threads(1)
        torch.set_grad_enabled(has_gradients)

    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads, initializer=start) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > 2 * threads:  # so that few results wait at any time
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
            torch.set_num_threads(before)  # threads that start later would have one, too


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute in one thread.

    Sums then do not depend on the number of cores, and pieces too small to be shared do not wait
    for one another.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
