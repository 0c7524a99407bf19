"""Docstrings of the house, where Napoleon would read them otherwise.

Types stand in annotations only. So a colon in the docstring of a constant or of a property, or in
the first line of *Returns*, is punctuation and names no type.
"""

import re
from typing import Any

from sphinx.application import Sphinx

WITHOUT_SECTIONS = ("attribute", "data", "property")
SECTION = re.compile(r"^( *)(Returns|Yields):$")
BEFORE_NAPOLEON, AFTER_NAPOLEON = 450, 550


class Kept:
    """Keeps the docstrings of constants and properties from Napoleon."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def put_away(
        self, app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]
    ) -> None:  # fmt: skip
        """Remember the lines."""
        self.lines = list(lines)

    def restore(
        self, app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]
    ) -> None:  # fmt: skip
        """Return the lines as they were."""
        if what in WITHOUT_SECTIONS and not any(line.endswith("Raises:") for line in self.lines):
            lines[:] = self.lines


def break_before_colons(
    app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]
) -> None:
    """Move the word with the first colon after *Returns* to a line of its own."""
    for number in range(len(lines) - 1, 0, -1):
        if not SECTION.match(lines[number - 1]):
            continue
        first = lines[number]
        found = re.match(r"^( +)((?:[^`:]|``[^`]*``)*?)([^ `:]+: .*)$", first)
        if found:
            indent, before, rest = found.groups()
            lines[number : number + 1] = [indent + (before.strip() or "\\ "), indent + rest]


def setup(app: Sphinx) -> dict[str, Any]:
    """Listen to docstrings, before and after Napoleon."""
    kept = Kept()
    app.connect("autodoc-process-docstring", kept.put_away, priority=BEFORE_NAPOLEON)
    app.connect("autodoc-process-docstring", break_before_colons, priority=BEFORE_NAPOLEON)
    app.connect("autodoc-process-docstring", kept.restore, priority=AFTER_NAPOLEON)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
