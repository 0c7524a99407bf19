"""Error messages about damaged files and files of other kinds, word for word."""

import contextlib
import os
import random
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from cvtgs.errors import (
    DroppedDataWarning,
    FileFormatError,
    InputError,
    MissingDependencyError,
)
from cvtgs.io import load
from cvtgs.io.ply import header
from cvtgs.io.ply.header import MAX_HEADER_BYTES
from ply_files import gaussian_properties, gaussian_rows, ply_bytes

PROPERTIES = gaussian_properties()
ROWS = gaussian_rows(PROPERTIES, 3)
GOOD = ply_bytes(PROPERTIES, ROWS)
ASCII = ply_bytes(PROPERTIES, ROWS, encoding="ascii")
ROW_BYTES = 17 * 4

NEEDED = (
    "a 3DGS scene must have the 'vertex' properties x, y, z, f_dc_0..2, opacity, scale_0..1 and "
    "rot_0..3, found none named "
)
SHORT = "the file is cut short: its header promises"


def without(*names: str) -> bytes:
    properties = [p for p in PROPERTIES if p[0] not in names]
    return ply_bytes(properties, gaussian_rows(properties, 1))


def with_rest(*numbers: int) -> bytes:
    properties = [*PROPERTIES, *((f"f_rest_{i}", "float") for i in numbers)]
    return ply_bytes(properties, gaussian_rows(properties, 1))


def with_list(name: str) -> bytes:
    properties = [(p, "list uchar float" if p == name else kind) for p, kind in PROPERTIES]
    row = [[1.0] if p == name else 0.0 for p, _ in PROPERTIES]
    return ply_bytes(properties, [row])


def ascii_row(number: int, change: Callable[[list[str]], None]) -> bytes:
    lines = ASCII.decode().splitlines()
    at = lines.index("end_header") + 1 + number
    words = lines[at].split()
    change(words)
    lines[at] = " ".join(words)
    return ("\n".join(lines) + "\n").encode()


def put(index: int, word: str) -> Callable[[list[str]], None]:
    return lambda words: words.__setitem__(index, word)


