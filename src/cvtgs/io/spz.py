"""Niantic's ``.spz`` files: 20 bytes per Gaussian and one per view-dependent SH value."""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import astuple, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import BinaryIO, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, UInt8

from cvtgs.counts import whole_number
from cvtgs.errors import DroppedDataWarning, FileFormatError, InvalidArgumentError, warn
from cvtgs.io.arrays import (
    HALF_RANGE,
    Arrays,
    drop_largest,
    logits_of_bytes,
    restore_largest,
    to_bytes,
)
from cvtgs.io.axes import AXES, SCENE_AXES, change_axes, checked_axes
from cvtgs.io.files import check_expansion, open_input
from cvtgs.io.limits import SPZ_STEPS
from cvtgs.math.spherical_harmonics import REST_COUNTS, degree_of
from cvtgs.scene import GaussianScene
from cvtgs.tags import ANTIALIASED
from cvtgs.validity import writable_rows

__all__ = ["decode_spz", "read_spz", "write_spz"]

_MAGIC, _GZIP = b"NGSP", b"\x1f\x8b"
_HEADER = struct.Struct("<4sIIBBBB")
_ANTIALIASED, _EXTENDED = 1, 2  # flags
_AXES_EXTENSION = 0xADBE0003  # the type of Adobe's extension for the axes, which it numbers from 1
_MOST_EXTENSION_BYTES = 1 << 20  # of versions 1 to 3; real ones have a few dozen bytes
_FOURTH_HEADER_BYTES = 32  # then extensions, the sizes of the blocks, and the blocks
_TABLE_ENTRY = struct.Struct("<QQ")  # compressed and uncompressed size of a block, in bytes
_COLOR_SCALE = np.float32(0.15)  # bytes hold ``0.5 + 0.15 sh0``, wider than displayable colours
_STORED_REST_COUNTS = (*REST_COUNTS, 24)  # a scene leaves out the coefficients of degree 4
_GZIP_BITS = zlib.MAX_WBITS | 16  # zlib's code for gzip, without name and time
_PIECE_BYTES = 1 << 14  # to unpack at once: small, since what follows a member is copied
_USUAL_BITS, _MOST_BITS, _MOST_READ_BITS = 12, 22, 24  # the first as in Niantic's library
_OUTLIERS = 0.001  # share of the Gaussians that may be clamped
_CHUNK_ROWS = 1 << 18
_ZSTD_LEVEL = 12  # size and time are those of gzip; 19 is 4 % smaller and takes ten times as long

Blocks = dict[str, UInt8[np.ndarray, "b"]]  # bytes by the names of SpzHeader.sizes
Version = Literal[2, 3, 4]


@dataclass(frozen=True, slots=True)
class SpzHeader:
    """The header of an ``.spz`` file of version 1 to 4, in the order of the file."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int  # of coordinates
    flags: int
    streams: int = 0  # number of compressed blocks of version 4; reserved in older versions

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes of each block, in the order of the file."""
        per_row = {
            "means": 6 if self.version == 1 else 9,
            "opacities": 1,
            "colors": 3,
            "log_scales": 3,
            "quats": 3 if self.version < 3 else 4,
            "sh": 3 * _STORED_REST_COUNTS[self.sh_degree],
        }
        return {name: self.count * size for name, size in per_row.items()}

    def packed(self) -> bytes:
        """Return the first 16 bytes of the file."""
        return _HEADER.pack(_MAGIC, *astuple(self))


