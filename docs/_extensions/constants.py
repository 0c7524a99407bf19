"""The directive ``constants``: public constants and types of a package, documented where they are.

Autodoc does not find the docstring of a constant that a package takes from one of its files.
"""

import sys
from importlib import import_module
from types import FunctionType, ModuleType
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective


class Constants(SphinxDirective):
    """``.. constants:: package``."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Describe every public constant."""
        package = import_module(self.arguments[0])
        lines = [f".. py:currentmodule:: {package.__name__}", ""]
        for name in getattr(package, "__all__", ()):
            if is_constant(getattr(package, name)):
                lines += [f".. py:data:: {name}", ""]
                lines += [f"   {line}" for line in docstring(package.__name__, name)] + [""]
        holder = nodes.Element()
        self.state.nested_parse(StringList(lines, source=package.__name__), 0, holder)
        return list(holder.children)


def is_constant(value: object) -> bool:
    """Return constants and aliases of types from what autodoc documents."""
    return not isinstance(value, type | FunctionType | ModuleType) and not hasattr(
        value, "__wrapped__"
    )


def docstring(package: str, name: str) -> list[str]:
    """Find the text below the definition of a name, in one of the files of a package."""
    for module in sorted(known for known in sys.modules if known.startswith(package)):
        found = ModuleAnalyzer.for_module(module).find_attr_docs().get(("", name))
        if found:
            return list(found)
    return []


def setup(app: Sphinx) -> dict[str, Any]:
    """Offer the directive."""
    app.add_directive("constants", Constants)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
