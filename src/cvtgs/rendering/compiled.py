"""The door to numba, the only file that imports it; loading this file loads it.

Compiled code is kept on disk beside the source (or in ``NUMBA_CACHE_DIR``), so only the first
call ever waits for the compiler. A kernel's cache notices changes of its own file only: after
changing a function that a kernel of another file calls, clear the cache.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from cvtgs.errors import MissingDependencyError

try:
    import numba
except ImportError as error:
    raise MissingDependencyError(
        f"backend 'numba' needs the package numba, which cannot be imported ({error}); "
        f"install it with: pip install 'cvtgs[numba]', or use backend='torch'."
    ) from error

F = TypeVar("F", bound=Callable[..., object])

prange = numba.prange
"""A range whose steps run in parallel, in a function made by :func:`parallel`."""

_SETTINGS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract"},
}


def serial(function: F) -> F:
    """Compile a function when it is first called."""
    return cast("F", numba.njit(**_SETTINGS)(function))


def parallel(function: F) -> F:
    """Compile a function whose outer loop runs over :data:`prange`."""
    return cast("F", numba.njit(parallel=True, **_SETTINGS)(function))


def use_threads(count: int) -> None:
    """Limit the threads of compiled functions that are called from this thread."""
    most = vars(numba.config)["NUMBA_NUM_THREADS"]
    numba.set_num_threads(max(1, min(count, most)))