def read_spz(path: Path, *, axes: str | None = None, trust_sizes: bool = False) -> GaussianScene:
    """Read an ``.spz`` file of version 1 to 4.

    Few files state their axes, by an extension. Other files are assumed to have the axes of PLY
    files, as most tools write them; Niantic's apps write ``"rub"``.

    Args:
        path: The file.
        axes: The axes of the file, as :func:`cvtgs.io.change_axes` names them; None for those that
            it states, else those of PLY files.
        trust_sizes: Whether the file may unpack to any size.

    Returns:
        The scene. SH bands above degree 3 are left out with a warning.

    Raises:
        InputError: The file does not exist, or cannot be opened or read.
        FileFormatError: It is not an ``.spz`` file, or damaged.
        InvalidArgumentError: The name of the axes is unknown.
    """
    with open_input(path) as file:
        content = file.read()
    return decode_spz(content, path, axes=axes, trust_sizes=trust_sizes)


def decode_spz(
    content: bytes, path: Path | str, *, axes: str | None, trust_sizes: bool
) -> GaussianScene:
    """Decode the bytes of an ``.spz`` file as :func:`read_spz` does."""
    header = peek_spz(content, path)
    n, degree = header.count, header.sh_degree
    if not trust_sizes:
        check_expansion(path, count=n, sh_degree=degree, stored=len(content))
    read = _read_version_4 if header.version == 4 else _read_gzip
    blocks, extensions = read(content, header, path)
    stated = _stated_axes(extensions, path)
    if degree > 3:
        warn(
            f"{path}: left out the SH bands above degree 3 (the file has degree 4).",
            DroppedDataWarning,
        )
    colors = blocks["colors"].reshape(n, 3).astype(np.float32) / 255
    rest = blocks["sh"].reshape(n, _STORED_REST_COUNTS[degree], 3)[:, : REST_COUNTS[-1]]
    arrays = Arrays(
        means=_means_of(blocks["means"].reshape(n, 3, -1), header),
        quats=_quats_of(blocks["quats"].reshape(n, -1)),
        log_scales=blocks["log_scales"].reshape(n, 3).astype(np.float32) / 16 - 10,
        logit_opacities=logits_of_bytes(blocks["opacities"]),
        sh0=(colors - np.float32(0.5)) / _COLOR_SCALE,
        shN=(rest.astype(np.float32) - 128) / 128,
    )
    scene = arrays.scene(comments=[ANTIALIASED.text] if header.flags & _ANTIALIASED else ())
    return change_axes(scene, axes or stated or SCENE_AXES, SCENE_AXES)


def peek_spz(content: bytes, path: Path | str) -> SpzHeader:
    """Return the header of the bytes of an ``.spz`` file, without unpacking its Gaussians."""
    is_packed, size = content.startswith(_GZIP), _HEADER.size
    start = bytes(_gunzip(content, size, path)[0] if is_packed else content[:size])
    if len(start) < _HEADER.size or not start.startswith(_MAGIC):
        raise FileFormatError(
            f"{path}: an .spz file must start with a header of {_HEADER.size} bytes that begin "
            f"with {_MAGIC!r}, in gzip or not, found {len(start)} that begin with {start[:4]!r}."
        )
    header = SpzHeader(*_HEADER.unpack(start)[1:])
    if header.version not in ((1, 2, 3) if is_packed else (4,)):
        raise FileFormatError(
            f"{path}: the version must be 1 to 3, or 4 without gzip, found {header.version}."
        )
    count, degree, bits = header.count, header.sh_degree, header.fractional_bits
    if count == 0 or degree >= len(_STORED_REST_COUNTS) or bits > _MOST_READ_BITS:
        raise FileFormatError(
            f"{path}: must hold at least one Gaussian of SH degree 0 to 4 with at most "
            f"{_MOST_READ_BITS} fractional bits, found {count:,} of degree {degree} with {bits}."
        )
    return header


def _means_of(stored: UInt8[np.ndarray, "n 3 b"], header: SpzHeader) -> Float[np.ndarray, "n 3"]:
    if header.version == 1:  # half precision; such files were never released
        return stored.view("<f2")[..., 0].astype(np.float32)
    low, middle, high = np.moveaxis(stored.astype(np.int32), 2, 0)
    signed = (low << 8 | middle << 16 | high << 24) >> 8
    return np.asarray(signed.astype(np.float32) * np.float32(0.5**header.fractional_bits))


