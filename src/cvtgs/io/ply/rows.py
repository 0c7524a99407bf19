"""Read rows of PLY files that are too large to be read at once, and concatenate PLY files."""

import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cvtgs.errors import FileFormatError
from cvtgs.io.axes import SCENE_AXES, change_axes, checked_axes
from cvtgs.io.files import open_input
from cvtgs.io.ply.header import SCALARS, Layout, header_bytes, read_header
from cvtgs.io.ply.properties import check_size, find_vertices, layout_of
from cvtgs.io.ply.read import assemble, can_map
from cvtgs.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyRows:
    """The rows of a binary little endian PLY file, read on demand.

    Attributes:
        path: The file.
        count: Number of rows.
        names: Names and numpy types of the columns.
        layout: Names and PLY types of the columns, as a scene keeps them.
        comments: Comment lines of the file.
        offset: Where the first row starts, in bytes.
        sh_degree: SH bands above this degree are left out of scenes; None keeps all.
        axes: The axes of the file.
    """

    path: str
    count: int
    names: tuple[tuple[str, str], ...]
    layout: Layout
    comments: tuple[str, ...]
    offset: int
    sh_degree: int | None = None
    axes: str = SCENE_AXES

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of a row."""
        return np.dtype(list(self.names))

    def read(self, start: int, stop: int, step: int = 1) -> NDArray[Any]:
        """Map every ``step``-th row of a range into memory; pages are read on use."""
        place = self.offset + start * self.dtype.itemsize
        rows = np.memmap(self.path, self.dtype, "r", place, (stop - start,)).view(np.ndarray)
        return rows[::step]

    def scene(self, rows: NDArray[Any]) -> GaussianScene:
        """Build a scene from rows with at least the columns of the file, as a load returns it."""
        return self.assemble([rows], len(rows))

    def assemble(
        self, parts: Iterable[NDArray[Any]], count: int, *, is_slim: bool = False
    ) -> GaussianScene:
        """Build a scene from ``count`` rows in several parts, as :func:`cvtgs.load` returns it.

        A slim one lacks extra columns and SH bands above the constant one.
        """
        degree = 0 if is_slim else self.sh_degree
        scene = assemble(
            parts,
            count=count,
            layout=self.layout,
            comments=self.comments,
            sh_degree=degree,
            with_extras=not is_slim,
        )
        scene = scene if degree is None else scene.with_sh_degree(degree)
        return change_axes(scene, self.axes, SCENE_AXES)


def open_rows(
    path: str | os.PathLike[str], *, sh_degree: int | None = None, axes: str | None = None
) -> PlyRows:
    """Open a binary little endian PLY of a 3DGS scene, vertices first, without reading its rows.

    Scenes are converted from ``axes``, by default those of PLY files, and lack the SH bands above
    ``sh_degree``.
    """
    name = os.fspath(path)
    with open_input(Path(path)) as file:
        header = read_header(file, name)
        size = os.fstat(file.fileno()).st_size
    vertex = find_vertices(header, name)
    check_size(header, vertex, path=name, size=size)
    if not can_map(header):
        raise FileFormatError(
            f"{name}: only binary little endian PLY files with vertices first can be read in "
            f"parts; write one with cvtgs convert."
        )
    return PlyRows(
        path=name,
        count=vertex.count,
        names=tuple((prop.name, "<" + SCALARS[prop.type].code) for prop in vertex.properties),
        layout=layout_of(vertex),
        comments=header.comments,
        offset=header.data_offset,
        sh_degree=sh_degree,
        axes=SCENE_AXES if axes is None else checked_axes(axes),
    )


def join_plys(paths: Sequence[str | os.PathLike[str]], file: BinaryIO) -> int:
    """Write the concatenated rows of PLY files that have the same columns, and return their number.

    The comments are those of the first file. Memory is one buffer.
    """
    parts = [open_rows(path) for path in paths]
    first, total = parts[0], sum(part.count for part in parts)
    for part in parts:
        if part.names != first.names:
            raise FileFormatError(f"{part.path}: must have the same columns as {first.path}.")
    file.write(header_bytes(first.comments, [("vertex", total, first.layout)]))
    for part in parts:
        with Path(part.path).open("rb") as content:
            content.seek(part.offset)
            shutil.copyfileobj(content, file, 1 << 20)
    return total