HEADER_CASES: Mapping[str, tuple[bytes, str]] = {
    "empty": (b"", "must be a PLY file, found an empty file."),
    "not a ply": (
        b"\x89PNG\r\n\x1a\n....",
        "a PLY file must start with the line 'ply', found b'\\x89PNG\\r\\n\\x1a\\n'.",
    ),
    "gzip": (
        b"\x1f\x8b\x08\x00",
        "a PLY file must start with the line 'ply', found a gzip file; unpack it first, or "
        "rename it if it is an .spz.",
    ),
    "zip": (
        b"PK\x03\x04\x14",
        "a PLY file must start with the line 'ply', found a zip archive; unpack it first, or "
        "rename it if it is a .sog.",
    ),
    "web page": (
        b"<!DOCTYPE html>",
        "a PLY file must start with the line 'ply', found a web page; failed downloads "
        "often leave one.",
    ),
    "plywood": (b"plywood", "a PLY file must start with the line 'ply', found b'plywood'."),
    "no end": (
        GOOD[:200],
        "the header must end with 'end_header', found none in 200 bytes.",
    ),
    "endless": (
        b"ply\n" + b"comment no end_header here\n" * (MAX_HEADER_BYTES // 20),
        "the header must end with 'end_header', found none in 1,048,576 bytes.",
    ),
    "nothing": (
        b"ply\nend_header\n",
        "the PLY header must have a format line, found none.",
    ),
    "version": (
        GOOD.replace(b"endian 1.0", b"endian 2.0"),
        "line 2 of the PLY header must be a valid format, element, property or comment line, "
        "found 'format binary_little_endian 2.0'.",
    ),
    "negative count": (
        GOOD.replace(b"vertex 3", b"vertex -3"),
        "line 3 of the PLY header must be a valid format, element, property or comment line, "
        "found 'element vertex -3'.",
    ),
    "absurd count": (
        GOOD.replace(b"vertex 3", b"vertex " + b"9" * 5000),
        "line 3 of the PLY header must be a valid format, element, property or comment line, "
        "found 'element vertex " + "9" * 65 + "'.",
    ),
    "unknown type": (
        GOOD.replace(b"property float opacity", b"property half opacity"),
        "line 13 of the PLY header must be a valid format, element, property or comment line, "
        "found 'property half opacity'.",
    ),
    "list of odd length type": (
        GOOD.replace(b"property float nx", b"property list float int nx"),
        "line 7 of the PLY header must be a valid format, element, property or comment line, "
        "found 'property list float int nx'.",
    ),
    "property first": (
        b"ply\nformat ascii 1.0\nproperty float x\nend_header\n",
        "line 3 of the PLY header must be a valid format, element, property or comment line, "
        "found 'property float x'.",
    ),
    "element twice": (
        ply_bytes(PROPERTIES, ROWS, after={"vertex2": ([("q", "int")], [[1]])}).replace(
            b"vertex2", b"vertex"
        ),
        "elements must have different names, found 'vertex' twice.",
    ),
    "property twice": (
        GOOD.replace(b"float rot_3", b"float rot_2"),
        "properties of element 'vertex' must have different names, found 'rot_2' twice.",
    ),
}

VERTEX_CASES: Mapping[str, tuple[bytes, str]] = {
    "no vertex": (
        GOOD.replace(b"element vertex", b"element splat"),
        "must have an element 'vertex', found 'splat'.",
    ),
    "no element": (
        b"ply\nformat ascii 1.0\nend_header\n",
        "must have an element 'vertex', found no element.",
    ),
    "no rows": (
        ply_bytes(PROPERTIES, []),
        "must hold at least one Gaussian, found 'element vertex 0'.",
    ),
    "one missing": (without("opacity"), NEEDED + "opacity."),
    "many missing": (without("y", "rot_0", "f_dc_2"), NEEDED + "y, f_dc_2, rot_0."),
    "point cloud": (
        ply_bytes([(name, "float") for name in "xyz"], [[1.0, 2.0, 3.0]]),
        NEEDED + "f_dc_0, f_dc_1, f_dc_2, opacity, scale_0, scale_1, rot_0, rot_1, rot_2, rot_3; "
        "train a scene from a point cloud or mesh first.",
    ),
    "list": (
        with_list("scale_1"),
        "property 'scale_1' must be a number, found a list.",
    ),
    "odd f_rest": (
        with_rest(*range(10)),
        "'vertex' must have 0, 9, 24 or 45 f_rest properties (SH degree 0 to 3) numbered from 0, "
        "found 10.",
    ),
    "f_rest gap": (
        with_rest(0, 1, 2, 4, 5, 6, 7, 8, 9),
        "'vertex' must have 0, 9, 24 or 45 f_rest properties (SH degree 0 to 3) numbered from 0, "
        "found 9, no f_rest_3.",
    ),
    "compressed": (
        ply_bytes(
            [("packed_position", "uint"), ("packed_rotation", "uint")],
            [[1, 2]],
            before={"chunk": ([("min_x", "float")], [[0.0]])},
        ),
        "element 'chunk' of a compressed PLY must have the float property 'min_y', found none.",
    ),
}

FACES = {"face": ([("corners", "list char int")], [[[0, 1, 2]], [[2, 1, 0]]])}
WITH_FACES = ply_bytes(PROPERTIES, ROWS, before=FACES)
FACE_START = WITH_FACES.index(b"end_header\n") + 11

DATA_CASES: Mapping[str, tuple[bytes, str]] = {
    "cut": (GOOD[: -ROW_BYTES - 1], f"{SHORT} 3 rows of 'vertex', found 1."),
    "header only": (
        GOOD[: -3 * ROW_BYTES],
        f"{SHORT} 3 rows of 'vertex', found 0.",
    ),
    "lying": (
        GOOD.replace(b"vertex 3", b"vertex 99999999999999"),
        f"{SHORT} 99,999,999,999,999 rows of 'vertex', found 3.",
    ),
    "big endian cut": (
        ply_bytes(PROPERTIES, ROWS, encoding="binary_big_endian")[:-1],
        f"{SHORT} 3 rows of 'vertex', found 2.",
    ),
    "lying ascii": (
        ASCII.replace(b"vertex 3", b"vertex 99999999999999"),
        f"{SHORT} 99,999,999,999,999 rows of 'vertex', found room for at most 7.",
    ),
    "cut ascii": (
        ASCII.replace(b"vertex 3", b"vertex 5"),
        f"{SHORT} 5 rows of 'vertex', found 3.",
    ),
    "cut behind faces": (
        WITH_FACES[:-1],
        f"{SHORT} 3 rows of 'vertex', found 2.",
    ),
    "lying behind faces": (
        WITH_FACES.replace(b"vertex 3", b"vertex 99999999999999"),
        f"{SHORT} 99,999,999,999,999 rows of 'vertex', found room for at most 3.",
    ),
    "list longer than the file": (
        WITH_FACES[:FACE_START] + b"\x7f" + WITH_FACES[FACE_START + 1 :],
        f"{SHORT} 2 rows of 'face', found 0.",
    ),
    "list of negative length": (
        WITH_FACES[:FACE_START] + b"\xff" + WITH_FACES[FACE_START + 1 :],
        f"{SHORT} 2 rows of 'face', found 0.",
    ),
    "word": (
        ascii_row(1, put(9, "opaque")),
        "row 1 of 'vertex': property 'opacity' must be a float, found an unreadable value.",
    ),
    "not ascii": (
        ascii_row(2, put(0, "\uff11")),
        "row 2 of 'vertex': property 'x' must be a float, found an unreadable value.",
    ),
    "number too few": (
        ascii_row(0, lambda words: words.pop(-1) and None),
        "row 0 of 'vertex' must have a value for 'rot_3', found the end of the line.",
    ),
    "number too many": (
        ascii_row(2, lambda words: words.append("1")),
        "row 2 of 'vertex' must hold 17 values, found more.",
    ),
}


CASES = {**HEADER_CASES, **VERTEX_CASES, **DATA_CASES}


@pytest.mark.parametrize(("data", "text"), CASES.values(), ids=CASES.keys())
def test_each_damage_has_its_own_message(tmp_path: Path, data: bytes, text: str) -> None:
    path = tmp_path / "damaged.ply"
    path.write_bytes(data)
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert str(caught.value) == f"{path}: {text}"


@pytest.mark.skipif(np.lib.NumpyVersion(np.__version__) < "2.0.0", reason="numpy 1 wraps them")
def test_integers_out_of_range_are_refused(tmp_path: Path) -> None:
    properties = [("label", "uchar"), *PROPERTIES]
    rows = [[7, *row] for row in ROWS]
    data = ply_bytes(properties, rows, encoding="ascii").replace(
        b"end_header\n7", b"end_header\n300"
    )
    (tmp_path / "s.ply").write_bytes(data)
    with pytest.raises(FileFormatError) as caught:
        load(tmp_path / "s.ply")
    assert str(caught.value).startswith(
        f"{tmp_path}/s.ply: every value must be of the type of its property, found another: "
    )


def test_a_file_cut_anywhere_is_a_format_error(tmp_path: Path) -> None:
    path = tmp_path / "s.ply"
    for data in (GOOD, ASCII, WITH_FACES):
        for length in range(0, len(data) - 1, 7):
            path.write_bytes(data[:length])
            with pytest.raises(FileFormatError):
                load(path)


@pytest.mark.slow
def test_random_damage_is_a_scene_or_a_format_error(tmp_path: Path) -> None:
    draw = random.Random(0)
    path = tmp_path / "s.ply"
    words = [
        b"list ",
        b"-1",
        b"99999999",
        b"\n",
        b"\x00",
        b"\xff",
        b"uint",
        b"end_header",
        b"1e999",
    ]
    for _ in range(600):
        data = bytearray(draw.choice([GOOD, ASCII, WITH_FACES]))
        at = draw.randrange(len(data))
        data[at : at + draw.randrange(9)] = draw.choice(words)
        path.write_bytes(data)
        with (
            warnings.catch_warnings(),
            contextlib.suppress(FileFormatError, DroppedDataWarning),
        ):
            load(path)


def test_a_file_that_becomes_shorter_while_it_is_read_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(GOOD)
    check = header.check_size

    def check_and_cut(*arguments: object, **options: object) -> None:
        check(*arguments, **options)  # type: ignore[arg-type]
        os.truncate(path, len(GOOD) // 2)

    monkeypatch.setattr(header, "check_size", check_and_cut)
    with pytest.raises(InputError, match="must stay as it is while it is read, found it shorter"):
        load(path)


def test_without_plyfile_unusual_files_say_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "plyfile", None)
    plain, unusual = tmp_path / "plain.ply", tmp_path / "ascii.ply"
    plain.write_bytes(GOOD)
    unusual.write_bytes(ASCII)
    assert len(load(plain)) == 3
    with pytest.raises(MissingDependencyError) as caught:
        load(unusual)
    assert str(caught.value) == (
        f"{unusual}: a PLY not in plain binary needs plyfile; "
        "install it with python -m pip install plyfile."
    )
