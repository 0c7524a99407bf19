"""Devices: choice by name, copies, chunk lengths, out-of-memory fallbacks, and CPU threads."""

import gc
import os
import platform
import re
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from cvtgs.errors import DeviceError, OutOfMemoryError, is_out_of_memory
from cvtgs.text import shortened

LONGER_CHUNKS = 128  # largest length of a chunk on other devices, in units of that on a CPU
CHUNK_BYTES = 1 << 29  # device memory per chunk of CPU length, which takes at most a quarter of it
HOST = torch.device("cpu")
ALIGNMENT = 128  # bytes at which a tensor of a shared copy starts, enough for matrix products

MOST_THREADS = 4
"""Maximum number of threads that share chunks of torch operations; more would mostly wait for
Python's lock, which is held for a tenth of the 50 microseconds that an operation on a chunk takes.
"""

Item = TypeVar("Item")
Result = TypeVar("Result")
_SHORT_CHUNKS: ContextVar[bool | None] = ContextVar("short_chunks", default=None)


class _Own(threading.local):
    """Whether the calling thread uses one thread of torch; threads for its kernels and chunks."""

    is_limited = False
    spare = 1
    for_chunks = 1


class _Limits:
    """Running calls that limit torch, in the whole process, and its settings before the first."""

    lock = threading.Lock()
    setting = threading.Lock()
    dtype = threading.RLock()  # held while torch's default dtype is another
    running = 0
    threads = 1
    exact = 0  # running calls of full_precision
    restore_products: Callable[[], object]  # to call after the last of them


_OWN = _Own()


def usable_device(device: str | torch.device) -> torch.device:
    """Return the named device; raise DeviceError if it cannot be used."""
    if not isinstance(device, str | torch.device | int) or isinstance(device, bool):
        raise DeviceError(
            f"device must be a name such as 'cpu' or a torch.device, found {device!r}."
        )
    try:
        resolved = torch.empty(0, device=torch.device(device)).device  # cuda is cuda:0
    except (RuntimeError, AssertionError, NotImplementedError, ImportError) as error:
        reason = shortened(re.split(r"\.?\n|\. |\.$", str(error))[0], 120)
        others = "'cpu'"
        if reason.startswith("Expected one of"):  # all types that torch knows
            reason, others = "torch has no such device", "'cpu' or 'cuda'"
        raise DeviceError(
            f"device {str(device)!r} cannot be used here: {reason}; use another, such as {others}."
        ) from None
    return resolved


def chosen_device(device: str | torch.device, home: str | torch.device = "cpu") -> torch.device:
    """Return the device to compute on; for ``auto``, CUDA for a scene on the CPU, else ``home``."""
    if device != "auto":
        named = usable_device(device)
        check_computes(named)
        return named
    home = torch.device(home)
    if home.type == "cpu" and torch.cuda.is_available():
        number = torch.cuda.current_device() if torch.cuda.is_initialized() else 0
        return torch.device(f"cuda:{number}")  # starts nothing, so the process can still fork
    return home if _has_float64(home) else HOST


def check_computes(device: torch.device) -> None:
    """Raise unless a device holds numbers, also in float64: ``mps`` does not."""
    if device.type == "meta":
        raise DeviceError("device 'meta' cannot be used here: its tensors have no values.")
    if not _has_float64(device):
        raise DeviceError(f"device '{device}' cannot be used here: it has no float64; use 'cpu'.")


def _has_float64(device: torch.device) -> bool:
    if device.type in ("cpu", "cuda"):
        return True
    try:
        torch.empty(0, dtype=torch.float64, device=device)
    except (TypeError, RuntimeError):
        return False
    return True


def device_name(device: torch.device) -> str:
    """Return the hardware name of a device."""
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


def move_together(tensors: Sequence[Tensor], device: torch.device) -> list[Tensor]:
    """Return tensors of one device and any dtypes on another device, moved in a single copy."""
    if tensors[0].device == device:
        return list(tensors)
    parts = [tensor.contiguous().view(-1).view(torch.uint8) for tensor in tensors]
    padded = [pad(part, (0, -len(part) % ALIGNMENT)) for part in parts]
    moved = torch.cat(padded).to(device).split([len(part) for part in padded])
    return [
        there[: len(part)].view(tensor.dtype).view(tensor.shape)
        for there, part, tensor in zip(moved, parts, tensors, strict=True)
    ]


