"""Write an ``.spz`` file."""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from typing import BinaryIO, Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8

from cvtgs.counts import whole_number
from cvtgs.errors import InvalidArgumentError
from cvtgs.io.arrays import HALF_RANGE, Arrays, arrays_of, drop_largest, opacity_bytes, to_bytes
from cvtgs.io.axes import AXES, SCENE_AXES, checked_axes
from cvtgs.io.limits import SPZ_STEPS
from cvtgs.io.spz.read import (
    ANTIALIASED_FLAG,
    AXES_EXTENSION,
    COLOR_SCALE,
    EXTENSIONS_FLAG,
    FOURTH_HEADER_BYTES,
    TABLE_ENTRY,
    SpzHeader,
)
from cvtgs.math.spherical_harmonics import REST_COUNTS, degree_of
from cvtgs.scene import GaussianScene
from cvtgs.validity import writable_rows

_USUAL_BITS = 12
_MOST_BITS = 22
_OUTLIERS = 0.001
_CHUNK_ROWS = 1 << 18
_ZSTD_LEVEL = 12
"""Size and time are those of gzip; level 19 is 4 % smaller and takes ten times as long."""


Version = Literal[2, 3, 4]
VERSIONS: tuple[Version, ...] = (2, 3, 4)


def write_spz(
    scene: GaussianScene, file: BinaryIO, *, version: Version = 3, axes: str = SCENE_AXES
) -> None:
    """Write an ``.spz`` file, in the order and the axes of the scene.

    Numbers are rounded as in Niantic's library, so that the files of both agree.

    Args:
        scene: The scene, on any device.
        file: The output, open for writing.
        version: 3 (gzip), 4 (zstd), which states its axes but which many viewers cannot read yet,
            or 2 (gzip, rotations in 24 instead of 32 bits) for older readers.
        axes: The axes that a file of version 4 states; the scene is not converted.

    Raises:
        InvalidArgumentError: The version or the axes do not exist.
        InvalidSceneError: No Gaussian of the scene is finite.
        OSError: The file cannot be written.

    Example:
        >>> import gzip, io
        >>> from cvtgs.synthetic import scene
        >>> file = io.BytesIO()
        >>> write_spz(scene("object", 5, sh_degree=0, seed=0), file)
        >>> gzip.decompress(file.getvalue())[:4]
        b'NGSP'
    """
    if whole_number(version) not in VERSIONS:
        raise InvalidArgumentError(f"the version of an .spz must be 2, 3 or 4, found {version!r}.")
    number = 1 + AXES.index(checked_axes(axes))
    arrays = arrays_of(scene)
    header = SpzHeader(
        version=version,
        count=len(arrays.means),
        sh_degree=degree_of(arrays.shN.shape[1]),
        fractional_bits=_fractional_bits(scene),
        flags=ANTIALIASED_FLAG if scene.antialiased else 0,
    )
    if version == 4:
        _write_fourth(arrays, header, number, file)
        return
    stream = zlib.compressobj(wbits=zlib.MAX_WBITS | 16)  # gzip without name and time
    file.write(stream.compress(header.packed()))
    for parts in _blocks(arrays, header):
        for part in parts:
            file.write(stream.compress(part.tobytes()))
    file.write(stream.flush())


def _write_fourth(arrays: Arrays, header: SpzHeader, axes: int, file: BinaryIO) -> None:
    """Write version 4: header, the extension for the axes, sizes of the blocks, and the blocks."""
    from zstandard import ZstdCompressor  # noqa: PLC0415 (only for version 4)

    sizes = [size for size in header.sizes.values() if size]
    packed = []
    for size, parts in zip(sizes, _blocks(arrays, header), strict=False):  # no SH, no block
        stream = ZstdCompressor(level=_ZSTD_LEVEL).compressobj(size=size)
        packed.append(b"".join(stream.compress(part.tobytes()) for part in parts) + stream.flush())
    header = replace(header, streams=len(sizes), flags=header.flags | EXTENSIONS_FLAG)
    extension = struct.pack("<III", AXES_EXTENSION, 4, axes)
    start = FOURTH_HEADER_BYTES + len(extension)
    file.write((header.packed() + struct.pack("<I", start)).ljust(FOURTH_HEADER_BYTES, b"\0"))
    file.write(extension)
    for size, block in zip(sizes, packed, strict=True):
        file.write(TABLE_ENTRY.pack(len(block), size))
    for block in packed:
        file.write(block)


