"""PLY files for tests, written byte by byte, without cvtgs."""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

CODES = {
    "char": "b", "int8": "b", "uchar": "B", "uint8": "B", "short": "h", "int16": "h",
    "ushort": "H", "uint16": "H", "int": "i", "int32": "i", "uint": "I", "uint32": "I",
    "float": "f", "float32": "f", "double": "d", "float64": "d",
}  # fmt: skip

ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}

Row = Sequence[float | Sequence[float]]
Properties = Sequence[tuple[str, str]]


def gaussian_properties(rest: int = 0, *, kind: str = "float", normals: bool = True) -> Properties:
    """Return the properties of INRIA's files in their order."""
    names = [*"xyz", *(["nx", "ny", "nz"] if normals else [])]
    names += [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(rest)]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    return [(name, kind) for name in names]


def gaussian_rows(properties: Properties, count: int) -> list[list[float]]:
    """Return rows whose value in column j of row i is 0.25 i + j, and 0 for normals."""
    return [
        [
            0.0 if name in ("nx", "ny", "nz") else 0.25 * i + j
            for j, (name, _) in enumerate(properties)
        ]
        for i in range(count)
    ]


def encode_row(properties: Properties, row: Row, encoding: str) -> bytes:
    """Encode one row; the type of a list is ``"list uchar int"``."""
    words: list[str] = []
    binary = b""
    for (_, kind), value in zip(properties, row, strict=True):
        if kind.startswith("list"):
            _, length, item = kind.split()
            assert isinstance(value, Sequence)
            pairs = [(length, float(len(value))), *((item, v) for v in value)]
        else:
            assert not isinstance(value, Sequence)
            pairs = [(kind, value)]
        for name, number in pairs:
            whole = CODES[name] not in "fd"
            words.append(str(int(number)) if whole else repr(float(number)))
            binary += struct.pack(ORDERS[encoding] + CODES[name], int(number) if whole else number)
    return (" ".join(words) + "\n").encode() if encoding == "ascii" else binary


def element_header(name: str, properties: Properties, count: int) -> list[str]:
    """Return the header lines of one element."""
    return [f"element {name} {count}", *(f"property {kind} {prop}" for prop, kind in properties)]


def ply_bytes(
    properties: Properties,
    rows: Sequence[Row],
    *,
    encoding: str = "binary_little_endian",
    before: Mapping[str, tuple[Properties, Sequence[Row]]] | None = None,
    after: Mapping[str, tuple[Properties, Sequence[Row]]] | None = None,
    comments: Sequence[str] = (),
    newline: str = "\n",
) -> bytes:
    """Return a whole PLY file with a vertex element between others."""
    elements = {**(before or {}), "vertex": (properties, rows), **(after or {})}
    lines = ["ply", f"format {encoding} 1.0", *(f"comment {text}" for text in comments)]
    for name, (columns, values) in elements.items():
        lines += element_header(name, columns, len(values))
    header = newline.join([*lines, "end_header", ""]).encode()
    body = b"".join(
        encode_row(columns, row, encoding)
        for columns, values in elements.values()
        for row in values
    )
    return header + body


def write_ply_file(
    path: Path, properties: Properties, rows: Sequence[Row], **options: object
) -> Path:
    """Write a PLY file and return its path."""
    path.write_bytes(ply_bytes(properties, rows, **options))  # type: ignore[arg-type]
    return path


def parse_header(data: bytes) -> tuple[list[str], int]:
    """Return the header lines of a file that cvtgs wrote, and the offset of its data."""
    end = data.index(b"end_header\n") + len(b"end_header\n")
    return data[:end].decode().splitlines(), end
