"""Texts from files and users in messages: names, comments and paths, printable and short."""

import json
import re
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

_UNSAFE = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Control characters but tab and line feed, those that change the direction, lone surrogates."""

MOST_LETTERS = 60
"""Of a value in an error text."""


def shortened(text: str, length: int) -> str:
    """Cut a text that is too long."""
    return text if len(text) <= length else f"{text[: length - 3]}..."


def printable(text: str, encoding: str = "utf-8") -> str:
    r"""Return a text with what a terminal obeys, or cannot encode, as ``\u001b`` (also in JSON)."""
    text = _UNSAFE.sub(lambda match: _escaped(match[0]), text)
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return "".join(letter if _fits(letter, encoding) else _escaped(letter) for letter in text)
    return text


def _fits(letter: str, encoding: str) -> bool:
    try:
        letter.encode(encoding)
    except UnicodeEncodeError:
        return False
    return True


def _escaped(letter: str) -> str:
    return f"\\u{ord(letter):04x}" if ord(letter) < 1 << 16 else json.dumps(letter)[1:-1]


def shown(value: Any, length: int = MOST_LETTERS) -> str:
    """Return a value as Python writes it, cut after some characters."""
    try:
        return shortened(repr(value), length)
    except RecursionError:  # lists in lists in lists
        return f"a deeply nested {type(value).__name__}"
    except ValueError:  # Python writes no number of thousands of digits
        return "a number of thousands of digits"


def suggestion(word: str, choices: Iterable[str], *, likeness: float = 0.6) -> str:
    """Return "; did you mean X?" with the choice most like a word; empty if none is alike."""
    near = get_close_matches(word, list(choices), n=1, cutoff=likeness)
    return f"; did you mean {near[0]}?" if near else ""
