"""Read an ``.spz`` file, without decompressing more than the header promises."""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from cvtgs.errors import DroppedDataWarning, FileFormatError, warn
from cvtgs.io.arrays import HALF_RANGE, Arrays, logits_of_bytes, restore_largest, scene_of
from cvtgs.io.axes import AXES, SCENE_AXES, change_axes
from cvtgs.io.files import check_expansion, open_input
from cvtgs.scene import GaussianScene

MAGIC = b"NGSP"
HEADER = struct.Struct("<4sIIBBBB")
ANTIALIASED_FLAG = 1
EXTENSIONS_FLAG = 2
AXES_EXTENSION = 0xADBE0003  # the type of Adobe's extension for the axes, which it numbers from 1

FOURTH_HEADER_BYTES = 32
"""Header size of version 4; extensions follow, then the sizes of the blocks, then the blocks."""

TABLE_ENTRY = struct.Struct("<QQ")  # compressed and uncompressed size of a block, in bytes

COLOR_SCALE = np.float32(0.15)
"""Colour bytes store ``0.5 + 0.15 sh0``, a wider range than displayable colours."""

STORED_REST_COUNTS = (0, 3, 8, 15, 24)
"""View-dependent coefficients per channel that files may hold, by degree."""

Blocks = dict[str, UInt8[np.ndarray, "b"]]
"""Bytes by name: means, opacities, colors, log_scales, quats, sh."""

_GZIP = b"\x1f\x8b"

_GZIP_BITS = zlib.MAX_WBITS | 16  # zlib's code for gzip
_MOST_BITS = 24

_MOST_EXTENSION_BYTES = 1 << 20  # of versions 1 to 3; real ones have a few dozen bytes


@dataclass(frozen=True, slots=True)
class SpzHeader:
    """The header of an ``.spz`` file of version 1 to 4, in the order of the file."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    """Number of fractional bits of coordinates."""
    flags: int
    """Bits for antialiased and extensions."""
    streams: int = 0
    """Number of compressed blocks of version 4; reserved in older versions."""

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes of each block, in the order of the file."""
        per_row = {
            "means": 6 if self.version == 1 else 9,
            "opacities": 1,
            "colors": 3,
            "log_scales": 3,
            "quats": 3 if self.version < 3 else 4,
            "sh": 3 * STORED_REST_COUNTS[self.sh_degree],
        }
        return {name: self.count * size for name, size in per_row.items()}

    def packed(self) -> bytes:
        """Return the first 16 bytes of the file."""
        return HEADER.pack(MAGIC, *astuple(self))


