"""PlayCanvas' compressed PLY files: 16 bytes per Gaussian and one per view-dependent SH value."""

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float, UInt32
from numpy.typing import NDArray

from cvtgs.errors import FileFormatError
from cvtgs.io.arrays import (
    HALF_RANGE,
    Arrays,
    drop_largest,
    in_radii,
    logits_of_bytes,
    morton_rows,
    restore_largest,
    sh0_of_colors,
)
from cvtgs.io.files import open_input
from cvtgs.io.limits import FORMAT_LIMITS
from cvtgs.io.ply.header import Header, check_size, header_bytes, read_header, row_dtype
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import GaussianScene

__all__ = ["read_compressed_ply", "write_compressed_ply"]

Rows = NDArray[Any]

_CHUNK_ROWS = 256  # Gaussians in a chunk, which share its ranges
_FLYAWAY_RADII = 30.0  # of a flyaway from the middle, in radii that contain 90 % of the scene
_RANGES = tuple(  # properties of a chunk; the oldest files lack those of colours
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
)
_UNCOLORED = 12
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")  # of a vertex
_THREE_BITS = (11, 10, 11)  # bits of positions and scales
_COLOR_BITS = (8, 8, 8)  # bits of red, green and blue; the last 8 are those of the opacity
_QUAT_BITS = (10, 10, 10)  # of the smaller components; the top two bits index the missing one


def read_compressed_ply(path: Path) -> GaussianScene:
    """Read a compressed PLY file, as PlayCanvas' tools write it.

    Args:
        path: The file.

    Returns:
        The scene, with the comments of the file.

    Raises:
        InputNotFoundError: The file does not exist.
        InputError: It cannot be opened or read.
        FileFormatError: It is not a compressed PLY file, or damaged.
    """
    with open_input(path) as file:
        header = read_header(file, str(path))
        _check(header, path)
        check_size(file, header, header.elements[-1], str(path))
        file.seek(header.data_offset)
        tables = {
            table.name: np.fromfile(file, row_dtype(table.columns), table.count)
            for table in header.elements
            if table.properties
        }
    with np.errstate(all="ignore"):  # damaged ranges give non-finite numbers
        return _unpacked(tables).scene(comments=header.comments)


def _unpacked(tables: dict[str, Rows]) -> Arrays:
    ranges = _ranges(tables["chunk"])
    places, rotations, scales, rgba = (tables["vertex"][name] for name in _PACKED)
    opacities = (rgba & np.uint32(255)).astype(np.uint8)
    largest = (rotations >> np.uint32(30)).astype(np.int64)
    others = (_unpack(rotations, _QUAT_BITS) - np.float32(0.5)) * np.sqrt(np.float32(2))
    return Arrays(
        means=_between(ranges[:, 0:6], _unpack(places, _THREE_BITS)),
        quats=restore_largest(largest, others),
        log_scales=_between(ranges[:, 6:12], _unpack(scales, _THREE_BITS)),
        logit_opacities=logits_of_bytes(opacities),
        sh0=sh0_of_colors(_between(ranges[:, 12:18], _unpack(rgba >> np.uint32(8), _COLOR_BITS))),
        shN=_rest(tables.get("sh"), len(places)),
    )


