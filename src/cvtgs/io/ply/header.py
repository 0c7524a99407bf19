"""The header of a PLY file, and the only mapping from PLY names to tensors of a scene."""

import os
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
from cvtgs.math.spherical_harmonics import REST_COUNTS
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
MAX_NAME_LETTERS = 200
_REST_NAME = re.compile(r"f_rest_(0|[1-9][0-9]*)")


class ScalarType(NamedTuple):
    """A PLY number type."""

    code: str  # of numpy, without byte order
    dtype: torch.dtype  # holds every value, and every operation of torch supports it


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
_TYPE_NAMES: Mapping[str, str] = {  # canonical names by all names, such as uchar and uint8
    alias: name for name, kind in SCALARS.items() for alias in (name, np.dtype(kind.code).name)
}
FLOAT_TYPES = ("float", "double")
_LENGTH_NAMES = [name for name, kind in _TYPE_NAMES.items() if kind not in FLOAT_TYPES]


@dataclass(frozen=True, slots=True, kw_only=True)
class Property:
    """One property line."""

    name: str
    type: str  # canonical name of the number type (of the items, for a list)
    count_type: str | None = None  # of the length of a list; None for a plain number


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
    data_offset: int  # where the first row starts, in bytes


def read_header(file: BinaryIO, path: str) -> Header:
    """Parse a header; lines may end in LF, CRLF or CR and have trailing blanks, or be blank."""
    lines, data_offset = _header_lines(file.read(MAX_HEADER_BYTES), path)
    encoding: Encoding | None = None
    tables: list[tuple[str, int, list[Property]]] = []
    comments: list[str] = []
    for number, line in enumerate(lines, start=2):
        match line.split():
            case []:
                pass
            case ["comment" | "obj_info" as word, *_]:  # both are free text
                comments.append(line.lstrip()[len(word) + 1 :].rstrip())
            case ["format", kind, "1.0"] if encoding is None and kind in get_args(Encoding):
                encoding = kind  # type: ignore[assignment]
            case ["element", name, count] if _COUNT.fullmatch(count) and is_name(name):
                tables.append((name, int(count), []))
            case ["property", "list", length, kind, name] if (
                tables and length in _LENGTH_NAMES and kind in _TYPE_NAMES and is_name(name)
            ):
                tables[-1][2].append(
                    Property(name=name, type=_TYPE_NAMES[kind], count_type=_TYPE_NAMES[length])
                )
            case ["property", kind, name] if tables and kind in _TYPE_NAMES and is_name(name):
                tables[-1][2].append(Property(name=name, type=_TYPE_NAMES[kind]))
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
            f"{path}: the header must end with 'end_header', found none in {len(block):,} bytes."
        )
    lines = block[first.end() : max(first.end(), end.start())].split(newline)
    return [_decode(line).replace("\n", " ") for line in lines], end.end()


