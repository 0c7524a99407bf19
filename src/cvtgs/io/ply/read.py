"""Read PLY scenes, at once or in parts; plyfile, imported only here, reads uncommon layouts."""

import io
import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.counts import checked_whole
from cvtgs.errors import (
    DroppedDataWarning,
    FileFormatError,
    InputError,
    MissingDependencyError,
    how_to_install,
    reason_of,
    warn,
)
from cvtgs.io.axes import SCENE_AXES, change_axes, checked_axes
from cvtgs.io.files import open_input
from cvtgs.io.ply import header as ply
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import FLAT_LOG_SCALE, NORMALS, GaussianScene
from cvtgs.text import first_of, shown

CHUNK_BYTES = 1 << 20  # mapped at a time; a chunk and its copy fit into the L2 cache
_CHUNK_ROWS = 1 << 12  # rows of plyfile that are copied at a time; they fit into a cache
_NOT_ASCII = bytes.maketrans(bytes(range(128, 256)), b"?" * 128)


def read_ply(path: Path, *, sh_degree: int | None = None, extras: bool = True) -> GaussianScene:
    """Read a scene from any PLY file; only uncommon layouts are not memory-mapped.

    SH bands above ``sh_degree`` are not copied but set to zero.
    """
    where = str(path)
    with open_input(path) as file:
        header = ply.read_header(file, where)
        vertex = ply.find_vertices(header, where)
        ply.check_size(file, header, vertex, where)
        if can_map(header):
            chunks = _mapped_chunks(file, header, where)
        else:
            rows = _parsed_rows(file, header, vertex, where)
            starts = range(0, vertex.count, _CHUNK_ROWS)
            chunks = (rows[start : start + _CHUNK_ROWS] for start in starts)
        scene = assemble(
            chunks,
            count=vertex.count,
            layout=ply.layout_of(vertex),
            comments=header.comments,
            sh_degree=sh_degree,
            with_extras=extras,
        )
    dropped = [
        f"element {shown(element.name)} ({element.count:,} rows)"
        for element in header.elements
        if element is not vertex and element.count > 0
    ]
    dropped += [
        f"list property {shown(prop.name)} of 'vertex' ({vertex.count:,} rows)"
        for prop in vertex.properties
        if prop.count_type
    ]
    if dropped:
        warn(f"{where}: left out {first_of(dropped, length=120)}.", DroppedDataWarning)
    return scene


def assemble(
    chunks: Iterable[NDArray[Any]],
    *,
    count: int,
    layout: ply.Layout,
    comments: tuple[str, ...],
    sh_degree: int | None = None,
    with_extras: bool = True,
) -> GaussianScene:
    """Copy rows into a new scene, chunk by chunk; memory is the scene plus that of chunks."""
    types = dict(layout)
    rest_count = sum(ply.rest_index(name) is not None for name in types) // 3
    tensors = _empty_tensors(count, rest_count, ply.dtype_of(layout))
    extras = {
        name: torch.empty(count, dtype=ply.SCALARS[kind].dtype, device="cpu")
        for name, kind in layout
        if with_extras and not ply.is_standard(name) and name not in NORMALS
    }
    if sh_degree is not None and REST_COUNTS[sh_degree] < tensors["shN"].shape[1]:
        # numpy's zeros take no memory until they are written to; torch's do.
        zeros = np.zeros(tensors["shN"].shape, tensors["shN"].numpy().dtype)
        tensors["shN"] = torch.from_numpy(zeros)
    columns = _standard_columns(tensors, types, sh_degree)
    columns |= {name: column.numpy() for name, column in extras.items()}
    skipped = [name for name in NORMALS if with_extras and name in types]  # as long as all are 0
    if "scale_2" not in types:
        tensors["log_scales"][:, 2] = FLAT_LOG_SCALE
    start = 0
    for rows in chunks:
        stop = start + len(rows)
        if any(rows[name].any() for name in skipped):
            for name in skipped:
                dtype = ply.SCALARS[types[name]].dtype
                extras[name] = torch.zeros(count, dtype=dtype, device="cpu")
                columns[name] = extras[name].numpy()
            skipped = []
        with np.errstate(over="ignore", invalid="ignore"):
            for name, column in columns.items():
                column[start:stop] = rows[name]
        start = stop
    return GaussianScene(
        **tensors,
        extras={name: extras[name] for name in types if name in extras},
        comments=comments,
        layout=layout,
    )


