"""The ``.splat`` files of antimatter15's viewer: 32 bytes per Gaussian, nothing else."""

import os
from pathlib import Path
from typing import BinaryIO

import numpy as np

from cvtgs.errors import FileFormatError
from cvtgs.io.arrays import (
    Arrays,
    arrays_of,
    colors_of_sh0,
    log_scales_of,
    logits_of_bytes,
    opacity_bytes,
    scales_of,
    scene_of,
    sh0_of_colors,
    to_bytes,
    unit_quats,
)
from cvtgs.io.files import open_input
from cvtgs.scene import GaussianScene

_ROW = np.dtype(
    [
        ("mean", "<f4", 3),
        ("scale", "<f4", 3),
        ("rgb", "u1", 3),
        ("opacity", "u1"),
        ("quat", "u1", 4),
    ]
)
_CHUNK_ROWS = 1 << 16


def read_splat(path: Path) -> GaussianScene:
    """Read a ``.splat`` file.

    A Gaussian is three f32 of position, three f32 of scale (not its logarithm), and eight bytes:
    red, green, blue, opacity, and the quaternion, w first, as ``128 + 128 q``.
    """
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size == 0 or size % _ROW.itemsize:
            raise FileFormatError(
                f"{path}: a .splat file must hold one or more Gaussians of {_ROW.itemsize} bytes "
                f"each, found {size:,} bytes."
            )
        if file.read(4) in (b"ply\n", b"ply\r"):
            raise FileFormatError(f"{path}: a .splat file has no header, found a PLY; rename it.")
        file.seek(0)
        rows = np.fromfile(file, _ROW)
    return scene_of(
        Arrays(
            means=rows["mean"],
            quats=unit_quats((rows["quat"].astype(np.float32) - 128) / np.float32(128)),
            log_scales=log_scales_of(rows["scale"]),
            logit_opacities=logits_of_bytes(rows["opacity"]),
            sh0=sh0_of_colors(rows["rgb"].astype(np.float32) / np.float32(255)),
            shN=np.empty((len(rows), 0, 3), np.float32),
        )
    )


def write_splat(scene: GaussianScene, file: BinaryIO) -> None:
    """Write a ``.splat`` file, in the order of the scene."""
    arrays = arrays_of(scene, sh_degree=0)
    for start in range(0, len(arrays.means), _CHUNK_ROWS):
        part = slice(start, start + _CHUNK_ROWS)
        rows = np.empty(len(arrays.means[part]), _ROW)
        rows["mean"] = arrays.means[part]
        rows["scale"] = scales_of(arrays.log_scales[part])
        rows["rgb"] = to_bytes(255 * colors_of_sh0(arrays.sh0[part]))
        rows["opacity"] = opacity_bytes(arrays.logit_opacities[part])
        rows["quat"] = to_bytes(128 + 128 * arrays.quats[part])
        file.write(rows.tobytes())
