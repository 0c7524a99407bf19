"""Read the header of a PLY file as a small typed value, and write it."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple, get_args

import numpy as np
import torch

from cvtgs.errors import CvtgsError, FileFormatError, InvalidSceneError
from cvtgs.io.files import open_input
from cvtgs.text import shown

Encoding = Literal["ascii", "binary_little_endian", "binary_big_endian"]

Layout = tuple[tuple[str, str], ...]  # property names and PLY types of an element, in order
MAX_HEADER_BYTES = 1 << 20  # longer headers are refused; a 3DGS header has about two thousand bytes

_OTHER_FILES = {
    b"\x1f\x8b": "a gzip file; unpack it first, or rename it if it is an .spz",
    b"PK\x03\x04": "a zip archive; unpack it first, or rename it if it is a .sog",
    b"<": "a web page; failed downloads often leave one",
}
_COUNT = re.compile("[0-9]{1,18}")
_MAX_NAME_LETTERS = 200


class ScalarType(NamedTuple):
    """A PLY number type."""

    code: str
    """The numpy type, without byte order."""
    dtype: torch.dtype
    """The torch dtype that holds every value and that every torch operation supports."""


SCALARS: Mapping[str, ScalarType] = {
    "char": ScalarType("i1", torch.int8),
    "uchar": ScalarType("u1", torch.uint8),
    "short": ScalarType("i2", torch.int16),
    "ushort": ScalarType("u2", torch.int32),
    "int": ScalarType("i4", torch.int32),
    "uint": ScalarType("u4", torch.int64),
    "float": ScalarType("f4", torch.float32),
    "double": ScalarType("f8", torch.float64),
}
"""PLY number types by their canonical names."""

TYPE_NAMES: Mapping[str, str] = {
    **{name: name for name in SCALARS},
    "int8": "char",
    "uint8": "uchar",
    "int16": "short",
    "uint16": "ushort",
    "int32": "int",
    "uint32": "uint",
    "float32": "float",
    "float64": "double",
}
"""Canonical names of PLY number types, by all their names."""

FLOAT_TYPES = ("float", "double")
_LENGTH_NAMES = [name for name, kind in TYPE_NAMES.items() if kind not in FLOAT_TYPES]


@dataclass(frozen=True, slots=True, kw_only=True)
class Property:
    """One property line."""

    name: str
    type: str
    """Canonical name of the number type (of the items, for a list)."""
    count_type: str | None = None
    """Number type of the length of a list; None for a plain number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Element:
    """One element: a table of rows."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether rows differ in length."""
        return any(prop.count_type for prop in self.properties)

    @property
    def columns(self) -> Layout:
        """Names and types of the properties, without lists."""
        return tuple((prop.name, prop.type) for prop in self.properties if not prop.count_type)

    def row_bytes(self, encoding: Encoding) -> int:
        """Return the minimum size of a row in bytes, with empty lists."""
        if encoding == "ascii":
            return 2 * len(self.properties)
        kinds = [prop.count_type or prop.type for prop in self.properties]
        return sum(np.dtype(SCALARS[kind].code).itemsize for kind in kinds)


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """A parsed header; elements and comments are in the order of the file."""

    encoding: Encoding
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    data_offset: int
    """Where the first row starts, in bytes."""


