"""Read an ``.spz`` file."""

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from cvtgs.errors import DroppedDataWarning
from cvtgs.io.arrays import Arrays, logits_of_bytes, scene_of
from cvtgs.io.smallest_three import HALF_RANGE, restore_largest
from cvtgs.io.spz.blocks import read_blocks
from cvtgs.io.spz.layout import COLOR_SCALE, STORED_REST_COUNTS, Axes, SpzHeader, turned
from cvtgs.scene import GaussianScene


def read_spz(path: Path, *, axes: Axes = "RUB") -> GaussianScene:
    """Read an ``.spz`` file of version 1 to 4.

    The axes of the file are not in it. Niantic defines them as right, up, back, and its apps
    write them so; the scene is turned by half a turn about x to the axes of PLY files. Some
    tools (splat-transform, gsply) write PLY axes instead.

    Args:
        path: The file.
        axes: What the axes of the file are; ``"RDF"`` for those of PLY files.

    Returns:
        The scene. SH bands above degree 3 are left out with a warning.

    Raises:
        InputNotFoundError: There is no such file.
        InputError: It cannot be opened or read.
        FileFormatError: It is not an ``.spz`` file, or damaged.
        MissingDependencyError: It is of version 4, and zstandard is not installed.
    """
    header, blocks = read_blocks(path)
    if header.sh_degree > 3:
        warnings.warn(
            f"{path}: left out the SH bands above degree 3 (the file has degree "
            f"{header.sh_degree}), since a scene holds degree 0 to 3.",
            DroppedDataWarning,
            stacklevel=3,
        )
    arrays = _unpack(header, blocks)
    arrays = turned(arrays) if axes == "RUB" else arrays
    return scene_of(arrays, antialiased=header.antialiased)


def _unpack(header: SpzHeader, blocks: Mapping[str, UInt8[np.ndarray, "b"]]) -> Arrays:
    n = header.count
    rest = blocks["sh"].reshape(n, STORED_REST_COUNTS[header.sh_degree], 3)[:, :15]
    return Arrays(
        means=_means(blocks["means"].reshape(n, 3, -1), header),
        quats=_quats(blocks["quats"].reshape(n, -1)),
        log_scales=blocks["log_scales"].reshape(n, 3).astype(np.float32) / 16 - 10,
        logit_opacities=logits_of_bytes(blocks["opacities"]),
        sh0=(blocks["colors"].reshape(n, 3).astype(np.float32) / 255 - np.float32(0.5))
        / COLOR_SCALE,
        shN=(rest.astype(np.float32) - 128) / 128,
    )


def _means(stored: UInt8[np.ndarray, "n 3 b"], header: SpzHeader) -> Float[np.ndarray, "n 3"]:
    if header.version == 1:  # half precision; such files were never released
        return stored.view("<f2")[..., 0].astype(np.float32)
    low, middle, high = np.moveaxis(stored.astype(np.int32), 2, 0)
    whole = low | (middle << 8) | (high << 16)
    signed = (whole ^ 0x800000) - 0x800000
    means: Float[np.ndarray, "n 3"] = signed.astype(np.float32)
    return means * np.float32(0.5**header.fractional_bits)


def _quats(stored: UInt8[np.ndarray, "n b"]) -> Float[np.ndarray, "n 4"]:
    """Decode three bytes (x, y, z, with w at least 0) or four (two bits, three of ten)."""
    if stored.shape[1] == 3:
        xyz = stored.astype(np.float32) / np.float32(127.5) - 1
        return restore_largest(np.zeros(len(xyz), np.int64), xyz)
    words = stored.view("<u4")[:, 0]
    fields = words[:, None] >> np.array([20, 10, 0], np.uint32)
    sizes = (fields & 511).astype(np.float32) * (HALF_RANGE / 511)
    others = np.where(fields & 512, -sizes, sizes)
    return np.roll(restore_largest((words >> 30).astype(np.int64), others), 1, axis=1)
