"""INRIA property names and PLY types: the one place where file names meet scene tensors."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import torch

from cvtgs.math.spherical_harmonics import REST_COUNTS

Layout = tuple[tuple[str, str], ...]
"""Property names and PLY types of a vertex element, in order."""

NORMALS = ("nx", "ny", "nz")
"""Columns that 3DGS files carry for viewers of point clouds, almost always zero."""

_REST_NAME = re.compile(r"f_rest_(0|[1-9][0-9]*)")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalarType:
    """One PLY number type.

    Attributes:
        code: The numpy type, without byte order.
        dtype: The torch dtype that holds every value and that every torch operation knows.
    """

    code: str
    dtype: torch.dtype


SCALARS: Mapping[str, ScalarType] = MappingProxyType(
    {
        "char": ScalarType(code="i1", dtype=torch.int8),
        "uchar": ScalarType(code="u1", dtype=torch.uint8),
        "short": ScalarType(code="i2", dtype=torch.int16),
        "ushort": ScalarType(code="u2", dtype=torch.int32),
        "int": ScalarType(code="i4", dtype=torch.int32),
        "uint": ScalarType(code="u4", dtype=torch.int64),
        "float": ScalarType(code="f4", dtype=torch.float32),
        "double": ScalarType(code="f8", dtype=torch.float64),
    }
)
"""PLY number types by their canonical names."""

TYPE_NAMES: Mapping[str, str] = MappingProxyType(
    {
        **{name: name for name in SCALARS},
        "int8": "char",
        "uint8": "uchar",
        "int16": "short",
        "uint16": "ushort",
        "int32": "int",
        "uint32": "uint",
        "float32": "float",
        "float64": "double",
    }
)
"""Every name of a PLY number type, and the canonical one."""

FLOAT_TYPES = ("float", "double")


@dataclass(frozen=True, slots=True, kw_only=True)
class Slot:
    """Where the column of a property lies in a scene.

    Attributes:
        tensor: Name of the scene's tensor.
        index: Position in that tensor behind the row, for example ``(0,)``.
    """

    tensor: str
    index: tuple[int, ...]

    @property
    def rows(self) -> tuple[slice | int, ...]:
        """The index of the whole column."""
        return (slice(None), *self.index)


def standard_slots(rest_count: int) -> dict[str, Slot]:
    """Return the standard properties in INRIA's order, and where each belongs."""
    return {
        **{name: Slot(tensor="means", index=(i,)) for i, name in enumerate("xyz")},
        **{f"f_dc_{c}": Slot(tensor="sh0", index=(0, c)) for c in range(3)},
        **{
            f"f_rest_{c * rest_count + j}": Slot(tensor="shN", index=(j, c))
            for c in range(3)
            for j in range(rest_count)
        },
        "opacity": Slot(tensor="logit_opacities", index=()),
        **{f"scale_{i}": Slot(tensor="log_scales", index=(i,)) for i in range(3)},
        **{f"rot_{i}": Slot(tensor="quats", index=(i,)) for i in range(4)},
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


def lacks_third_scale(layout: Layout) -> bool:
    """Return whether Gaussians of a file have two scales: surfels of 2DGS (Huang et al. 2024)."""
    return bool(layout) and "scale_2" not in dict(layout)


def dtype_of(layout: Layout) -> torch.dtype:
    """Return the dtype of a scene that was read from this layout."""
    types = dict(layout)
    double = any(types.get(axis) == "double" for axis in "xyz")
    return torch.float64 if double else torch.float32