def chunk_length(length: int, device: torch.device) -> int:
    """Return the length of a chunk on a device, where launches cost time, by that on a CPU."""
    if device.type == "cpu" or _SHORT_CHUNKS.get():
        return length
    if device.type != "cuda":
        return LONGER_CHUNKS * length
    # Not by the free memory, so that the same device gives the same bits.
    memory = torch.cuda.get_device_properties(device).total_memory
    return max(1, min(LONGER_CHUNKS, memory // CHUNK_BYTES)) * length


def row_chunks(total: int, length: int, device: torch.device) -> list[slice]:
    """Return consecutive ranges of rows; ``length`` is that on a CPU (:func:`chunk_length`)."""
    step = chunk_length(length, device)
    return [slice(start, min(start + step, total)) for start in range(0, total, step)]


def within_memory(
    compute: Callable[[torch.device, str], Result],
    device: torch.device,
    *,
    work: str,
    may_leave: bool,
) -> Result:
    """Compute on a device; if it runs out of memory, retry with short chunks, then on the CPU.

    ``compute`` takes the device and a note for the report, empty in the first attempt.
    """
    note = ""
    if _SHORT_CHUNKS.get() is not None:  # the outer call retries
        return compute(device, note)
    for is_short in (False, True):
        token = _SHORT_CHUNKS.set(is_short)
        try:
            return compute(device, note)
        except (RuntimeError, OutOfMemoryError) as error:
            cause = error.__cause__ if isinstance(error, OutOfMemoryError) else error  # of `render`
            is_full = isinstance(cause, RuntimeError) and is_out_of_memory(cause)
            if device.type == "cpu" or not is_full:
                raise
        finally:
            _SHORT_CHUNKS.reset(token)
        note = f"{device} ran out of memory; computed there in short chunks"
        gc.collect()  # frees the tensors of the failed attempt
        if device.type == "cuda":
            torch.cuda.empty_cache()
    if not may_leave:
        raise OutOfMemoryError(
            f"{work} needs more memory than {device} has, even in short chunks; free some of it, "
            f"or compute with device='cpu' (--device cpu)."
        )
    return compute(HOST, f"{device} ran out of memory; computed on the CPU")


def core_count() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def thread_count() -> int:
    """Return the number of threads for a search: one per core, at most ``OMP_NUM_THREADS``."""
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(core_count(), int(limit))) if limit.isdecimal() else core_count()


def in_threads(
    function: Callable[[Item], Result], items: Iterable[Item], device: torch.device
) -> Generator[Result, None, None]:
    """Yield the results for chunks, in order, each by one of as many threads as torch uses.

    Every chunk has one thread of torch, and the same bits; chunks on other devices run in turn.
    """
    with _Limits.lock:
        threads = max(torch.get_num_threads(), _OWN.for_chunks)
        if threads == 1 and _Limits.running > 0 and not _OWN.is_limited:
            threads = _Limits.threads  # another call limits torch at the moment
    threads = min(threads, thread_count())
    if device.type != "cpu" or threads == 1:
        yield from map(function, items)
        return
    has_gradients, workers = torch.is_grad_enabled(), min(threads, MOST_THREADS)
    is_inference = torch.is_inference_mode_enabled()

    def start(before: int) -> None:
        _OWN.is_limited, _OWN.spare = True, -(-threads // workers)
        _limit_own(before)
        torch.set_grad_enabled(has_gradients)

    def call(item: Item) -> Result:
        with torch.inference_mode() if is_inference else nullcontext():  # also of its own thread
            return function(item)

    waiting: deque[Future[Result]] = deque()
    with (
        one_thread() as before,  # torch's threads would compete with those of the pool for cores
        ThreadPoolExecutor(workers, initializer=start, initargs=(before,)) as pool,
    ):
        try:
            for item in items:
                waiting.append(pool.submit(call, item))
                if len(waiting) > 2 * workers:  # limits the number of pending results
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def in_chunks(
    function: Callable[[slice], Result], total: int, length: int, device: torch.device
) -> list[Result]:
    """Call a function for ranges of rows, at least one, as :func:`in_threads` does.

    ``length`` is that on a CPU. The calling thread computes a single range, with torch's threads.
    """
    parts = row_chunks(total, length, device) or [slice(0, 0)]
    if len(parts) == 1:
        return [function(parts[0])]
    return list(in_threads(function, parts, device))


def _limit_own(before: int) -> None:
    """Limit torch to one thread in the calling thread alone."""
    with _Limits.setting:
        torch.get_num_threads()  # or the first operation here would take the number set last
        torch.set_num_threads(1)
        # Threads that start later take, and keep, the number that any thread has set last.
        if before > 1:
            setter = threading.Thread(target=torch.set_num_threads, args=(before,))
            setter.start()
            setter.join()


@contextmanager
def full_precision() -> Iterator[None]:
    """Compute in the dtypes of the tensors, even if the program allows fewer bits.

    Such programs switch autocast on, or allow matrix products in TF32 or bfloat16.
    """
    with ExitStack() as stack:
        for kind in ("cpu", "cuda"):
            if torch.is_autocast_enabled(kind):
                stack.enter_context(torch.autocast(kind, enabled=False))
        with _Limits.setting:
            if _Limits.exact == 0:
                _Limits.restore_products = _use_exact_products()
            _Limits.exact += 1
        try:
            yield
        finally:
            with _Limits.setting:
                _Limits.exact -= 1
                if _Limits.exact == 0:  # the setting is that of the whole process
                    _Limits.restore_products()


def _use_exact_products() -> Callable[[], object]:
    """Multiply matrices in all bits of their dtype; return a function that takes this back."""
    try:
        before = torch.get_float32_matmul_precision()
    except RuntimeError:  # the program has set it by the names of torch 2.9 and newer
        stack = ExitStack()
        for kind in ("cuda", "mkldnn"):
            matmul = getattr(torch.backends, kind).matmul
            stack.callback(setattr, matmul, "fp32_precision", matmul.fp32_precision)
            matmul.fp32_precision = "ieee"
        return stack.close
    if before == "highest":
        return lambda: None
    torch.set_float32_matmul_precision("highest")
    return partial(torch.set_float32_matmul_precision, before)


@contextmanager
def on_host() -> Iterator[None]:
    """Create tensors on the CPU, whatever the default device of the caller."""
    with ExitStack() as stack:
        if torch.get_default_device() != HOST:
            stack.enter_context(HOST)
        yield


@contextmanager
def in_float32() -> Iterator[None]:
    """Create tensors in float32, whatever the default dtype, for a short time."""
    with _Limits.dtype:  # the default is that of the whole process
        dtype = torch.get_default_dtype()
        if dtype != torch.float32:
            torch.set_default_dtype(torch.float32)
        try:
            yield
        finally:
            if dtype != torch.float32:
                torch.set_default_dtype(dtype)


@contextmanager
def one_thread() -> Iterator[int]:
    """Make torch use one thread, so that no sum depends on cores; yield how many it used before."""
    if _OWN.is_limited:
        yield _OWN.spare
        return
    with _Limits.lock:
        own = torch.get_num_threads()
        if _Limits.running == 0:
            _Limits.threads = own
        # Threads of the program that start at the moment when a call limits torch take its limit,
        # 1, for their own number, so they get that of the first call instead.
        before = own if own > 1 else _Limits.threads
        _Limits.running += 1
    try:
        _OWN.is_limited, _OWN.spare = True, before
        _limit_own(before)
        yield before
    finally:
        _OWN.is_limited, _OWN.spare = False, 1
        with _Limits.lock:
            _Limits.running -= 1
            torch.set_num_threads(before)


@contextmanager
def threads_for_chunks() -> Iterator[None]:
    """Leave the threads of torch to chunks (:func:`in_threads`) and to compiled loops."""
    # Where torch splits an operation changes last bits, and its threads wait for one another after
    # each: ten times as long if other programs use the cores. Threads for chunks rarely wait.
    if _OWN.is_limited:
        yield
        return
    with one_thread() as before:
        _OWN.for_chunks = before
        try:
            yield
        finally:
            _OWN.for_chunks = 1


def kernel_threads() -> int:
    """Return the number of threads for loops whose results do not depend on it.

    In a thread of :func:`in_threads`, it is its share of those that torch leaves.
    """
    return max(torch.get_num_threads(), _OWN.spare)
