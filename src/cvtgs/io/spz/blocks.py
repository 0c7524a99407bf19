"""Take an ``.spz`` file apart: header and decompressed blocks, never more than it promises."""

import struct
import warnings
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from cvtgs.errors import DroppedDataWarning, FileFormatError
from cvtgs.io.files import read_bytes
from cvtgs.io.spz.layout import (
    EXTENSIONS_FLAG,
    HEADER,
    MAGIC,
    STORED_REST_COUNTS,
    SpzHeader,
)

_GZIP = b"\x1f\x8b"
_MOST_BITS = 24
_MOST_EXPANSION = 1032
"""Deflate cannot make more than this many bytes of one."""

_TABLE_START = slice(16, 20)
_FOURTH_HEADER_BYTES = 32


class SpzFile(NamedTuple):
    """An ``.spz`` file in parts.

    Attributes:
        header: What it says of itself.
        blocks: Bytes by name: means, opacities, colors, log_scales, quats, sh.
    """

    header: SpzHeader
    blocks: dict[str, UInt8[np.ndarray, "b"]]


def read_blocks(path: Path) -> SpzFile:
    """Read and decompress a file."""
    content = read_bytes(path)
    if content[:2] == _GZIP:
        return _read_gzip(content, path)
    if content[:4] == MAGIC.to_bytes(4, "little"):
        return _read_version_4(content, path)
    raise FileFormatError(
        f"{path}: an .spz file must start with gzip's or its own magic number, "
        f"found {content[:4]!r}."
    )


def _read_gzip(content: bytes, path: Path) -> SpzFile:
    stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    try:
        header = _header(stream.decompress(content, HEADER.size), path, versions=(1, 2, 3))
        wanted = sum(header.sizes.values())
        if wanted > _MOST_EXPANSION * len(content):
            raise _too_short(path, header, wanted, f"{len(content):,} compressed ones")
        payload = stream.decompress(stream.unconsumed_tail, wanted)
        surplus = len(stream.decompress(stream.unconsumed_tail, 1))
    except zlib.error as error:
        raise FileFormatError(f"{path}: must be whole gzip, found damage: {error}.") from error
    if len(payload) < wanted:
        raise _too_short(path, header, wanted, f"{len(payload):,}")
    if surplus:
        _refuse_shifted(header, path)
        warnings.warn(
            f"{path}: left out what stands behind the {header.count:,} Gaussians that the header "
            f"promises.",
            DroppedDataWarning,
            stacklevel=5,
        )
    elif not stream.eof:
        raise FileFormatError(f"{path}: must be whole gzip, found it cut short.")
    return SpzFile(header, _split(np.frombuffer(payload, np.uint8), header))


def _refuse_shifted(header: SpzHeader, path: Path) -> None:
    """Refuse extensions before version 4, since nothing says where they end."""
    if header.flags & EXTENSIONS_FLAG:
        raise FileFormatError(
            f"{path}: an .spz file of version {header.version} must have no extensions, found "
            f"some; write it as version 4."
        )


def _read_version_4(content: bytes, path: Path) -> SpzFile:
    from cvtgs.io.spz.zstd import decompress  # noqa: PLC0415 (only such files need it)

    header = _header(content[: HEADER.size], path, versions=(4,))
    sizes = {name: size for name, size in header.sizes.items() if size}
    start = int.from_bytes(content[_TABLE_START], "little")
    table = content[start : start + 16 * len(sizes)]
    is_whole = start >= _FOURTH_HEADER_BYTES and len(table) == 16 * len(sizes)
    if header.streams != len(sizes) or not is_whole:
        raise FileFormatError(
            f"{path}: must hold {len(sizes)} blocks, found a table of {header.streams} at byte "
            f"{start:,} of {len(content):,}."
        )
    blocks = {"sh": np.empty(0, np.uint8)}
    at = start + 16 * len(sizes)
    for (name, size), (packed, unpacked) in zip(
        sizes.items(), struct.iter_unpack("<QQ", table), strict=True
    ):
        if unpacked != size or at + packed > len(content):
            raise FileFormatError(
                f"{path}: block {name!r} must have {size:,} bytes for {header.count:,} Gaussians, "
                f"found {unpacked:,} in {packed:,} compressed ones of a file of {len(content):,}."
            )
        blocks[name] = decompress(content[at : at + packed], size, f"{path}: block {name!r}")
        at += packed
    return SpzFile(header, blocks)


def _header(start: bytes, path: Path, *, versions: tuple[int, ...]) -> SpzHeader:
    if len(start) < HEADER.size:
        raise FileFormatError(
            f"{path}: an .spz file must start with a header of {HEADER.size} bytes, "
            f"found {len(start)}."
        )
    magic, version, count, degree, bits, flags, streams = HEADER.unpack(start)
    if magic != MAGIC:
        raise FileFormatError(
            f"{path}: the header of an .spz file must start with b'NGSP', found {start[:4]!r}."
        )
    if version not in versions:
        raise FileFormatError(
            f"{path}: the version of the .spz file must be 1 to 3, or 4 without gzip, "
            f"found {version}."
        )
    if count == 0 or degree >= len(STORED_REST_COUNTS) or bits > _MOST_BITS:
        raise FileFormatError(
            f"{path}: an .spz file must hold at least one Gaussian of SH degree 0 to 4 with at "
            f"most {_MOST_BITS} fractional bits, found {count:,} of degree {degree} with {bits}."
        )
    return SpzHeader(
        version=version,
        count=count,
        sh_degree=degree,
        fractional_bits=bits,
        flags=flags,
        streams=streams,
    )


def _split(payload: NDArray[np.uint8], header: SpzHeader) -> dict[str, NDArray[np.uint8]]:
    ends = np.cumsum(list(header.sizes.values()))[:-1]
    return dict(zip(header.sizes, np.split(payload, ends), strict=True))


def _too_short(path: Path, header: SpzHeader, wanted: int, found: str) -> FileFormatError:
    return FileFormatError(
        f"{path}: must hold {wanted:,} bytes for the {header.count:,} Gaussians of SH degree "
        f"{header.sh_degree} that the header promises, found {found}."
    )