def read_header(file: BinaryIO, path: str) -> Header:
    """Parse the header of a PLY file.

    Lines may end in LF, CRLF or CR and have trailing blanks; blank lines are skipped.
    """
    lines, data_offset = _header_lines(file.read(MAX_HEADER_BYTES), path)
    encoding: Encoding | None = None
    tables: list[tuple[str, int, list[Property]]] = []
    comments: list[str] = []
    for number, line in enumerate(lines, start=2):
        match line.split():
            case [] | ["obj_info", *_]:
                pass
            case ["comment", *_]:
                comments.append(line.lstrip()[len("comment ") :].rstrip())
            case ["format", kind, "1.0"] if encoding is None and kind in get_args(Encoding):
                encoding = kind  # type: ignore[assignment]
            case ["element", name, count] if _COUNT.fullmatch(count) and _is_name(name):
                tables.append((name, int(count), []))
            case ["property", "list", length, kind, name] if (
                tables and length in _LENGTH_NAMES and kind in TYPE_NAMES and _is_name(name)
            ):
                tables[-1][2].append(
                    Property(name=name, type=TYPE_NAMES[kind], count_type=TYPE_NAMES[length])
                )
            case ["property", kind, name] if tables and kind in TYPE_NAMES and _is_name(name):
                tables[-1][2].append(Property(name=name, type=TYPE_NAMES[kind]))
            case _:
                raise FileFormatError(
                    f"{path}: line {number} of the PLY header must be a valid format, element, "
                    f"property or comment line, found {line.strip()[:80]!r}."
                )
    if encoding is None:
        raise FileFormatError(f"{path}: the PLY header must have a format line, found none.")
    elements = tuple(
        Element(name=name, count=count, properties=tuple(properties))
        for name, count, properties in tables
    )
    _check_unique(elements, f"{path}: elements")
    for element in elements:
        _check_unique(element.properties, f"{path}: properties of element {shown(element.name)}")
    return Header(
        encoding=encoding, elements=elements, comments=tuple(comments), data_offset=data_offset
    )


def _header_lines(block: bytes, path: str) -> tuple[list[str], int]:
    """Return the lines between ``ply`` and ``end_header``, and where the data starts."""
    if not block:
        raise FileFormatError(f"{path}: must be a PLY file, found an empty file.")
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", block)
    if not first:
        kinds = (kind for start, kind in _OTHER_FILES.items() if block.startswith(start))
        found = next(kinds, repr(block[:8]))
        raise FileFormatError(f"{path}: a PLY file must start with the line 'ply', found {found}.")
    old_mac = first[1] == b"\r"
    newline, blanks = (b"\r", rb"[ \t]*") if old_mac else (b"\n", rb"[ \t]*\r?")
    end = re.compile(newline + rb"[ \t]*end_header" + blanks + newline).search(
        block, first.end() - 1
    )
    if not end:
        raise FileFormatError(
            f"{path}: the PLY header must end with a line 'end_header', found none in the first "
            f"{len(block):,} bytes."
        )
    lines = block[first.end() : max(first.end(), end.start())].split(newline)
    return [_decode(line).replace("\n", " ") for line in lines], end.end()


def _decode(line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def _is_name(text: str) -> bool:
    """Return whether a name is short enough for error texts; real ones have about 20 letters."""
    return len(text) <= _MAX_NAME_LETTERS


def _check_unique(named: Sequence[Element | Property], what: str) -> None:
    for name, count in Counter(one.name for one in named).items():
        if count > 1:
            raise FileFormatError(f"{what} must have different names, found {shown(name)} twice.")


def is_compressed_ply(path: Path) -> bool:
    """Return whether a PLY file of any name has packed vertices; False if unreadable."""
    try:
        with open_input(path) as file:
            elements = read_header(file, str(path)).elements
    except CvtgsError:
        return False
    return any(prop.name == "packed_position" for table in elements for prop in table.properties)


def header_bytes(comments: Iterable[str], elements: Iterable[tuple[str, int, Layout]]) -> bytes:
    """Return the header of a binary little endian file; elements are (name, rows, columns)."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for comment in comments:
        if "\n" in comment:
            raise InvalidSceneError(
                f"a comment must be one line to be written to a PLY, found {comment[:80]!r}."
            )
        lines.append(f"comment {comment}".rstrip())
    for name, count, columns in elements:
        lines.append(f"element {name} {count}")
        lines += [f"property {kind} {column}" for column, kind in columns]
    try:
        header = "\n".join([*lines, "end_header", ""]).encode()
    except UnicodeEncodeError as error:
        raise InvalidSceneError(
            f"comments and names of columns must be Unicode text to be written to a PLY, found "
            f"{shown(error.object[error.start])}."
        ) from None
    if len(header) > MAX_HEADER_BYTES:
        raise InvalidSceneError(
            f"comments and names of columns must take at most {MAX_HEADER_BYTES:,} bytes to be "
            f"written to a PLY, found {len(header):,}."
        )
    return header


def row_dtype(columns: Layout) -> np.dtype[Any]:
    """Return the numpy type of a row of a binary little endian file."""
    return np.dtype([(name, "<" + SCALARS[kind].code) for name, kind in columns])