def _quats_of(stored: UInt8[np.ndarray, "n b"]) -> Float[np.ndarray, "n 4"]:
    """Decode three bytes (x, y, z; w is at least 0) or four (fields of 2, 10, 10, 10 bits)."""
    if stored.shape[1] == 3:
        xyz = stored.astype(np.float32) / np.float32(127.5) - 1
        return restore_largest(np.zeros(len(xyz), np.int64), xyz)
    words = stored.view("<u4")[:, 0]
    fields = words[:, None] >> np.array([20, 10, 0], np.uint32)
    sizes = (fields & 511).astype(np.float32) * (HALF_RANGE / 511)
    others = np.where(fields & 512, -sizes, sizes)
    return np.roll(restore_largest((words >> 30).astype(np.int64), others), 1, axis=1)


def _read_gzip(content: bytes, header: SpzHeader, path: Path | str) -> tuple[Blocks, bytes]:
    """Return the blocks of version 1 to 3, and the extensions after them."""
    end, is_extended = _HEADER.size + sum(header.sizes.values()), bool(header.flags & _EXTENDED)
    spare = _MOST_EXTENSION_BYTES if is_extended else 0
    data, is_intact = _gunzip(content, end + spare + 1, path)
    surplus = bytes(data[end:])
    if len(data) < end:
        raise FileFormatError(
            f"{path}: must hold {end - _HEADER.size:,} bytes for the {header.count:,} Gaussians of "
            f"SH degree {header.sh_degree} that the header promises, found "
            f"{len(data) - _HEADER.size:,}."
        )
    is_whole = sum(8 + size for _, size, _ in _records(surplus)) == len(surplus)
    if is_extended and (len(surplus) > spare or not is_whole):
        raise FileFormatError(  # a draft had them before the Gaussians, which are then others
            f"{path}: the extensions after the Gaussians must be whole records of at most "
            f"{_MOST_EXTENSION_BYTES:,} bytes together, found others; write it as version 4."
        )
    if surplus and not is_extended:
        text = f"{path}: left out the bytes after the {header.count:,} Gaussians of the header."
        warn(text, DroppedDataWarning)
    elif not is_intact:
        raise FileFormatError(f"{path}: must be intact gzip data, found it cut short.")
    ends = np.cumsum([_HEADER.size, *header.sizes.values()], dtype=np.int64)
    _, *blocks, _ = np.split(np.frombuffer(data, np.uint8), ends)
    return dict(zip(header.sizes, blocks, strict=True)), surplus if is_extended else b""


def _gunzip(content: bytes, most: int, path: Path | str) -> tuple[bytearray, bool]:
    """Unpack at most so many bytes of all gzip members, and say whether the last one ended."""
    data, stream, at = bytearray(), zlib.decompressobj(_GZIP_BITS), 0
    while len(data) < most and at < len(content):
        if stream.eof:
            if not content.startswith(_GZIP, at):  # padding
                break
            stream = zlib.decompressobj(_GZIP_BITS)
        piece = content[at : at + _PIECE_BYTES]
        try:
            data += stream.decompress(piece, most - len(data))
        except zlib.error as error:
            text = f"{path}: must be intact gzip data, found damage: {error}."
            raise FileFormatError(text) from error
        at += len(piece) - len(stream.unconsumed_tail) - len(stream.unused_data)
    return data, stream.eof


