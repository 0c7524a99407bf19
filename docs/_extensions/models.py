"""Pydantic models in the reference: every field with its type, its default and its bounds."""

import re
from typing import Any, TypeGuard

import pydantic
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from sphinx.application import Sphinx
from sphinx.util.typing import stringify_annotation

FIELD = re.compile(r"^( +)(\w+): (.*)$")
BOUNDS = {"ge": "at least {}", "gt": "above {}", "le": "at most {}", "lt": "below {}"}


def facts(field: FieldInfo) -> str:
    """Report what a field holds, for example ``float``, default ``0.1``, at least 0."""
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


def tell_fields(
    app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]
) -> None:
    """Add the facts to the section of attributes, before Napoleon reads it."""
    if what != "class" or not is_model(obj):
        return
    for number, line in enumerate(lines):
        found = FIELD.match(line)
        if found and found[2] in obj.model_fields:
            indent, field, text = found.groups()
            lines[number] = f"{indent}{field}: {text} ({facts(obj.model_fields[field])})"
            if number + 1 < len(lines) and re.match(rf"^{indent} +\S", lines[number + 1]):
                lines[number] = line
                last = number + 1
                while last + 1 < len(lines) and re.match(rf"^{indent} +\S", lines[last + 1]):
                    last += 1
                lines[last] += f" ({facts(obj.model_fields[field])})"


def without_signature(
    app: Sphinx, what: str, name: str, obj: object, options: Any, signature: str, returns: str
) -> tuple[str, str] | None:
    """Leave out the signature of a model, which repeats its fields."""
    return ("", "") if what == "class" and is_model(obj) else None


def is_model(obj: object) -> TypeGuard[type[pydantic.BaseModel]]:
    """Return whether something is a class of pydantic."""
    return isinstance(obj, type) and issubclass(obj, pydantic.BaseModel)


def setup(app: Sphinx) -> dict[str, Any]:
    """Listen to docstrings and signatures."""
    app.connect("autodoc-process-docstring", tell_fields, priority=400)
    app.connect("autodoc-process-signature", without_signature)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