def _between(
    ranges: Float[np.ndarray, "c 6"], fractions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    own = np.repeat(ranges, _CHUNK_ROWS, axis=0)[: len(fractions)]
    return np.asarray(own[:, :3] * (1 - fractions) + own[:, 3:] * fractions)


def _ranges(chunks: Rows) -> Float[np.ndarray, "c 18"]:
    """Return the ranges of each chunk; without ranges, colours are in [0, 1]."""
    names = _RANGES if _RANGES[-1] in (chunks.dtype.names or ()) else _RANGES[:_UNCOLORED]
    ranges = np.tile(np.array([0, 0, 0, 1, 1, 1], np.float32), (len(chunks), 3))
    for column, name in enumerate(names):
        ranges[:, column] = chunks[name]
    return ranges


def _rest(rows: Rows | None, count: int) -> Float[np.ndarray, "n k 3"]:
    """Decode bytes to [-4, 4]: 0 and 255 to the ends, others to the centres of their steps."""
    if rows is None:
        return np.empty((count, 0, 3), np.float32)
    stored = np.stack([rows[f"f_rest_{i}"] for i in range(len(rows.dtype.names or ()))], axis=1)
    table = (np.arange(256, dtype=np.float32) + np.float32(0.5)) / 256
    table[[0, 255]] = 0, 1
    values: Float[np.ndarray, "n k"] = (8 * (table - np.float32(0.5)))[stored]
    return values.reshape(count, 3, -1).transpose(0, 2, 1)


def _check(header: Header, path: Path) -> None:
    tables = {table.name: dict(table.columns) for table in header.elements}
    counts = {table.name: table.count for table in header.elements}
    has_lists = any(table.has_lists for table in header.elements)
    if header.encoding != "binary_little_endian" or has_lists:
        raise FileFormatError(
            f"{path}: a compressed PLY must be binary_little_endian without lists, found "
            f"{'a list' if has_lists else header.encoding}."
        )
    is_colored = any(name in _RANGES[_UNCOLORED:] for name in tables.get("chunk", ()))
    for name, wanted, kind in (
        ("chunk", _RANGES if is_colored else _RANGES[:_UNCOLORED], "float"),
        ("vertex", _PACKED, "uint"),
    ):
        types = tables.get(name, {})
        for prop in wanted:
            if types.get(prop) != kind:
                raise FileFormatError(
                    f"{path}: element {name!r} of a compressed PLY must have the {kind} property "
                    f"{prop!r}, found {types.get(prop, 'none')}."
                )
    vertices, chunks = counts["vertex"], counts["chunk"]
    if vertices == 0 or chunks != -(-vertices // _CHUNK_ROWS):
        raise FileFormatError(
            f"{path}: must hold at least one vertex and a chunk for every {_CHUNK_ROWS} of them, "
            f"found {vertices:,} vertices and {chunks:,} chunks."
        )
    rest = tables.get("sh")
    if not rest:  # gsplat writes an empty one at SH degree 0
        return
    names = {name for name, kind in rest.items() if kind == "uchar"}
    own = {f"f_rest_{i}" for i in range(len(rest))}
    known = [3 * count for count in REST_COUNTS]
    if names != own or len(names) not in known or counts["sh"] != vertices:
        raise FileFormatError(
            f"{path}: element 'sh' must have 9, 24 or 45 uchar properties f_rest_0, f_rest_1, ... "
            f"for each of {vertices:,} vertices, found {len(names)} for {counts['sh']:,}."
        )


def write_compressed_ply(scene: GaussianScene, file: BinaryIO) -> None:
    """Write a compressed PLY file.

    Rows are sorted along a Morton curve, so that the 256 Gaussians of a chunk lie close together
    and their common ranges are small. Flyaways come last.
    """
    arrays = Arrays.of(scene)
    order = _flyaways_last(arrays, morton_rows(arrays.means))
    rest = arrays.shN[order].transpose(0, 2, 1).reshape(len(order), -1)
    elements = [
        ("chunk", -(-len(order) // _CHUNK_ROWS), tuple((name, "float") for name in _RANGES)),
        ("vertex", len(order), tuple((name, "uint") for name in _PACKED)),
    ]
    if rest.shape[1]:
        names = (f"f_rest_{i}" for i in range(rest.shape[1]))
        elements.append(("sh", len(order), tuple((name, "uchar") for name in names)))
    file.write(header_bytes(scene.comments, elements))
    log_scales = np.clip(arrays.log_scales, *FORMAT_LIMITS[".compressed.ply"].ranges["log_scales"])
    opacities = arrays.opacity_bytes[order].astype(np.uint32)
    place, place_range = _fractions(arrays.means[order])
    scale, scale_range = _fractions(log_scales[order])
    color, color_range = _fractions(arrays.colors[order])
    largest, others = drop_largest(arrays.quats[order])
    words = [
        _pack(place, _THREE_BITS),
        largest.astype(np.uint32) << np.uint32(30) | _pack(others * HALF_RANGE + 0.5, _QUAT_BITS),
        _pack(scale, _THREE_BITS),
        _pack(color, _COLOR_BITS) << np.uint32(8) | opacities,
    ]
    ranges = np.concatenate([place_range, scale_range, color_range], axis=1)
    file.write(ranges.astype("<f4").tobytes())
    file.write(np.stack(words, axis=1).astype("<u4").tobytes())
    steps = np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255)
    file.write(steps.astype(np.uint8).tobytes())


def _flyaways_last(arrays: Arrays, order: NDArray[np.int64]) -> NDArray[np.int64]:
    """Move flyaways to the last chunks, whose positions they round coarsely.

    The first of these is filled up with those of the other Gaussians that are least visible.
    """
    far = np.abs(in_radii(arrays.means)).max(axis=1) > _FLYAWAY_RADII
    count, total = int(far.sum()), len(order)
    others = (total - count) % _CHUNK_ROWS
    if count == 0 or others == total - count:
        return order
    areas = np.sort(arrays.log_scales, axis=1)[:, 1:].sum(axis=1)
    visible = areas + np.minimum(arrays.logit_opacities, 0)  # about the logarithm of the mass
    visible[far] = np.inf
    last = far.copy()
    last[np.argsort(visible, kind="stable")[:others]] = True
    faint, far = (last & ~far)[order], far[order]
    return np.concatenate([order[~last[order]], order[faint], order[far]])


def _fractions(
    values: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "c 6"]]:
    """Return values as fractions of the range of their chunk, and the ranges."""
    starts = np.arange(0, len(values), _CHUNK_ROWS)
    halves = values / 2  # exact, and no difference of two of them overflows
    low, high = np.minimum.reduceat(halves, starts), np.maximum.reduceat(halves, starts)
    size = np.diff(np.append(starts, len(values)))
    below, width = np.repeat(low, size, axis=0), np.repeat(high - low, size, axis=0)
    fractions = np.where(width > 0, (halves - below) / np.where(width > 0, width, 1), 0)
    return fractions, 2 * np.concatenate([low, high], axis=1)


def _pack(fractions: Float[np.ndarray, "n k"], bits: tuple[int, ...]) -> UInt32[np.ndarray, "n"]:
    """Pack fractions side by side into the low bits of 32."""
    words = np.zeros(len(fractions), np.uint32)
    for column, size in zip(fractions.T, bits, strict=True):
        most = (1 << size) - 1
        field = np.clip(np.floor(column * most + 0.5), 0, most).astype(np.uint32)
        words = (words << np.uint32(size)) | field
    return words


def _unpack(words: UInt32[np.ndarray, "n"], bits: tuple[int, ...]) -> Float[np.ndarray, "n k"]:
    """Unpack fractions from 32 bits, the inverse of :func:`_pack`."""
    fractions = np.empty((len(words), len(bits)), np.float32)
    shift = sum(bits)
    for column, size in enumerate(bits):
        shift -= size
        most = (1 << size) - 1
        fractions[:, column] = ((words >> np.uint32(shift)) & np.uint32(most)) / np.float32(most)
    return fractions