def _read_version_4(content: bytes, header: SpzHeader, path: Path | str) -> tuple[Blocks, bytes]:
    """Return the blocks, and the extensions before them."""
    sizes = {name: size for name, size in header.sizes.items() if size}
    start = int.from_bytes(content[16:20], "little")  # of the table
    at = start + _TABLE_ENTRY.size * len(sizes)
    is_whole = start >= _FOURTH_HEADER_BYTES and len(content) >= at
    if header.streams != len(sizes) or not is_whole:
        raise FileFormatError(
            f"{path}: must hold {len(sizes)} blocks, found a table of {header.streams} at byte "
            f"{start:,} of {len(content):,}."
        )
    blocks = {"sh": np.empty(0, np.uint8)}
    entries = _TABLE_ENTRY.iter_unpack(content[start:at])
    for (name, size), (packed, unpacked) in zip(sizes.items(), entries, strict=True):
        if unpacked != size or at + packed > len(content):
            raise FileFormatError(
                f"{path}: block {name!r} must have {size:,} bytes for {header.count:,} Gaussians, "
                f"found {unpacked:,} in {packed:,} compressed bytes of a file of {len(content):,}."
            )
        blocks[name] = _unzstd(content[at : at + packed], size, f"{path}: block {name!r}")
        at += packed
    return blocks, content[_FOURTH_HEADER_BYTES:start] if header.flags & _EXTENDED else b""