def read_spz(path: Path, *, axes: str | None = None, trust_sizes: bool = False) -> GaussianScene:
    """Read an ``.spz`` file of version 1 to 4.

    Few files state their axes, by an extension. Other files are assumed to have the axes of PLY
    files, as most tools write them; Niantic's apps write ``"rub"``.

    Args:
        path: The file.
        axes: The axes of the file, as :func:`cvtgs.io.change_axes` names them, instead of those
            that it states; None for those that it states, else those of PLY files.
        trust_sizes: Whether the file may unpack to any size.

    Returns:
        The scene. SH bands above degree 3 are left out with a warning.

    Raises:
        InputNotFoundError: The file does not exist.
        InputError: It cannot be opened or read.
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
    if not trust_sizes:
        check_expansion(path, count=header.count, sh_degree=header.sh_degree, stored=len(content))
    read = _read_version_4 if header.version == 4 else _read_gzip
    blocks, extensions = read(content, header, path)
    stated = _stated_axes(extensions, path)
    if header.sh_degree > 3:
        warn(
            f"{path}: left out the SH bands above degree 3 (the file has degree "
            f"{header.sh_degree}), since a scene holds degree 0 to 3.",
            DroppedDataWarning,
        )
    antialiased = bool(header.flags & ANTIALIASED_FLAG)
    scene = scene_of(_unpack(header, blocks), antialiased=antialiased)
    return change_axes(scene, axes or stated or SCENE_AXES, SCENE_AXES)


def peek_spz(content: bytes, path: Path | str) -> SpzHeader:
    """Return the header of the bytes of an ``.spz`` file, without unpacking its Gaussians."""
    if content.startswith(MAGIC):
        return _header(content[: HEADER.size], path, versions=(4,))
    if not content.startswith(_GZIP):
        raise FileFormatError(
            f"{path}: an .spz file must start with the magic number of gzip or SPZ, "
            f"found {content[:4]!r}."
        )
    try:
        start = zlib.decompressobj(wbits=_GZIP_BITS).decompress(content, HEADER.size)
    except zlib.error as error:
        raise _damage(path, error) from error
    return _header(start, path, versions=(1, 2, 3))


def _unpack(header: SpzHeader, blocks: Blocks) -> Arrays:
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
    stream, wanted = zlib.decompressobj(wbits=_GZIP_BITS), sum(header.sizes.values())
    is_extended = bool(header.flags & EXTENSIONS_FLAG)
    most = _MOST_EXTENSION_BYTES if is_extended else 1
    try:
        stream.decompress(content, HEADER.size)
        payload = stream.decompress(stream.unconsumed_tail, wanted)
        surplus = stream.decompress(stream.unconsumed_tail, most)
    except zlib.error as error:
        raise _damage(path, error) from error
    if len(payload) < wanted:
        raise FileFormatError(
            f"{path}: must hold {wanted:,} bytes for the {header.count:,} Gaussians of SH degree "
            f"{header.sh_degree} that the header promises, found {len(payload):,}."
        )
    is_whole = sum(8 + size for _, size, _ in _records(surplus)) == len(surplus)
    if is_extended and (stream.unconsumed_tail or not is_whole):
        raise FileFormatError(  # a draft had them before the Gaussians, which are then others
            f"{path}: the extensions after the Gaussians must be whole records of at most "
            f"{_MOST_EXTENSION_BYTES:,} bytes together, found others; write it as version 4."
        )
    if surplus and not is_extended:
        warn(
            f"{path}: left out the bytes after the {header.count:,} Gaussians that the header "
            f"promises.",
            DroppedDataWarning,
        )
    elif not stream.eof:
        raise FileFormatError(f"{path}: must be intact gzip data, found it cut short.")
    ends = np.cumsum(list(header.sizes.values()), dtype=np.int64)[:-1]
    blocks = np.split(np.frombuffer(payload, np.uint8), ends)
    return dict(zip(header.sizes, blocks, strict=True)), surplus if is_extended else b""


def _read_version_4(content: bytes, header: SpzHeader, path: Path | str) -> tuple[Blocks, bytes]:
    """Return the blocks, and the extensions before them."""
    sizes = {name: size for name, size in header.sizes.items() if size}
    start = int.from_bytes(content[16:20], "little")  # of the table
    table = content[start : start + TABLE_ENTRY.size * len(sizes)]
    is_whole = start >= FOURTH_HEADER_BYTES and len(table) == TABLE_ENTRY.size * len(sizes)
    if header.streams != len(sizes) or not is_whole:
        raise FileFormatError(
            f"{path}: must hold {len(sizes)} blocks, found a table of {header.streams} at byte "
            f"{start:,} of {len(content):,}."
        )
    blocks = {"sh": np.empty(0, np.uint8)}
    at = start + TABLE_ENTRY.size * len(sizes)
    for (name, size), (packed, unpacked) in zip(
        sizes.items(), TABLE_ENTRY.iter_unpack(table), strict=True
    ):
        if unpacked != size or at + packed > len(content):
            raise FileFormatError(
                f"{path}: block {name!r} must have {size:,} bytes for {header.count:,} Gaussians, "
                f"found {unpacked:,} in {packed:,} compressed bytes of a file of {len(content):,}."
            )
        blocks[name] = _unzstd(content[at : at + packed], size, f"{path}: block {name!r}")
        at += packed
    return blocks, content[FOURTH_HEADER_BYTES:start] if header.flags & EXTENSIONS_FLAG else b""


def _damage(path: Path | str, error: zlib.error) -> FileFormatError:
    return FileFormatError(f"{path}: must be intact gzip data, found damage: {error}.")


def _records(extensions: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield the type, the stated size and the content of each record; the last may be cut."""
    at = 0
    while at + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, at)
        yield kind, size, extensions[at + 8 : at + 8 + size]
        at += 8 + size


def _stated_axes(extensions: bytes, path: Path | str) -> str | None:
    """Return the axes that extensions state."""
    axes = None
    for kind, size, content in _records(extensions):
        if kind == AXES_EXTENSION:
            number = int.from_bytes(content[:4], "little")
            if size != 4 or len(content) < 4 or number > len(AXES):
                raise FileFormatError(
                    f"{path}: the extension for the axes must hold a 4-byte number from 0 to "
                    f"{len(AXES)}, found {number} in {size:,} bytes."
                )
            axes = AXES[number - 1] if number else "rub"  # as Niantic's library takes it
    return axes


def _header(start: bytes, path: Path | str, *, versions: tuple[int, ...]) -> SpzHeader:
    if len(start) < HEADER.size or not start.startswith(MAGIC):
        raise FileFormatError(
            f"{path}: an .spz file must start with a header of {HEADER.size} bytes that begin "
            f"with {MAGIC!r}, found {len(start)} that begin with {start[:4]!r}."
        )
    _, *fields = HEADER.unpack(start)
    header = SpzHeader(*fields)
    if header.version not in versions:
        raise FileFormatError(
            f"{path}: the version of the .spz file must be 1 to 3, or 4 without gzip, "
            f"found {header.version}."
        )
    count, degree, bits = header.count, header.sh_degree, header.fractional_bits
    if count == 0 or degree >= len(STORED_REST_COUNTS) or bits > _MOST_BITS:
        raise FileFormatError(
            f"{path}: an .spz file must hold at least one Gaussian of SH degree 0 to 4 with at "
            f"most {_MOST_BITS} fractional bits, found {count:,} of degree {degree} with {bits}."
        )
    return header


def _unzstd(content: bytes, size: int, where: str) -> UInt8[np.ndarray, "b"]:
    """Decompress a block of known size."""
    import zstandard  # noqa: PLC0415 (only for version 4)

    try:
        with zstandard.ZstdDecompressor().stream_reader(content) as stream:
            data = stream.read(size + 1)
    except zstandard.ZstdError as error:
        raise FileFormatError(
            f"{where} must be intact zstd data, found damage: {error}."
        ) from error
    if len(data) != size:
        found = f"{len(data):,}" if len(data) < size else "more"
        raise FileFormatError(f"{where} must have {size:,} bytes, found {found}.")
    return np.frombuffer(data, np.uint8)
