"""What compiled kernels share: arrays that belong together."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
"""Floats, all of one dtype; numba works out which."""

Ints = NDArray[Any]
"""Integers."""

Box = tuple[int, int, int, int]
"""Pixels: first column, column after the last, first row, row after the last."""


class GaussianArrays(NamedTuple):
    """The tensors of a scene, or gradients of them, in the order of ``GaussianScene.tensors``."""

    means: Array
    quats: Array
    log_scales: Array
    logits: Array
    sh0: Array
    rest: Array


class Setting(NamedTuple):
    """One camera, and how colours and opacities are to be taken.

    Attributes:
        camera: ``(9, 3)`` rotation (rows 0 to 2), centre (3), focal lengths (4), principal point
            (5), slope bounds along x (6) and along y (7), width and height (8); pairs end with 0.
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
        packed: ``(m, 10)`` as :func:`cvtgs.rendering.output.pack` describes.
    """

    rows: Ints
    starts: Ints
    packed: Array
