"""INRIA's vertex properties, and the only mapping from PLY names to tensors of a scene."""

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import torch

from cvtgs.errors import FileFormatError
from cvtgs.io.ply.header import FLOAT_TYPES, Element, Header, Layout
from cvtgs.math.spherical_harmonics import REST_COUNTS
from cvtgs.text import shown

_REST_NAME = re.compile(r"f_rest_(0|[1-9][0-9]*)")


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


def rest_count_of(names: Iterable[str]) -> int | None:
    """Count the view-dependent SH coefficients per channel."""
    total = sum(rest_index(name) is not None for name in names)
    return total // 3 if total in {3 * count for count in REST_COUNTS} else None


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
    _check_properties(vertex, path)
    _check_rest(vertex, path)
    if vertex.count == 0:
        raise FileFormatError(f"{path}: must hold at least one Gaussian, found 'element vertex 0'.")
    return vertex


def check_size(header: Header, table: Element, *, path: str, size: int) -> None:
    """Check that a file is long enough for an element, before memory is allocated for its rows."""
    before = header.elements[: header.elements.index(table)]
    room = size - header.data_offset
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
    """Return the layout that a scene keeps and will be written with.

    Lists are left out. Standard properties that the file stores as integers become ``float``,
    since merged values are not whole numbers.
    """
    return tuple(
        (name, "float" if is_standard(name) and kind not in FLOAT_TYPES else kind)
        for name, kind in vertex.columns
    )


def _check_properties(vertex: Element, path: str) -> None:
    scalars = {prop.name: prop.count_type is None for prop in vertex.properties}
    lists = [name for name, scalar in scalars.items() if is_standard(name) and not scalar]
    if lists:
        raise FileFormatError(
            f"{path}: property {shown(lists[0])} of 'vertex' must be a number, found a list."
        )
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


def _check_rest(vertex: Element, path: str) -> None:
    names = [prop.name for prop in vertex.properties]
    numbers = {number for name in names if (number := rest_index(name)) is not None}
    if rest_count_of(names) is None:
        raise FileFormatError(
            f"{path}: 'vertex' must have 0, 9, 24 or 45 f_rest properties (SH degree 0 to 3), "
            f"found {len(numbers)}."
        )
    gaps = sorted(set(range(len(numbers))) - numbers)
    if gaps:
        raise FileFormatError(
            f"{path}: the {len(numbers)} f_rest properties of 'vertex' must be numbered from 0 "
            f"without gaps, found no f_rest_{gaps[0]}."
        )
