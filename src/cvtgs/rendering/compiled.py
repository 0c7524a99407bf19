"""Decorators and array types of the compiled kernels; the only file that imports numba.

Compiled code is cached on disk: beside the source, in the user's cache folder or in
``NUMBA_CACHE_DIR``. Only the first call waits for the compiler, unless none of these folders is
writable: then every process compiles again. A kernel's cache notices changes in its own file only:
after changing a function that kernels in other files call, clear the cache.
"""

import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial, wraps
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray

from cvtgs.devices import HOST, in_threads, kernel_threads
from cvtgs.errors import MissingDependencyError, how_to_install, is_out_of_memory

try:
    import numba
except (ImportError, OSError) as error:
    if is_out_of_memory(error.__context__ or error):  # another backend would give different bits
        raise MemoryError from error
    raise MissingDependencyError(
        f"backend 'numba' needs the package numba, which cannot be imported ({error}); "
        f"{how_to_install('numba')}, or use backend='torch'."
    ) from error

Array = NDArray[Any]  # floats, all of one dtype, which numba infers
Ints = NDArray[Any]  # integers
Bools = NDArray[Any]
# Half-open pixel ranges: first column, end column, first row, end row
PixelBox = tuple[int, int, int, int]
F = TypeVar("F", bound=Callable[..., object])
Item = TypeVar("Item")
Result = TypeVar("Result")

_TURN = threading.Lock()  # of threads of the program, where numba takes one loop at a time
prange = numba.prange  # a range whose steps run in parallel in functions compiled by `parallel`


def serial(function: F, **settings: bool) -> F:
    """Compile a function at its first call."""
    compiler = partial(
        numba.njit, nogil=True, error_model="numpy", fastmath={"contract"}, **settings
    )
    try:
        return cast("F", compiler(cache=True)(function))
    except RuntimeError:  # no cache folder is writable
        return cast("F", compiler()(function))


def parallel(function: F) -> F:
    """Compile a function whose outer loop runs over :data:`prange`; only Python may call it.

    It uses as many threads as torch. Without OpenMP and TBB, the threads of numba take one loop at
    a time and end the process at a second one; so threads of the program wait for each other there.
    """
    compiled = serial(function, parallel=True)

    @wraps(function)
    def call(*arguments: Any) -> object:
        with nullcontext() if takes_several_loops() else _TURN, threads_of_torch():
            return compiled(*arguments)

    return cast("F", call)


def takes_several_loops() -> bool:
    """Return whether loops of several threads can run at once: numba must find OpenMP or TBB."""
    try:
        return bool(vars(numba)["threading_layer"]() != "workqueue")
    except ValueError:  # chosen in the first loop
        return False


def for_each_camera(
    function: Callable[[Item], Result], cameras: Sequence[Item]
) -> Generator[Result, None, None]:
    """Call a function for several cameras at a time, if their loops can share the threads."""
    at_a_time = len(cameras) > 1 and takes_several_loops()
    yield from in_threads(function, cameras, HOST) if at_a_time else map(function, cameras)


@contextmanager
def threads_of_torch() -> Iterator[None]:
    """Let compiled functions use as many threads as torch, or more where it is limited to one."""
    count, wanted = torch.get_num_threads(), kernel_threads()
    most = vars(numba.config)["NUMBA_NUM_THREADS"]
    before = numba.get_num_threads()
    numba.set_num_threads(max(1, min(wanted, most)))
    if torch.get_num_threads() != count:  # numba starts threads of an OpenMP library of both
        torch.set_num_threads(count)
    try:
        yield
    finally:
        numba.set_num_threads(before)


class GaussianArrays(NamedTuple):
    """The tensors of a scene, or their gradients, in the order of ``GaussianScene.tensors``."""

    means: Array
    quats: Array
    log_scales: Array
    logits: Array
    sh0: Array
    rest: Array


class RasterSettings(NamedTuple):
    """One camera, and the settings for colours and opacities."""

    # (9, 3): rotation (rows 0 to 2), centre (3), focal lengths (4), principal point (5), slope
    # bounds along x (6) and y (7), width and height (8). Pairs are padded with 0; row 8 ends with
    # the dilation, squared pixels.
    camera: NDArray[np.float64]
    size: tuple[int, int]  # width and height, pixels
    sh_degree: int  # highest SH degree to evaluate
    antialiased: bool  # whether to compensate opacities for the dilation


class TileArrays(NamedTuple):
    """The splats of each tile, front to back."""

    starts: Ints  # (t + 1,) start of each tile's list
    lists: Ints  # (p, 2) for each intersection: its index in splat order, and its splat
    side: int  # pixels along a tile's edge


class SplatArrays(NamedTuple):
    """Splats in view, front to back."""

    rows: Ints  # (m,) row of the Gaussian in the scene
    starts: Ints  # (m + 1,) start of each splat's intersections, in splat order
    first: Ints  # (m,) the first tile that each splat touches
    packed: Array  # (m, 10) as returned by `cvtgs.rendering.projection.pack`
