"""Make text from files and users safe to show in messages: printable and short."""

import json
import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import Any
from unicodedata import combining, east_asian_width

_UNSAFE = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Control characters except tab and line feed, direction marks, and lone surrogates."""

MOST_LETTERS = 60  # maximum length of a value in an error message
MOST_NAMES = 10  # maximum number of columns or elements of a file that a message lists
LONGEST_REPR = 400  # letters of a value within the repr of an object
SETTING_LIKENESS = 0.82  # least likeness of an unknown setting to the one that is suggested


def shortened(text: str, length: int) -> str:
    """Truncate a text to a maximum number of letters, and of columns in a terminal."""
    if max(len(text), columns(text)) <= length:
        return text
    kept = text[: length - 3]
    while columns(kept) > length - 3:
        kept = kept[:-1]
    return f"{kept}..."


def printable(text: str, encoding: str = "utf-8") -> str:
    r"""Escape control and unencodable characters of a text, such as ``\u001b`` (valid in JSON)."""
    text = _UNSAFE.sub(lambda match: _escaped(match[0]), text)
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return "".join(
            letter if letter.encode(encoding, "ignore") else _escaped(letter) for letter in text
        )
    return text


def printable_name(name: str) -> str:
    """Escape also the tabs and line feeds of a text, so that it stays in its line."""
    return printable(name).replace("\t", r"\t").replace("\n", r"\n")


def _escaped(letter: str) -> str:
    return f"\\u{ord(letter):04x}" if ord(letter) < 1 << 16 else json.dumps(letter)[1:-1]


def shown(value: Any, length: int = MOST_LETTERS) -> str:
    """Return the ``repr`` of a value in one line, truncated to a maximum length."""
    try:
        return shortened(re.sub(r"\s*\n\s*", " ", repr(value)), length)
    except RecursionError:  # lists nested too deeply
        return f"a deeply nested {type(value).__name__}"
    except ValueError:  # Python refuses to print numbers of thousands of digits
        return "a number of thousands of digits"


def suggestion(word: str, choices: Iterable[str], *, likeness: float = 0.6) -> str:
    """Return "; did you mean X?" with the choice closest to a word; empty if none is close."""
    near = get_close_matches(word, list(choices), n=1, cutoff=likeness)
    return f"; did you mean {near[0]}?" if near else ""


def first_of(texts: Sequence[str], *, between: str = ", ", length: int = MOST_LETTERS) -> str:
    """List the first texts, each truncated to a length, and how many more there are."""
    listed = between.join(shortened(text, length) for text in texts[:MOST_NAMES])
    more = len(texts) - MOST_NAMES
    return f"{listed}{between}and {more:,} more" if more > 0 else listed


def size_text(count: int) -> str:
    """Return a number of bytes as text in decimal units."""
    if count < 1000:
        return f"{count} B"
    value = count / 1000
    for unit in ("kB", "MB"):
        if value < 999.95:  # else 1000.0
            return f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} GB"


def columns(text: str) -> int:
    """Return the columns that a text takes in a terminal; wide characters take two."""
    wide = sum(east_asian_width(letter) in "FW" for letter in text)
    return len(text) + wide - sum(map(bool, map(combining, text)))


def counted(number: int, word: str) -> str:
    """Return a number of things in words: ``1 view``, ``2 views``."""
    return f"{number:,} {word}" if number == 1 else f"{number:,} {word}s"


def short_repr(self: Any) -> str:
    """Return the ``repr`` of a dataclass with arrays by dtype and shape, long values by type."""
    parts = (f"{name}={_in_short(getattr(self, name))}" for name in self.__dataclass_fields__)
    return f"{type(self).__name__}({', '.join(parts)})"


def _in_short(value: Any) -> str:
    if hasattr(value, "dtype") and getattr(value, "shape", False):
        return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
    text = repr(value)
    return text if len(text) <= LONGEST_REPR and "\n" not in text else type(value).__name__
