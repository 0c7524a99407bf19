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

    Example:
        >>> fields = Fields(values={"w": 8.0}, where="a.json: frame 0")
        >>> fields.whole("w"), "h" in fields
        (8, False)
    """

    values: Mapping[str, Any]
    where: str

    @classmethod
    def of(cls, value: Any, where: str) -> "Fields":
        """Check that a value is a JSON object.

        Args:
            value: The value.
            where: Path and row.

        Returns:
            Its fields.

        Raises:
            FileFormatError: It is something else.
        """
        if not isinstance(value, dict):
            raise FileFormatError(f"{where}: must be a JSON object, found {_shown(value)}.")
        return cls(values=value, where=where)

    def __contains__(self, key: str) -> bool:
        """Tell whether the key is there and not null."""
        return self.values.get(key) is not None

    def number(self, key: str) -> float:
        """Give a finite number.

        Args:
            key: Its key.

        Returns:
            The number.

        Raises:
            FileFormatError: It is missing or something else.
        """
        value = self.values.get(key)
        if not _is_number(value):
            raise self.wrong(key, "a finite number")
        return float(value)

    def whole(self, key: str) -> int:
        """Give a whole number, which may be written as 800.0.

        Args:
            key: Its key.

        Returns:
            The number.

        Raises:
            FileFormatError: It is missing or something else.
        """
        value = self.values.get(key)
        if not _is_number(value) or float(value) != int(value):
            raise self.wrong(key, "a whole number")
        return int(value)

    def text(self, key: str) -> str:
        """Give a text.

        Args:
            key: Its key.

        Returns:
            The text.

        Raises:
            FileFormatError: It is missing or something else.
        """
        value = self.values.get(key)
        if not isinstance(value, str):
            raise self.wrong(key, "a text")
        return value

    def items(self, key: str) -> list[Any]:
        """Give a list.

        Args:
            key: Its key.

        Returns:
            The list.

        Raises:
            FileFormatError: It is missing or something else.
        """
        value = self.values.get(key)
        if not isinstance(value, list):
            raise self.wrong(key, "a list")
        return value

    def array(self, key: str, *shapes: tuple[int, ...]) -> NDArray[np.float64]:
        """Give nested lists of finite numbers.

        Args:
            key: Their key.
            *shapes: Shapes that are fine.

        Returns:
            The numbers.

        Raises:
            FileFormatError: They are missing or something else.
        """
        value = self.values.get(key)
        for shape in shapes:
            if _has_shape(value, shape):
                return np.array(value, dtype=np.float64)
        wanted = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
        raise self.wrong(key, f"{wanted} finite numbers")

    def wrong(self, key: str, required: str) -> FileFormatError:
        """Make the error for a value that does not fit.

        Args:
            key: Its key.
            required: What it must be.

        Returns:
            The error, to be raised.
        """
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