def _records(extensions: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield the type, the stated size and the content of each record; the last may be cut."""
    at = 0
    while at + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, at)
        yield kind, size, extensions[at + 8 : at + 8 + size]
        at += 8 + size


def _stated_axes(extensions: bytes, path: Path | str) -> str | None:
    axes = None
    for kind, size, content in _records(extensions):
        if kind == _AXES_EXTENSION:
            number = int.from_bytes(content[:4], "little")
            if size != 4 or len(content) < 4 or number > len(AXES):
                raise FileFormatError(
                    f"{path}: the extension for the axes must hold a 4-byte number from 0 to "
                    f"{len(AXES)}, found {number} in {size:,} bytes."
                )
            axes = AXES[number - 1] if number else "rub"  # as Niantic's library takes it
    return axes


def _unzstd(content: bytes, size: int, where: str) -> UInt8[np.ndarray, "b"]:
    """Decompress a block of known size."""
    import zstandard  # noqa: PLC0415 (only for version 4)

    try:
        with zstandard.ZstdDecompressor().stream_reader(content) as stream:
            data = stream.read(size + 1)
    except zstandard.ZstdError as error:
        raise FileFormatError(f"{where} must be intact zstd data, found: {error}.") from error
    if len(data) != size:
        found = f"{len(data):,}" if len(data) < size else "more"
        raise FileFormatError(f"{where} must have {size:,} bytes, found {found}.")
    return np.frombuffer(data, np.uint8)


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

    Example:
        >>> import gzip, io
        >>> from cvtgs.synthetic import scene
        >>> file = io.BytesIO()
        >>> write_spz(scene("object", 5, sh_degree=0, seed=0), file)
        >>> gzip.decompress(file.getvalue())[:4]
        b'NGSP'
    """
    if whole_number(version) not in get_args(Version):
        raise InvalidArgumentError(f"the version of an .spz must be 2, 3 or 4, found {version!r}.")
    number = 1 + AXES.index(checked_axes(axes))
    arrays = Arrays.of(scene)
    header = SpzHeader(
        version=version,
        count=len(arrays.means),
        sh_degree=degree_of(arrays.shN.shape[1]),
        fractional_bits=fractional_bits(scene),
        flags=_ANTIALIASED if scene.antialiased else 0,
    )
    if version == 4:
        _write_fourth(arrays, header, number, file)
        return
    stream = zlib.compressobj(wbits=_GZIP_BITS)
    file.write(stream.compress(header.packed()))
    parts = chain.from_iterable(_blocks(arrays, header))
    file.writelines(stream.compress(part.tobytes()) for part in parts)
    file.write(stream.flush())


def _write_fourth(arrays: Arrays, header: SpzHeader, axes: int, file: BinaryIO) -> None:
    """Write version 4: header, the extension for the axes, sizes of the blocks, and the blocks."""
    from zstandard import ZstdCompressor  # noqa: PLC0415 (only for version 4)

    sizes = [size for size in header.sizes.values() if size]
    packed = []
    for size, parts in zip(sizes, _blocks(arrays, header), strict=False):  # no SH, no block
        stream = ZstdCompressor(level=_ZSTD_LEVEL).compressobj(size=size)
        packed.append(b"".join(stream.compress(part.tobytes()) for part in parts) + stream.flush())
    header = replace(header, streams=len(sizes), flags=header.flags | _EXTENDED)
    extension = struct.pack("<III", _AXES_EXTENSION, 4, axes)
    start = _FOURTH_HEADER_BYTES + len(extension)
    file.write((header.packed() + struct.pack("<I", start)).ljust(_FOURTH_HEADER_BYTES, b"\0"))
    file.write(extension)
    for size, block in zip(sizes, packed, strict=True):
        file.write(_TABLE_ENTRY.pack(len(block), size))
    file.writelines(packed)


def fractional_bits(scene: GaussianScene) -> int:
    """Choose the fractional bits of coordinates: more below 8 units, fewer beyond 2,048."""
    rows = scene.means.detach()[writable_rows(scene)].abs().amax(dim=1)
    if not len(rows):
        return _USUAL_BITS
    rank = math.ceil((1 - _OUTLIERS) * len(rows))
    power = math.frexp(float(torch.kthvalue(rows, rank).values))[1]  # of 2, above the extent
    return max(0, min(max(_USUAL_BITS, 15 - power), 23 - power, _MOST_BITS))


def _blocks(arrays: Arrays, header: SpzHeader) -> Iterator[Iterator[UInt8[np.ndarray, "n b"]]]:
    """Yield the blocks in the order of the file, each in chunks."""
    parts = list(arrays.chunks(_CHUNK_ROWS))
    yield (_pack_means(part.means, header.fractional_bits) for part in parts)
    yield (part.opacity_bytes for part in parts)
    yield (to_bytes(255 * (_COLOR_SCALE * part.sh0 + 0.5)) for part in parts)
    yield (to_bytes(16 * (part.log_scales + 10)) for part in parts)
    yield (_pack_quats(part.quats, header.version) for part in parts)
    yield (_pack_rest(part.shN) for part in parts)


def _pack_means(means: Float[np.ndarray, "n 3"], bits: int) -> UInt8[np.ndarray, "n b"]:
    steps = np.clip(np.rint(means * np.float32(2**bits)), -SPZ_STEPS, SPZ_STEPS - 1)
    steps = steps.astype("<i4", order="C")
    return np.ascontiguousarray(steps.view(np.uint8).reshape(len(means), 3, 4)[:, :, :3])


def _pack_quats(quats: Float[np.ndarray, "n 4"], version: int) -> UInt8[np.ndarray, "n b"]:
    if version < 3:
        signs = np.where(quats[:, :1] < 0, np.float32(-1), np.float32(1))
        return to_bytes(np.float32(127.5) * (signs * quats[:, 1:] + 1))
    largest, others = drop_largest(np.roll(quats, -1, axis=1))
    sizes = np.minimum((np.abs(others) * (511 / HALF_RANGE) + 0.5).astype(np.uint32), 511)
    fields = sizes | np.where(others < 0, np.uint32(512), np.uint32(0))
    words = largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return np.asarray(words.astype("<u4")[:, None].view(np.uint8))


def _pack_rest(rest: Float[np.ndarray, "n k 3"]) -> UInt8[np.ndarray, "n b"]:
    """Round the first band to 5 bits and others to 4, which makes gzip effective."""
    bands = np.repeat([8, 16], [REST_COUNTS[1], REST_COUNTS[3] - REST_COUNTS[1]])
    steps = bands[: rest.shape[1], None].astype(np.float32)
    stored = np.floor((np.rint(128 * rest) + 128 + steps / 2) / steps) * steps
    return np.asarray(np.clip(stored, 0, 255), np.uint8)
