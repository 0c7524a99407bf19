"""Docstrings between autodoc and Napoleon: re-exported constants, model fields, plain colons."""

import re
import sys
from typing import Any, TypeGuard

import pydantic
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.typing import stringify_annotation

FIELD = re.compile(r"^ {4}(\w+): ")
BOUNDS = {"ge": "at least {}", "gt": "above {}", "le": "at most {}", "lt": "below {}"}
BEFORE_NAPOLEON = 450


def find_constant(
    app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]
) -> None:
    """Take the docstring of a constant from the file of the package that defines it."""
    package, _, constant = name.rpartition(".")
    modules = (module for module in sorted(sys.modules) if module.startswith(package))
    for module in modules if what == "data" else ():
        found = ModuleAnalyzer.for_module(module).find_attr_docs().get(("", constant))
        if found:
            lines[:] = found
            return


def is_model(obj: object) -> TypeGuard[type[pydantic.BaseModel]]:
    """Return whether something is a class of pydantic."""
    return isinstance(obj, type) and issubclass(obj, pydantic.BaseModel)


def facts(field: FieldInfo) -> str:
    """Return type, default and bounds of a field: ``float``, default ``0.1``, at least 0."""
    kind = stringify_annotation(field.annotation, "smart").replace("~", "")
    parts = [f"``{re.sub(r'[a-z_]+[.](?=[A-Za-z])', '', kind)}``"]
    default = field.default
    if default is not PydanticUndefined and not isinstance(default, pydantic.BaseModel):
        parts.append(f"default ``{default!r}``")
    for bound in field.metadata:
        for name, text in BOUNDS.items():
            if getattr(bound, name, None) is not None:
                parts.append(text.format(f"{getattr(bound, name):g}"))
    return ", ".join(parts)


def add_facts(
    app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]
) -> None:
    """Append its facts to every field in the *Attributes* of a model."""
    if what != "class" or not is_model(obj):
        return
    last: dict[str, int] = {}
    field = ""
    for number, line in enumerate(lines):
        if found := FIELD.match(line):
            field = found[1]
        elif not line.startswith(" " * 8):
            field = ""
        if field in obj.model_fields:
            last[field] = number
    for field, number in last.items():
        lines[number] += f" ({facts(obj.model_fields[field])})"


def keep_colons(
    app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]
) -> None:
    """Keep Napoleon from reading words before a colon as a type: types stand in annotations only.

    It does so in the first line of *Returns*, of constants and of properties. An empty word on a
    line of its own goes before those.
    """
    starts = [row + 1 for row, line in enumerate(lines) if line.strip() in ("Returns:", "Yields:")]
    if what in ("attribute", "data", "property"):
        starts.insert(0, 0)
    for start in reversed(starts):
        if start < len(lines) and ":" in lines[start]:
            indent = re.match(" *", lines[start])
            lines.insert(start, (indent[0] if indent else "") + "\\ ")


def without_signature(
    app: Sphinx, what: str, name: str, obj: object, options: Any, signature: str, returns: str
) -> tuple[str, str] | None:
    """Leave out the signature of a model, which repeats its fields."""
    return ("", "") if what == "class" and is_model(obj) else None


def setup(app: Sphinx) -> dict[str, Any]:
    """Listen to docstrings and signatures."""
    app.connect("autodoc-process-docstring", find_constant, priority=BEFORE_NAPOLEON - 1)
    app.connect("autodoc-process-docstring", add_facts, priority=BEFORE_NAPOLEON)
    app.connect("autodoc-process-docstring", keep_colons, priority=BEFORE_NAPOLEON + 1)
    app.connect("autodoc-process-signature", without_signature)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
