"""Read a 3DGS scene from a PLY file."""

import os
import warnings
from pathlib import Path
from typing import BinaryIO

from cvtgs.errors import DroppedDataWarning
from cvtgs.io.files import open_input
from cvtgs.io.ply import fast, generic
from cvtgs.io.ply.assemble import assemble
from cvtgs.io.ply.header import Element, Header, read_header
from cvtgs.io.ply.vertices import check_size, find_vertices, layout_of
from cvtgs.scene import GaussianScene


def read_ply(path: Path, *, sh_degree: int | None = None, extras: bool = True) -> GaussianScene:
    """Read a scene from a PLY file of any encoding, property order and number type.

    The common layout (binary little endian, vertices first) is memory-mapped, the rest goes
    through plyfile; both give the same scene.

    Args:
        path: The file.
        sh_degree: Columns of SH bands above are not copied and come as zeros; None for all.
        extras: Whether columns beyond the standard ones are copied.

    Returns:
        The scene, on the CPU. Values are returned as they are, NaN and infinity too.

    Raises:
        InputNotFoundError: There is no such file.
        InputError: It cannot be opened or read.
        FileFormatError: It is not a PLY file of a 3DGS scene, or damaged.
    """
    with open_input(path) as file:
        return _read(file, str(path), sh_degree=sh_degree, extras=extras)


def _read(file: BinaryIO, path: str, *, sh_degree: int | None, extras: bool) -> GaussianScene:
    header = read_header(file, path)
    vertex = find_vertices(header, path)
    check_size(header, vertex, path=path, size=os.fstat(file.fileno()).st_size)
    if fast.can_read(header):
        chunks = fast.read_chunks(file, header)
    else:
        chunks = generic.read_chunks(file, header, vertex=vertex, path=path)
    scene = assemble(
        chunks,
        count=vertex.count,
        layout=layout_of(vertex),
        comments=header.comments,
        sh_degree=sh_degree,
        with_extras=extras,
    )
    _warn_of_dropped(header, vertex, path)
    return scene


def _warn_of_dropped(header: Header, vertex: Element, path: str) -> None:
    dropped = [
        f"element {element.name!r} ({element.count:,} rows)"
        for element in header.elements
        if element is not vertex and element.count > 0
    ]
    dropped += [
        f"list property {prop.name!r} of 'vertex' ({vertex.count:,} rows)"
        for prop in vertex.properties
        if prop.count_type
    ]
    if dropped:
        warnings.warn(
            f"{path}: left out {', '.join(dropped)}, since a scene holds one number per Gaussian "
            f"and property.",
            DroppedDataWarning,
            stacklevel=5,
        )
