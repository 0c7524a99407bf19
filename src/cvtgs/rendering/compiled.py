"""What the compiled kernels share: numba, which only this file imports, and their arrays.

Compiled code is kept on disk beside the source, in the user's folder for caches or in
``NUMBA_CACHE_DIR``, so only the first call ever waits for the compiler; where none of these can be
written, every process compiles anew. A kernel's cache notices changes of its own file only: after
changing a function that a kernel of another file calls, clear the cache.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray

from cvtgs.errors import MissingDependencyError, is_out_of_memory

try:
    import numba
except (ImportError, OSError) as error:
    if is_out_of_memory(error.__context__ or error):  # another backend would give other bits
        raise MemoryError from error
    raise MissingDependencyError(
        f"backend 'numba' needs the package numba, which cannot be imported ({error}); "
        f"install it with: pip install numba, or use backend='torch'."
    ) from error

Array = NDArray[Any]
"""Floats, all of one dtype; numba works out which."""

Ints = NDArray[Any]
"""Integers."""

PixelBox = tuple[int, int, int, int]
"""Pixels: first column, column after the last, first row, row after the last."""

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
    return _compiled(function, **_SETTINGS)


def parallel(function: F) -> F:
    """Compile a function whose outer loop runs over :data:`prange`."""
    return _compiled(function, **_SETTINGS, parallel=True)


def _compiled(function: F, **settings: Any) -> F:
    try:
        return cast("F", numba.njit(**settings)(function))
    except RuntimeError:  # no folder for compiled code can be written
        return cast("F", numba.njit(**settings | {"cache": False})(function))


def use_threads_of_torch() -> None:
    """Let compiled functions that are called from this thread use as many threads as torch.

    Where both share an OpenMP library, numba sets the number for torch, too, when it starts its
    threads: so it is set back.
    """
    count, most = torch.get_num_threads(), vars(numba.config)["NUMBA_NUM_THREADS"]
    numba.set_num_threads(max(1, min(count, most)))
    if torch.get_num_threads() != count:
        torch.set_num_threads(count)


class GaussianArrays(NamedTuple):
    """The tensors of a scene, or gradients of them, in the order of ``GaussianScene.tensors``."""

    means: Array
    quats: Array
    log_scales: Array
    logits: Array
    sh0: Array
    rest: Array


class RasterSettings(NamedTuple):
    """One camera, and how colours and opacities are computed.

    Attributes:
        camera: ``(9, 3)`` rotation (rows 0 to 2), centre (3), focal lengths (4), principal point
            (5), slope bounds along x (6) and along y (7), width and height (8); pairs end with 0,
            the last with the variance that splats gain, squared pixels.
        size: Width and height, pixels.
        sh_degree: Degree up to which colours depend on the direction.
        antialiased: Whether opacities are compensated.
    """

    camera: NDArray[np.float64]
    size: tuple[int, int]
    sh_degree: int
    antialiased: bool


class TileArrays(NamedTuple):
    """The splats of each tile, front to back.

    Attributes:
        starts: ``(t + 1,)`` where each tile's list starts.
        lists: ``(p, 2)`` place of each intersection if they were by splat, and its splat.
        side: Pixels along a tile's edge.
    """

    starts: Ints
    lists: Ints
    side: int


class SplatArrays(NamedTuple):
    """The splats in view, front to back.

    Attributes:
        rows: ``(m,)`` which Gaussian each is.
        starts: ``(m + 1,)`` where its intersections start, if they are by splat.
        packed: ``(m, 10)`` as :func:`cvtgs.rendering.projection.pack` describes.
    """

    rows: Ints
    starts: Ints
    packed: Array
