"""Read a compressed PLY file."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from cvtgs.errors import CvtgsError, FileFormatError
from cvtgs.io.arrays import Arrays, logits_of_bytes, scene_of, sh0_of_colors
from cvtgs.io.compressed_ply.layout import (
    CHUNK_ROWS,
    COLOR_BITS,
    PACKED,
    QUAT_BITS,
    RANGES,
    THREE_BITS,
    UNCOLORED,
    unpack,
)
from cvtgs.io.files import open_input
from cvtgs.io.ply.header import Element, Header, read_header
from cvtgs.io.ply.properties import SCALARS
from cvtgs.io.smallest_three import restore_largest
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import GaussianScene

Rows = NDArray[Any]


def is_compressed_ply(path: Path) -> bool:
    """Return by its header whether a PLY file is a compressed one, whatever its name.

    Args:
        path: A file.

    Returns:
        Whether its vertices are packed; False if it cannot be read.
    """
    try:
        with open_input(path) as file:
            elements = read_header(file, str(path)).elements
    except CvtgsError:
        return False
    return any(prop.name == PACKED[0] for table in elements for prop in table.properties)


def read_compressed_ply(path: Path) -> GaussianScene:
    """Read a compressed PLY file, as PlayCanvas' tools write it.

    Args:
        path: The file.

    Returns:
        The scene, with the comments of the file.

    Raises:
        InputNotFoundError: There is no such file.
        InputError: It cannot be opened or read.
        FileFormatError: It is not a compressed PLY file, or damaged.
    """
    with open_input(path) as file:
        header = read_header(file, str(path))
        _check(header, path)
        tables = _read_tables(file, header, path)
    ranges = _ranges(tables["chunk"])
    vertices = tables["vertex"]
    packed = {name: vertices[name] for name in PACKED}
    colors = unpack(packed["packed_color"], COLOR_BITS)
    opacities = (packed["packed_color"] & np.uint32(255)).astype(np.uint8)
    largest = (packed["packed_rotation"] >> np.uint32(30)).astype(np.int64)
    others = (unpack(packed["packed_rotation"], QUAT_BITS) - np.float32(0.5)) * np.sqrt(
        np.float32(2)
    )
    arrays = Arrays(
        means=_between(ranges[:, 0:6], unpack(packed["packed_position"], THREE_BITS)),
        quats=restore_largest(largest, others),
        log_scales=_between(ranges[:, 6:12], unpack(packed["packed_scale"], THREE_BITS)),
        logit_opacities=logits_of_bytes(opacities),
        sh0=sh0_of_colors(_between(ranges[:, 12:18], colors[:, :3])),
        shN=_rest(tables.get("sh"), len(vertices)),
    )
    return replace(scene_of(arrays), comments=header.comments)


def _between(
    ranges: Float[np.ndarray, "c 6"], fractions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    own = np.repeat(ranges, CHUNK_ROWS, axis=0)[: len(fractions)]
    values: Float[np.ndarray, "n 3"] = own[:, :3] * (1 - fractions) + own[:, 3:] * fractions
    return values


def _ranges(chunks: Rows) -> Float[np.ndarray, "c 18"]:
    """Return the ranges of each chunk; colours without any are in [0, 1]."""
    names = RANGES if RANGES[-1] in (chunks.dtype.names or ()) else RANGES[:UNCOLORED]
    ranges = np.tile(np.array([0, 0, 0, 1, 1, 1], np.float32), (len(chunks), 3))
    for column, name in enumerate(names):
        ranges[:, column] = chunks[name]
    return ranges


def _rest(rows: Rows | None, count: int) -> Float[np.ndarray, "n k 3"]:
    """Decode bytes that stand for [-4, 4]; the outermost mean the ends, others their middle."""
    if rows is None:
        return np.empty((count, 0, 3), np.float32)
    names = rows.dtype.names or ()
    stored: UInt8[np.ndarray, "n k"] = np.stack(
        [rows[f"f_rest_{i}"] for i in range(len(names))], axis=1
    )
    table = (np.arange(256, dtype=np.float32) + np.float32(0.5)) / 256
    table[[0, 255]] = 0, 1
    values: Float[np.ndarray, "n k"] = (8 * (table - np.float32(0.5)))[stored]
    return values.reshape(count, 3, -1).transpose(0, 2, 1)


def _check(header: Header, path: Path) -> None:
    found = {table.name: table for table in header.elements}
    if header.encoding != "binary_little_endian":
        raise FileFormatError(
            f"{path}: a compressed PLY must be binary_little_endian, found {header.encoding}."
        )
    for name, wanted, kind in (
        ("chunk", RANGES[:UNCOLORED], "float"),
        ("vertex", PACKED, "uint"),
    ):
        types = {prop.name: prop.type for prop in found[name].properties} if name in found else {}
        for prop in wanted:
            if types.get(prop) != kind:
                raise FileFormatError(
                    f"{path}: element {name!r} of a compressed PLY must have the {kind} property "
                    f"{prop!r}, found {types.get(prop, 'none')}."
                )
    vertices, chunks = found["vertex"].count, found["chunk"].count
    if vertices == 0 or chunks != -(-vertices // CHUNK_ROWS):
        raise FileFormatError(
            f"{path}: must hold at least one vertex and a chunk for every {CHUNK_ROWS} of them, "
            f"found {vertices:,} vertices and {chunks:,} chunks."
        )
    if "sh" in found:
        _check_rest(found["sh"], vertices, path)


def _check_rest(table: Element, vertices: int, path: Path) -> None:
    names = {prop.name for prop in table.properties if prop.type == "uchar"}
    counts = [3 * count for count in REST_COUNTS[1:]]
    wanted = {f"f_rest_{i}" for i in range(len(table.properties))}
    if names != wanted or len(names) not in counts or table.count != vertices:
        raise FileFormatError(
            f"{path}: element 'sh' must have 9, 24 or 45 uchar properties f_rest_0, f_rest_1, ... "
            f"for each of {vertices:,} vertices, found {len(names)} for {table.count:,}."
        )


def _read_tables(file: BinaryIO, header: Header, path: Path) -> dict[str, Rows]:
    """Read every element, after checking that the file holds them all."""
    if any(table.has_lists for table in header.elements):
        raise FileFormatError(f"{path}: a compressed PLY must hold no lists, found one.")
    dtypes = {
        table.name: np.dtype(
            [(prop.name, "<" + SCALARS[prop.type].code) for prop in table.properties]
        )
        for table in header.elements
    }
    wanted = header.data_offset + sum(
        table.count * dtypes[table.name].itemsize for table in header.elements
    )
    size = os.fstat(file.fileno()).st_size
    if size < wanted:
        raise FileFormatError(
            f"{path}: must have {wanted:,} bytes for the rows that its header promises, "
            f"found {size:,}."
        )
    file.seek(header.data_offset)
    return {
        table.name: np.fromfile(file, dtypes[table.name], table.count)
        for table in header.elements
        if table.properties
    }
