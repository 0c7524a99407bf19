"""Columns of a file become the tensors of a scene."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cvtgs.io.ply.properties import (
    NORMALS,
    SCALARS,
    Layout,
    dtype_of,
    is_standard,
    rest_count_of,
    standard_slots,
)
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.scene import FLAT_LOG_SCALE, GaussianScene


def assemble(
    chunks: Iterable[NDArray[Any]],
    *,
    count: int,
    layout: Layout,
    comments: tuple[str, ...],
    sh_degree: int | None = None,
    with_extras: bool = True,
) -> GaussianScene:
    """Copy rows into a new scene, chunk by chunk.

    Memory is the scene plus what ``chunks`` holds.
    """
    types = dict(layout)
    tensors = _empty_tensors(count, rest_count_of(types) or 0, dtype_of(layout))
    extras = {
        name: torch.empty(count, dtype=SCALARS[kind].dtype)
        for name, kind in layout
        if with_extras and not is_standard(name) and name not in NORMALS
    }
    if sh_degree is not None and REST_COUNTS[sh_degree] < tensors["shN"].shape[1]:
        # Zeros of numpy take no memory until they are written to, those of torch do.
        zeros = np.zeros(tensors["shN"].shape, tensors["shN"].numpy().dtype)
        tensors["shN"] = torch.from_numpy(zeros)
    standard = _standard_columns(tensors, types, sh_degree)
    columns = {**standard, **{name: column.numpy() for name, column in extras.items()}}
    normal_names = tuple(name for name in NORMALS if with_extras and name in types)
    if "scale_2" not in types:
        tensors["log_scales"][:, 2] = FLAT_LOG_SCALE
    normals: dict[str, Tensor] = {}
    start = 0
    for rows in chunks:
        stop = start + len(rows)
        if not normals and any(rows[name].any() for name in normal_names):
            normals = {
                name: torch.zeros(count, dtype=SCALARS[types[name]].dtype) for name in normal_names
            }
            columns.update({name: normal.numpy() for name, normal in normals.items()})
        with np.errstate(over="ignore", invalid="ignore"):
            for name, column in columns.items():
                column[start:stop] = rows[name]
        start = stop
    carried = {**extras, **normals}
    return GaussianScene(
        **tensors,
        extras={name: carried[name] for name in types if name in carried},
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
    return {name: torch.empty(shape, dtype=dtype) for name, shape in shapes.items()}


def _standard_columns(
    tensors: dict[str, Tensor], types: dict[str, str], sh_degree: int | None
) -> dict[str, NDArray[Any]]:
    """Return a writable view of every standard column that is to be read, in file order."""
    slots = standard_slots(tensors["shN"].shape[1])
    if sh_degree is not None:
        read = REST_COUNTS[sh_degree]
        slots = {
            name: slot
            for name, slot in slots.items()
            if slot.tensor != "shN" or slot.index[0] < read
        }
    return {
        name: tensors[slots[name].tensor].numpy()[slots[name].rows]
        for name in types
        if name in slots
    }
