"""The memory-mapped reader of the common layout: binary little endian, vertices first."""

from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cvtgs.io.ply.header import Element, Header
from cvtgs.io.ply.properties import SCALARS

CHUNK_BYTES = 1 << 20
"""How much of a file is mapped at a time; a chunk and its copy fit in the second-level cache."""


def can_read(header: Header) -> bool:
    """Return whether the vertex rows can be mapped as they are."""
    first = header.elements[0]
    little = header.encoding == "binary_little_endian"
    return little and first.name == "vertex" and not first.has_lists


def read_chunks(file: BinaryIO, header: Header) -> Iterator[NDArray[Any]]:
    """Map the vertex rows, a megabyte at a time.

    Each chunk is unmapped when the caller lets go of it, so the file's pages do not add up:
    memory is one or two chunks.
    """
    vertex = header.elements[0]
    dtype = _record_dtype(vertex)
    rows = max(1, CHUNK_BYTES // dtype.itemsize)
    for start in range(0, vertex.count, rows):
        offset = header.data_offset + start * dtype.itemsize
        shape = (min(rows, vertex.count - start),)
        yield np.memmap(file, dtype, "r", offset, shape).view(np.ndarray)


def _record_dtype(vertex: Element) -> np.dtype[Any]:
    return np.dtype([(prop.name, "<" + SCALARS[prop.type].code) for prop in vertex.properties])
