"""What the vertex element of a 3DGS file must hold, checked before any row is read."""

from cvtgs.errors import FileFormatError
from cvtgs.io.ply.header import Element, Header
from cvtgs.io.ply.properties import (
    FLOAT_TYPES,
    Layout,
    is_standard,
    rest_count_of,
    rest_index,
    standard_slots,
)

OPTIONAL = ("scale_2",)
"""Standard properties that a file may lack: 2DGS has two scales."""


def find_vertices(header: Header, path: str) -> Element:
    """Find the vertex element and check that it holds Gaussians."""
    vertex = next((element for element in header.elements if element.name == "vertex"), None)
    if vertex is None:
        found = ", ".join(repr(element.name) for element in header.elements[:5]) or "no element"
        found += ", ..." if len(header.elements) > 5 else ""
        raise FileFormatError(f"{path}: must have an element 'vertex', found {found}.")
    _check_properties(vertex, path)
    _check_rest(vertex, path)
    if vertex.count == 0:
        raise FileFormatError(f"{path}: must hold at least one Gaussian, found 'element vertex 0'.")
    return vertex


def check_size(header: Header, vertex: Element, *, path: str, size: int) -> None:
    """Check that the file is long enough for the rows it promises, before room is made for them."""
    before = header.elements[: header.elements.index(vertex)]
    room = size - header.data_offset
    room -= sum(element.count * element.row_bytes(header.encoding) for element in before)
    if header.encoding == "ascii":
        room += 1  # the last line may lack its line end
    row_bytes = vertex.row_bytes(header.encoding)
    if vertex.count * row_bytes > room:
        exact = header.encoding != "ascii" and not vertex.has_lists
        exact = exact and not any(element.has_lists for element in before)
        rows = max(room, 0) // row_bytes
        raise FileFormatError(
            f"{path}: the file is cut short: its header promises {vertex.count:,} rows of "
            f"'vertex', found {'' if exact else 'room for at most '}{rows:,}."
        )


def layout_of(vertex: Element) -> Layout:
    """Return the layout that a scene remembers.

    Lists are left out. Standard properties that the file stores as integers are ``float`` from
    here on, since merged values are not whole numbers.
    """
    return tuple(
        (
            prop.name,
            "float" if is_standard(prop.name) and prop.type not in FLOAT_TYPES else prop.type,
        )
        for prop in vertex.properties
        if prop.count_type is None
    )


def _check_properties(vertex: Element, path: str) -> None:
    scalars = {prop.name: prop.count_type is None for prop in vertex.properties}
    lists = [name for name, scalar in scalars.items() if is_standard(name) and not scalar]
    if lists:
        raise FileFormatError(
            f"{path}: property {lists[0]!r} of 'vertex' must be a number, found a list."
        )
    missing = [name for name in standard_slots(0) if name not in scalars and name not in OPTIONAL]
    if missing:
        names = ", ".join(missing)
        is_cloud = set(missing) == set(standard_slots(0)) - set(OPTIONAL) - set("xyz")
        hint = "; a point cloud or a mesh must be trained to a scene first" if is_cloud else ""
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
