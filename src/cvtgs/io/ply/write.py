"""Write scenes to PLY files, with the properties of their source where they fit; join files."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.errors import FileFormatError, InvalidSceneError
from cvtgs.io.ply import header as ply
from cvtgs.io.ply.read import open_rows
from cvtgs.scene import FLAT_LOG_SCALE, NORMALS, GaussianScene
from cvtgs.text import counted, shown

CHUNK_BYTES = 1 << 20  # bytes that are gathered before they are written
_NATURAL_TYPES = {kind.dtype: name for name, kind in ply.SCALARS.items()}
_NATURAL_TYPES |= {torch.bool: "uchar", torch.float16: "float", torch.bfloat16: "float"}


def write_ply(scene: GaussianScene, file: BinaryIO) -> None:
    """Write a scene as binary little endian PLY; memory is one chunk."""
    if len(scene) == 0:
        raise InvalidSceneError("a scene must hold at least one Gaussian to be written, found 0.")
    layout = _output_layout(scene)
    file.write(ply.header_bytes(scene.comments, [("vertex", len(scene), layout)]))
    dtype, slots = ply.row_dtype(layout), ply.standard_slots(scene.shN.shape[1])
    rows = max(1, CHUNK_BYTES // dtype.itemsize)
    for start in range(0, len(scene), rows):
        stop = min(start + rows, len(scene))
        block = np.zeros(stop - start, dtype)  # columns that the scene does not have stay zero
        tensors = {name: _rows(tensor, start, stop) for name, tensor in scene.tensors().items()}
        with np.errstate(over="ignore"):
            for name in (name for name, _ in layout):
                if name in slots:
                    tensor, column = slots[name]
                    block[name] = tensors[tensor][column]
                elif name in scene.extras:
                    block[name] = _rows(scene.extras[name], start, stop)
        file.write(block.view(np.uint8).data)


def join_plys(paths: Sequence[str | os.PathLike[str]], file: BinaryIO) -> None:
    """Write the rows of PLY files that have the same columns, with the comments of the first."""
    parts = [open_rows(path) for path in paths]
    first, total = parts[0], sum(part.count for part in parts)
    for part in parts:
        if part.dtype != first.dtype:
            raise FileFormatError(f"{part.path}: must have the same columns as {first.path}.")
    file.write(ply.header_bytes(first.comments, [("vertex", total, first.layout)]))
    for part in parts:
        with Path(part.path).open("rb") as content:
            content.seek(part.offset)
            shutil.copyfileobj(content, file, 1 << 20)


def _rows(tensor: Tensor, start: int, stop: int) -> NDArray[Any]:
    part = tensor[start:stop].detach().cpu()
    return (part.float() if part.dtype == torch.bfloat16 else part).numpy()


def lost_scales(scene: GaussianScene) -> str:
    """Return a phrase for third scales that the layout of a scene has no column for, or ""."""
    thick = int((scene.log_scales[:, 2] != FLAT_LOG_SCALE).sum())
    if not scene.layout or "scale_2" in dict(scene.layout) or not thick:
        return ""
    return (
        f"the third scale of {counted(thick, 'Gaussian')}, since the file that the scene came from "
        f"has no scale_2 (2DGS)"
    )


def _output_layout(scene: GaussianScene) -> ply.Layout:
    """Return the properties to write: those of the source where they fit, or INRIA's.

    Standard ones follow the scene (SH degree, dtype), and new extras are appended.
    """
    _check_names(scene)
    slots = ply.standard_slots(scene.shN.shape[1])
    float_type = "double" if scene.dtype == torch.float64 else "float"
    x, y, z, *others = slots
    base = dict(scene.layout) or dict.fromkeys([x, y, z, *NORMALS, *others], float_type)
    if "scale_2" not in base:
        del slots["scale_2"]
    keeps_types = ply.dtype_of(tuple(base.items())) == scene.dtype
    kept: list[tuple[str, str]] = []
    for name, kind in base.items():
        if name in slots:
            usable = keeps_types and kind in ply.FLOAT_TYPES
            kept.append((name, kind if usable else float_type))
        elif name in scene.extras:
            kept.append((name, _extra_type(name, scene.extras[name], kind)))
        elif name in NORMALS:
            kept.append((name, kind))
    names = {name for name, _ in kept}
    missing = [(name, float_type) for name in slots if name not in names]
    colours = [i for i, (name, _) in enumerate(kept) if name.startswith(("f_dc_", "f_rest_"))]
    end = max(colours, default=len(kept) - 1) + 1  # view-dependent colours follow these
    added = [
        (name, _extra_type(name, column, None))
        for name, column in scene.extras.items()
        if name not in names
    ]
    return tuple(kept[:end] + missing + kept[end:] + added)


def _check_names(scene: GaussianScene) -> None:
    for name in scene.extras:
        if ply.is_standard(name):
            raise InvalidSceneError(
                f"extra column {name!r} must not be named like a property of the scene itself."
            )
        if name.split() != [name] or not ply.is_name(name):
            raise InvalidSceneError(
                f"column {shown(name)} must have a name of at most {ply.MAX_NAME_LETTERS} letters "
                f"without blanks."
            )
    for name, kind in scene.layout:
        if kind not in ply.SCALARS:
            raise InvalidSceneError(
                f"the layout must give {name!r} a type of {', '.join(ply.SCALARS)}, found {kind!r}."
            )


def _extra_type(name: str, column: Tensor, kind: str | None) -> str:
    """Return the type in the source file if it holds every value, else the column's own."""
    if kind is not None and ply.SCALARS[kind].dtype == column.dtype and _fits(column, kind):
        return kind
    if column.dtype == torch.int64:
        for wide in ("uint", "int"):
            if _fits(column, wide):
                return wide
        raise InvalidSceneError(
            f"extra column {name!r} must fit into 32 bits, found {column.min()} to {column.max()}."
        )
    if column.dtype not in _NATURAL_TYPES:
        raise InvalidSceneError(
            f"extra column {name!r} must be real for a PLY, found {column.dtype}."
        )
    return _NATURAL_TYPES[column.dtype]


def _fits(column: Tensor, kind: str) -> bool:
    """Check the range where the torch dtype is wider than the PLY type."""
    if kind in ply.FLOAT_TYPES:
        return True
    limits = np.iinfo(ply.SCALARS[kind].code)
    return bool(((column >= limits.min) & (column <= limits.max)).all())
