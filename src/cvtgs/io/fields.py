"""Numbers, texts and matrices out of a JSON object, checked."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from cvtgs.errors import FileFormatError


@dataclass(frozen=True, slots=True, kw_only=True)
class Fields:
    """A JSON object and where it stands, so that errors can name path, row and key.

    Attributes:
        values: The object.
        where: Path and row.
    """

    values: Mapping[str, Any]
    where: str

    @classmethod
    def of(cls, value: Any, where: str) -> "Fields":
        """Check that a value is a JSON object."""
        if not isinstance(value, dict):
            raise FileFormatError(f"{where}: must be a JSON object, found {_shown(value)}.")
        return cls(values=value, where=where)

    def __contains__(self, key: str) -> bool:
        """Return whether the key is there and not null."""
        return self.values.get(key) is not None

    def number(self, key: str) -> float:
        """Return a finite number."""
        value = self.values.get(key)
        if not _is_number(value):
            raise self.wrong(key, "a finite number")
        return float(value)

    def whole(self, key: str) -> int:
        """Return a whole number, which may be written as 800.0."""
        value = self.values.get(key)
        if not _is_number(value) or float(value) != int(value):
            raise self.wrong(key, "a whole number")
        return int(value)

    def text(self, key: str) -> str:
        """Return a text."""
        value = self.values.get(key)
        if not isinstance(value, str):
            raise self.wrong(key, "a text")
        return value

    def items(self, key: str) -> list[Any]:
        """Return a list."""
        value = self.values.get(key)
        if not isinstance(value, list):
            raise self.wrong(key, "a list")
        return value

    def array(self, key: str, *shapes: tuple[int, ...]) -> NDArray[np.float64]:
        """Return nested lists of finite numbers."""
        value = self.values.get(key)
        for shape in shapes:
            if _has_shape(value, shape):
                return np.array(value, dtype=np.float64)
        wanted = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
        raise self.wrong(key, f"{wanted} finite numbers")

    def wrong(self, key: str, required: str) -> FileFormatError:
        """Make the error for a value that does not fit."""
        found = _shown(self.values[key]) if key in self.values else "none"
        return FileFormatError(f"{self.where}: {key!r} must be {required}, found {found}.")


def _is_number(value: Any) -> TypeGuard[float]:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


def _has_shape(value: Any, shape: tuple[int, ...]) -> bool:
    if not shape:
        return _is_number(value)
    if not isinstance(value, list) or len(value) != shape[0]:
        return False
    return all(_has_shape(item, shape[1:]) for item in value)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