def _empty_tensors(count: int, rest_count: int, dtype: torch.dtype) -> dict[str, Tensor]:
    shapes = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "logit_opacities": (count,),
        "sh0": (count, 1, 3),
        "shN": (count, rest_count, 3),
    }
    return {name: torch.empty(shape, dtype=dtype, device="cpu") for name, shape in shapes.items()}


def _standard_columns(
    tensors: dict[str, Tensor], types: dict[str, str], sh_degree: int | None
) -> dict[str, NDArray[Any]]:
    """Return writable views of the standard columns to read, in file order."""
    slots = ply.standard_slots(tensors["shN"].shape[1])
    read = REST_COUNTS[-1 if sh_degree is None else sh_degree]
    return {
        name: tensors[tensor].numpy()[column]
        for name, tensor, column in ((name, *slots[name]) for name in types if name in slots)
        if tensor != "shN" or column[1] < read
    }


def can_map(header: ply.Header) -> bool:
    """Return whether the vertex rows can be memory-mapped without conversion."""
    first = header.elements[0]
    little = header.encoding == "binary_little_endian"
    return little and first.name == "vertex" and not first.has_lists


def _mapped_chunks(file: BinaryIO, header: ply.Header, path: str) -> Iterator[NDArray[Any]]:
    """Map the vertex rows, a megabyte at a time, which is unmapped once the caller releases it."""
    vertex = header.elements[0]
    dtype = ply.row_dtype(vertex.columns)
    rows = max(1, CHUNK_BYTES // dtype.itemsize)
    for start in range(0, vertex.count, rows):
        offset = header.data_offset + start * dtype.itemsize
        yield _mapped(file, dtype, offset, min(rows, vertex.count - start), path=path)


def _mapped(
    file: BinaryIO | str, dtype: np.dtype[Any], offset: int, count: int, *, path: str
) -> NDArray[Any]:
    """Map rows into memory; pages are read on use."""
    try:
        return np.memmap(file, dtype, "r", offset, (count,)).view(np.ndarray)
    except (OSError, ValueError) as error:
        found = "it shorter" if isinstance(error, ValueError) else reason_of(error)
        raise InputError(f"{path}: must stay as it is while it is read, found {found}.") from error


def _parsed_rows(
    file: BinaryIO, header: ply.Header, vertex: ply.Element, path: str
) -> NDArray[Any]:
    """Read the vertex rows of any PLY file; ASCII rows and rows with lists are held in memory."""
    try:
        from plyfile import PlyData, PlyElementParseError, PlyParseError  # noqa: PLC0415
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: a PLY not in plain binary needs plyfile; {how_to_install('plyfile')}."
        ) from error
    needed = header.elements[: header.elements.index(vertex) + 1]
    # Numpy warns of empty lists in text; elsewhere the filters of the process stay as they are.
    has_text_lists = header.encoding == "ascii" and any(element.has_lists for element in needed)
    quiet = warnings.catch_warnings(action="ignore") if has_text_lists else nullcontext()
    try:
        with (
            _CleanStream(file, header, needed) as stream,
            quiet,
            np.errstate(all="ignore"),  # numbers beyond a type become infinite
        ):
            data = PlyData.read(stream)[f"e{len(needed) - 1}"].data
    except PlyElementParseError as error:
        raise FileFormatError(_explain(error, needed, path)) from error
    except (PlyParseError, ValueError, OverflowError) as error:
        raise FileFormatError(
            f"{path}: every value must be of the type of its property, found another: {error}."
        ) from error
    rows: NDArray[Any] = data.view(np.ndarray)
    rows.dtype.names = tuple(prop.name for prop in vertex.properties)
    return rows