def _decode(line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")


def is_name(text: str) -> bool:
    """Return whether a name is short enough for error texts; real ones have about 20 letters."""
    return len(text) <= MAX_NAME_LETTERS


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
    tables = [{prop.name for prop in table.properties} for table in elements]
    return any("packed_position" in names and "x" not in names for names in tables)


def header_bytes(comments: Iterable[str], elements: Iterable[tuple[str, int, Layout]]) -> bytes:
    """Return the header of a binary little endian file; elements are (name, rows, columns)."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for comment in comments:
        if "\n" in comment:
            raise InvalidSceneError(f"a PLY comment must be one line, found {comment[:80]!r}.")
        lines.append(f"comment {comment}".rstrip())
    for name, count, columns in elements:
        lines.append(f"element {name} {count}")
        lines += [f"property {kind} {column}" for column, kind in columns]
    try:
        header = "\n".join([*lines, "end_header", ""]).encode()
    except UnicodeEncodeError as error:
        raise InvalidSceneError(
            f"comments and columns must be Unicode text, found {shown(error.object[error.start])}."
        ) from None
    if len(header) > MAX_HEADER_BYTES:
        raise InvalidSceneError(
            f"a PLY header must take at most {MAX_HEADER_BYTES:,} bytes, found {len(header):,}."
        )
    return header


def row_dtype(columns: Layout) -> np.dtype[Any]:
    """Return the numpy type of a row of a binary little endian file."""
    return np.dtype([(name, "<" + SCALARS[kind].code) for name, kind in columns])


class Slot(NamedTuple):
    """The tensor of a property in a scene, and the index of its column, such as ``(..., 0)``."""

    tensor: str
    column: tuple[Any, ...]


def standard_slots(rest_count: int) -> dict[str, Slot]:
    """Return the standard properties in INRIA's order with their slots."""
    return {
        **{name: Slot("means", (..., i)) for i, name in enumerate("xyz")},
        **{f"f_dc_{c}": Slot("sh0", (..., 0, c)) for c in range(3)},
        **{
            f"f_rest_{c * rest_count + j}": Slot("shN", (..., j, c))
            for c in range(3)
            for j in range(rest_count)
        },
        "opacity": Slot("logit_opacities", (...,)),
        **{f"scale_{i}": Slot("log_scales", (..., i)) for i in range(3)},
        **{f"rot_{i}": Slot("quats", (..., i)) for i in range(4)},
    }


def is_standard(name: str) -> bool:
    """Return whether a property is one of the scene's own, of any SH degree."""
    return name in standard_slots(0) or rest_index(name) is not None


def rest_index(name: str) -> int | None:
    """Return the number of an ``f_rest_*`` property."""
    match = _REST_NAME.fullmatch(name)
    return int(match[1]) if match else None


def dtype_of(layout: Layout) -> torch.dtype:
    """Return the dtype of a scene that was read from this layout."""
    types = dict(layout)
    double = any(types.get(axis) == "double" for axis in "xyz")
    return torch.float64 if double else torch.float32


def find_vertices(header: Header, path: str) -> Element:
    """Find the vertex element and check that it holds Gaussians."""
    vertex = next((element for element in header.elements if element.name == "vertex"), None)
    if vertex is None:
        found = ", ".join(shown(element.name) for element in header.elements[:5]) or "no element"
        found += ", ..." if len(header.elements) > 5 else ""
        raise FileFormatError(f"{path}: must have an element 'vertex', found {found}.")
    scalars = {prop.name: prop.count_type is None for prop in vertex.properties}
    lists = [name for name, scalar in scalars.items() if is_standard(name) and not scalar]
    if lists:
        raise FileFormatError(f"{path}: property {shown(lists[0])} must be a number, found a list.")
    needed = standard_slots(0).keys() - {"scale_2"}  # 2DGS has two scales
    missing = [name for name in standard_slots(0) if name in needed and name not in scalars]
    if missing:
        names = ", ".join(missing)
        is_cloud = set(missing) == needed - set("xyz")
        hint = "; train a scene from a point cloud or mesh first" if is_cloud else ""
        raise FileFormatError(
            f"{path}: a 3DGS scene must have the 'vertex' properties x, y, z, f_dc_0..2, opacity, "
            f"scale_0..1 and rot_0..3, found none named {names}{hint}."
        )
    numbers = sorted(number for name in scalars if (number := rest_index(name)) is not None)
    gap = next((i for i, number in enumerate(numbers) if i != number), None)
    if gap is not None or len(numbers) not in [3 * count for count in REST_COUNTS]:
        raise FileFormatError(
            f"{path}: 'vertex' must have 0, 9, 24 or 45 f_rest properties (SH degree 0 to 3) "
            f"numbered from 0, found {len(numbers)}{'' if gap is None else f', no f_rest_{gap}'}."
        )
    if vertex.count == 0:
        raise FileFormatError(f"{path}: must hold at least one Gaussian, found 'element vertex 0'.")
    return vertex


def check_size(file: BinaryIO, header: Header, table: Element, path: str) -> None:
    """Check that a file is long enough for an element, before memory is allocated for its rows."""
    before = header.elements[: header.elements.index(table)]
    room = os.fstat(file.fileno()).st_size - header.data_offset
    room -= sum(element.count * element.row_bytes(header.encoding) for element in before)
    if header.encoding == "ascii":
        room += 1  # the last line may lack its newline
    row_bytes = table.row_bytes(header.encoding)
    if table.count * row_bytes > room:
        exact = header.encoding != "ascii" and not any(one.has_lists for one in (*before, table))
        rows = max(room, 0) // max(row_bytes, 1)
        raise FileFormatError(
            f"{path}: the file is cut short: its header promises {table.count:,} rows of "
            f"{shown(table.name)}, found {'' if exact else 'room for at most '}{rows:,}."
        )


def layout_of(vertex: Element) -> Layout:
    """Return the layout that a scene is written with: no lists, and no whole standard values."""
    float_type = "double" if dtype_of(vertex.columns) == torch.float64 else "float"
    return tuple(
        (name, float_type if is_standard(name) and kind not in FLOAT_TYPES else kind)
        for name, kind in vertex.columns
    )
