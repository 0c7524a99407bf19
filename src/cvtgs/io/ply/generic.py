"""The reader of every other PLY layout, on plyfile; the only file that imports it."""

import io
import warnings
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cvtgs.errors import FileFormatError
from cvtgs.io.ply.header import Element, Header

CHUNK_ROWS = 1 << 12
"""How many rows are handed on at a time; a cache holds them."""

_NOT_ASCII = bytes.maketrans(bytes(range(128, 256)), b"?" * 128)


def read_chunks(
    file: BinaryIO, header: Header, *, vertex: Element, path: str
) -> Iterator[NDArray[Any]]:
    """Read the vertex rows of any PLY file.

    ASCII rows and rows with lists are held in memory as a whole, others are mapped.
    """
    rows = _read_rows(file, header, vertex=vertex, path=path)
    for start in range(0, vertex.count, CHUNK_ROWS):
        yield rows[start : start + CHUNK_ROWS]


def _read_rows(file: BinaryIO, header: Header, *, vertex: Element, path: str) -> NDArray[Any]:
    from plyfile import PlyData, PlyElementParseError, PlyParseError  # noqa: PLC0415

    needed = header.elements[: header.elements.index(vertex) + 1]
    stream = _CleanStream(file, header, plain_header=_plain_header(header, needed))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy's, on empty lists
            data = PlyData.read(stream)[f"e{len(needed) - 1}"].data
    except PlyElementParseError as error:
        raise FileFormatError(_explain(error, needed, path)) from error
    except (PlyParseError, ValueError, OverflowError) as error:
        raise FileFormatError(
            f"{path}: every value must be a number of the type its property states, "
            f"found one that is not: {error}."
        ) from error
    rows: NDArray[Any] = data.view(np.ndarray)
    rows.dtype.names = tuple(prop.name for prop in vertex.properties)
    return rows


def _plain_header(header: Header, elements: tuple[Element, ...]) -> bytes:
    """Write the header as plyfile wants it: no blanks, comments or odd names; e0, p0, ..."""
    lines = ["ply", f"format {header.encoding} 1.0"]
    for i, element in enumerate(elements):
        if element.count == 0 or (header.encoding != "ascii" and not element.properties):
            continue  # no bytes
        lines.append(f"element e{i} {element.count}")
        for j, prop in enumerate(element.properties):
            length = f"list {prop.count_type} " if prop.count_type else ""
            lines.append(f"property {length}{prop.type} p{j}")
    return "\n".join([*lines, "end_header", ""]).encode()


class _CleanStream(io.BufferedIOBase):
    """A PLY file whose header has been replaced; positions are those of the real file."""

    def __init__(self, file: BinaryIO, header: Header, *, plain_header: bytes) -> None:
        self._file = file
        self._pending = io.BytesIO(plain_header)
        self._is_text = header.encoding == "ascii"
        self._size = file.seek(0, io.SEEK_END)
        file.seek(header.data_offset)

    def read(self, size: int | None = -1, /) -> bytes:
        """Read at most what is there; a negative length comes from a damaged list."""
        if size is None or size < 0:
            raise ValueError("a list cannot have a negative length")
        data = self._pending.read(size)
        if data or size == 0:
            return data
        data = self._file.read(min(size, self._size - self._file.tell()))
        return data.translate(_NOT_ASCII) if self._is_text else data

    def read1(self, size: int = -1, /) -> bytes:
        """Read as :meth:`read` does."""
        return self.read(size)

    def readable(self) -> bool:
        """Report yes."""
        return True

    def seekable(self) -> bool:
        """Report yes."""
        return True

    def tell(self) -> int:
        """Return the position in the real file."""
        return self._file.tell()

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Move in the real file."""
        return self._file.seek(offset, whence)

    def fileno(self) -> int:
        """Return the real file, for memory mapping."""
        return self._file.fileno()


def _explain(error: Any, elements: tuple[Element, ...], path: str) -> str:
    """Turn plyfile's error into one sentence with the file's own names."""
    element = elements[int(error.element.name[1:])]
    place = f"{path}: row {error.row} of {element.name!r}"
    if error.message == "early end-of-file":
        return (
            f"{path}: the file is cut short: its header promises {element.count:,} rows of "
            f"{element.name!r}, found {error.row:,}."
        )
    if error.prop is None:
        return f"{place} must hold {len(element.properties)} values, found more."
    prop = element.properties[int(error.prop.name[1:])]
    if error.message == "early end-of-line":
        return f"{place} must have a value for property {prop.name!r}, found the end of the line."
    kind = f"list of {prop.type}" if prop.count_type else prop.type
    return f"{place}: property {prop.name!r} must be a {kind}, found something unreadable."