def _plain_header(header: ply.Header, elements: Sequence[ply.Element]) -> bytes:
    """Return a header for plyfile: no blanks or comments, and plain names e0, p0, ..."""
    lines = ["ply", f"format {header.encoding} 1.0"]
    for i, element in enumerate(elements):
        if element.count == 0 or (header.encoding != "ascii" and not element.properties):
            continue  # holds no bytes
        lines.append(f"element e{i} {element.count}")
        for j, prop in enumerate(element.properties):
            length = f"list {prop.count_type} " if prop.count_type else ""
            lines.append(f"property {length}{prop.type} p{j}")
    return "\n".join([*lines, "end_header", ""]).encode()


class _CleanStream(io.BufferedReader):
    """A PLY file with a replaced header; positions are those of the original file."""

    def __init__(self, file: BinaryIO, header: ply.Header, elements: Sequence[ply.Element]) -> None:
        super().__init__(io.FileIO(file.fileno(), closefd=False))
        self._pending = io.BytesIO(_plain_header(header, elements))
        self._is_text = header.encoding == "ascii"
        self._size = self.seek(0, io.SEEK_END)
        self.seek(header.data_offset)

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:  # from a damaged list
            raise ValueError("a list cannot have a negative length")
        data = self._pending.read(size)
        if data or size == 0:
            return data
        data = super().read(min(size, self._size - self.tell()))
        return data.translate(_NOT_ASCII) if self._is_text else data

    def read1(self, size: int = -1, /) -> bytes:
        return self.read(size)


def _explain(error: Any, elements: Sequence[ply.Element], path: str) -> str:
    """Convert plyfile's error to one sentence with the names in the file."""
    element = elements[int(error.element.name[1:])]
    place = f"{path}: row {error.row} of {shown(element.name)}"
    if error.message == "early end-of-file":
        return (
            f"{path}: the file is cut short: its header promises {element.count:,} rows of "
            f"{shown(element.name)}, found {error.row:,}."
        )
    if error.prop is None:
        return f"{place} must hold {len(element.properties)} values, found more."
    prop = element.properties[int(error.prop.name[1:])]
    if error.message == "early end-of-line":
        return f"{place} must have a value for {shown(prop.name)}, found the end of the line."
    kind = f"list of {prop.type}" if prop.count_type else prop.type
    return f"{place}: property {shown(prop.name)} must be a {kind}, found an unreadable value."


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyRows:
    """The rows of a binary little endian PLY file, read on demand."""

    path: str
    count: int
    dtype: np.dtype[Any]  # of a row
    layout: ply.Layout  # names and PLY types of the columns, as a scene keeps them
    comments: tuple[str, ...]
    offset: int  # where the first row starts, in bytes
    sh_degree: int | None = None  # SH bands above it are left out of scenes; None keeps all
    axes: str = SCENE_AXES  # of the file

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Map a range of rows into memory; pages are read on use."""
        place = self.offset + start * self.dtype.itemsize
        return _mapped(self.path, self.dtype, place, stop - start, path=self.path)

    def scene(self, rows: NDArray[Any]) -> GaussianScene:
        """Build a scene from rows with at least the columns of the file."""
        return self.assemble([rows], len(rows))

    def assemble(
        self, parts: Iterable[NDArray[Any]], count: int, *, is_slim: bool = False
    ) -> GaussianScene:
        """Build a scene from rows; a slim one has no extras, and of the SH only the constant."""
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

    Scenes are converted from ``axes``, those of PLY files unless given.
    """
    if sh_degree is not None:
        sh_degree = checked_whole(sh_degree, "sh_degree", least=0, most=3)
    name = os.fspath(path)
    refusal = FileFormatError(
        f"{name}: only binary little endian PLY files with vertices first can be read in parts; "
        f"write one with cvtgs convert."
    )
    with open_input(Path(path)) as file:
        if file.read(3) != b"ply":
            raise refusal
        file.seek(0)
        header = ply.read_header(file, name)
        vertex = ply.find_vertices(header, name)
        ply.check_size(file, header, vertex, name)
    if not can_map(header):
        raise refusal
    return PlyRows(
        path=str(Path(name).absolute()),  # for workers in other folders
        count=vertex.count,
        dtype=ply.row_dtype(vertex.columns),
        layout=ply.layout_of(vertex),
        comments=header.comments,
        offset=header.data_offset,
        sh_degree=sh_degree,
        axes=SCENE_AXES if axes is None else checked_axes(axes),
    )
