"""Write a compressed PLY file."""

from typing import BinaryIO

import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from cvtgs.errors import InvalidSceneError
from cvtgs.io.arrays import Arrays, arrays_of, colors_of_sh0, opacity_bytes
from cvtgs.io.compressed_ply.layout import (
    CHUNK_ROWS,
    COLOR_BITS,
    PACKED,
    QUAT_BITS,
    RANGES,
    THREE_BITS,
    pack,
)
from cvtgs.io.limits import Holds
from cvtgs.io.morton import morton_rows
from cvtgs.io.smallest_three import drop_largest
from cvtgs.scene import GaussianScene

_MOST_LOG_SCALE = 20.0

COMPRESSED_PLY_HOLDS = Holds(
    sh_degree=3,
    tag=True,
    comments=True,
    limits={
        "log_scales": (-_MOST_LOG_SCALE, _MOST_LOG_SCALE),
        "shN": (-4.0, 4.0),
    },
    changed=(
        "rows in Morton order",
        "positions and scales in 2048 (y: 1024) steps and colours in 256 between the least and "
        "the largest of 256 Gaussians",
        "rotations in steps of 1/723 per component",
        "opacities in steps of 1/255",
        "view-dependent SH coefficients in steps of 1/32",
    ),
)
"""What a compressed PLY file holds."""


def write_compressed_ply(scene: GaussianScene, file: BinaryIO) -> None:
    """Write a compressed PLY file.

    Rows are sorted along a Morton curve, so that the 256 Gaussians of a chunk lie close together
    and their common ranges are small.

    Args:
        scene: The scene, on any device.
        file: Where to, open for writing.

    Raises:
        InvalidSceneError: No Gaussian of the scene is finite, or a comment has two lines.
        OSError: The file cannot be written.

    Example:
        >>> import io
        >>> from cvtgs.synthetic import scene
        >>> file = io.BytesIO()
        >>> write_compressed_ply(scene("object", 5, sh_degree=0, seed=0), file)
        >>> file.getvalue()[:3]
        b'ply'
    """
    arrays = arrays_of(scene)
    order = morton_rows(arrays.means)
    rest = arrays.shN[order].transpose(0, 2, 1).reshape(len(order), -1)
    file.write(_header(scene.comments, len(order), rest.shape[1]))
    ranges, words = _packed(arrays, order)
    file.write(ranges.astype("<f4").tobytes())
    file.write(words.astype("<u4").tobytes())
    file.write(_rest_bytes(rest).tobytes())


def _header(comments: tuple[str, ...], count: int, rest: int) -> bytes:
    for comment in comments:
        if "\n" in comment:
            raise InvalidSceneError(
                f"a comment must be one line to be written to a PLY, found {comment[:80]!r}."
            )
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {comment}".rstrip() for comment in comments]
    lines += [f"element chunk {-(-count // CHUNK_ROWS)}"]
    lines += [f"property float {name}" for name in RANGES]
    lines += [f"element vertex {count}"]
    lines += [f"property uint {name}" for name in PACKED]
    if rest:
        lines += [f"element sh {count}"]
        lines += [f"property uchar f_rest_{i}" for i in range(rest)]
    return "\n".join([*lines, "end_header", ""]).encode()


def _packed(
    arrays: Arrays, order: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return the ranges of each chunk and the words of each Gaussian."""
    log_scales = np.clip(arrays.log_scales, -_MOST_LOG_SCALE, _MOST_LOG_SCALE)
    opacities = opacity_bytes(arrays.logit_opacities)[order].astype(np.uint32)
    place, place_range = _fractions(arrays.means[order])
    scale, scale_range = _fractions(log_scales[order])
    color, color_range = _fractions(colors_of_sh0(arrays.sh0[order]))
    largest, others = drop_largest(arrays.quats[order])
    none = np.zeros(len(order), np.uint32)
    words = np.stack(
        [
            pack(place, THREE_BITS, high=none),
            pack(others * np.sqrt(np.float32(0.5)) + 0.5, QUAT_BITS, high=largest.astype("u4")),
            pack(scale, THREE_BITS, high=none),
            pack(color, COLOR_BITS[:3], high=none) << np.uint32(8) | opacities,
        ],
        axis=1,
    )
    return np.concatenate([place_range, scale_range, color_range], axis=1), words


def _fractions(
    values: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "c 6"]]:
    """Report where values lie between the least and the largest of their chunk, and give these."""
    starts = np.arange(0, len(values), CHUNK_ROWS)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    size = np.diff(np.append(starts, len(values)))
    below, width = np.repeat(low, size, axis=0), np.repeat(high - low, size, axis=0)
    fractions = np.where(width > 0, (values - below) / np.where(width > 0, width, 1), 0)
    return fractions, np.concatenate([low, high], axis=1)


def _rest_bytes(rest: Float[np.ndarray, "n k"]) -> UInt8[np.ndarray, "n k"]:
    return np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