def largest_coordinate(scene: GaussianScene) -> float:
    """Return the largest coordinate that a file of the scene can hold."""
    return SPZ_STEPS / (1 << _fractional_bits(scene))


def _fractional_bits(scene: GaussianScene) -> int:
    """Choose the number of fractional bits of the coordinates.

    The usual number is 12, as in Niantic's library. Scenes smaller than 8 units get more (at most
    22), so that a coordinate has at least 16 bits; scenes larger than 2,048 units get fewer. Up to
    a thousandth of the Gaussians may lie beyond the range; they are clamped to it.
    """
    rows = scene.means.detach()[writable_rows(scene)].abs().amax(dim=1)
    if not len(rows):
        return _USUAL_BITS
    rank = math.ceil((1 - _OUTLIERS) * len(rows))
    extent = float(torch.kthvalue(rows, rank).values)
    power = math.frexp(extent)[1]  # extent < 2^power
    return max(0, min(max(_USUAL_BITS, 15 - power), 23 - power, _MOST_BITS))


def _blocks(arrays: Arrays, header: SpzHeader) -> Iterator[Iterator[UInt8[np.ndarray, "n b"]]]:
    """Yield the blocks in the order of the file, each in chunks."""
    rows = range(0, len(arrays.means), _CHUNK_ROWS)
    parts = [slice(start, start + _CHUNK_ROWS) for start in rows]
    yield (_means(arrays.means[part], header.fractional_bits) for part in parts)
    yield (opacity_bytes(arrays.logit_opacities[part]) for part in parts)
    yield (to_bytes(255 * (COLOR_SCALE * arrays.sh0[part] + 0.5)) for part in parts)
    yield (to_bytes(16 * (arrays.log_scales[part] + 10)) for part in parts)
    yield (_quats(arrays.quats[part], header.version) for part in parts)
    yield (_rest(arrays.shN[part]) for part in parts)


def _means(means: Float[np.ndarray, "n 3"], bits: int) -> UInt8[np.ndarray, "n b"]:
    steps = np.clip(np.rint(means * np.float32(2**bits)), -SPZ_STEPS, SPZ_STEPS - 1)
    steps = steps.astype("<i4", order="C")
    return np.ascontiguousarray(steps.view(np.uint8).reshape(len(means), 3, 4)[:, :, :3])


def _quats(quats: Float[np.ndarray, "n 4"], version: int) -> UInt8[np.ndarray, "n b"]:
    if version < 3:
        signs = np.where(quats[:, :1] < 0, np.float32(-1), np.float32(1))
        return to_bytes(np.float32(127.5) * (signs * quats[:, 1:] + 1))
    largest, others = drop_largest(np.roll(quats, -1, axis=1))
    sizes = np.minimum((np.abs(others) * (511 / HALF_RANGE) + 0.5).astype(np.uint32), 511)
    fields = sizes | np.where(others < 0, np.uint32(512), np.uint32(0))
    words = largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    stored: UInt8[np.ndarray, "n b"] = words.astype("<u4")[:, None].view(np.uint8)
    return stored


def _rest(rest: Float[np.ndarray, "n k 3"]) -> UInt8[np.ndarray, "n b"]:
    """Round the first band to 5 bits and others to 4, which makes gzip effective."""
    bands = np.repeat([8, 16], [REST_COUNTS[1], REST_COUNTS[3] - REST_COUNTS[1]])
    steps = bands[: rest.shape[1], None].astype(np.float32)
    stored = np.floor((np.rint(128 * rest) + 128 + steps / 2) / steps) * steps
    whole: UInt8[np.ndarray, "n b"] = np.clip(stored, 0, 255).astype(np.uint8)
    return whole
