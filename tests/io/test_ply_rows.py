"""PLY files that are read in parts, and joined: what cannot be."""

import io
from pathlib import Path

import pytest

from cvtgs.errors import FileFormatError, InputError, InputNotFoundError
from cvtgs.io.ply import join_plys, open_rows
from ply_files import gaussian_properties, gaussian_rows, ply_bytes

PROPERTIES = gaussian_properties()
ROWS = gaussian_rows(PROPERTIES, 3)


@pytest.mark.parametrize("encoding", ["ascii", "binary_big_endian"])
def test_only_binary_little_endian_files_are_read_in_parts(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "scene.ply"
    path.write_bytes(ply_bytes(PROPERTIES, ROWS, encoding=encoding))
    with pytest.raises(FileFormatError) as caught:
        open_rows(path)
    assert str(caught.value) == (
        f"{path}: only binary little endian PLY files with vertices first can be read in parts; "
        f"write one with cvtgs convert."
    )


def test_files_that_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(InputNotFoundError, match=r"none\.ply: the file to read must exist"):
        open_rows(tmp_path / "none.ply")
    with pytest.raises(InputError, match="must be a regular file, found a directory"):
        open_rows(tmp_path)


def test_files_with_other_columns_are_not_joined(tmp_path: Path) -> None:
    first, second = tmp_path / "first.ply", tmp_path / "second.ply"
    first.write_bytes(ply_bytes(PROPERTIES, ROWS))
    second.write_bytes(ply_bytes([*PROPERTIES, ("q", "float")], [[*row, 1.0] for row in ROWS]))
    with pytest.raises(FileFormatError) as caught:
        join_plys([first, second], io.BytesIO())
    assert str(caught.value) == f"{second}: must have the columns of {first}."
