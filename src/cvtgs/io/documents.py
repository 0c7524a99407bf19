"""JSON documents that other programs wrote: parsed, and validated by pydantic models."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import pydantic
from pydantic import AllowInfNan, BeforeValidator, Field, Strict

from cvtgs.errors import FileFormatError
from cvtgs.io.files import open_input
from cvtgs.text import shown

_MOST_WHOLE = 1 << 53
"""Whole numbers up to here are the same in every JSON parser."""


class Document(pydantic.BaseModel):
    """A JSON object of which some keys are read; descriptions of fields say what they must be."""

    model_config = pydantic.ConfigDict(frozen=True)


def _without_point(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


Number = Annotated[float, Strict(), AllowInfNan(False), Field(description="a finite number")]
Whole = Annotated[
    int,
    Strict(),
    BeforeValidator(_without_point),  # 800.0
    Field(ge=-_MOST_WHOLE, le=_MOST_WHOLE, description="a whole number"),
]
Text = Annotated[str, Strict(), Field(description="a text")]
Items = Annotated[list[Any], Field(description="a list")]
Vector = Annotated[tuple[Number, Number, Number], Field(description="3 finite numbers")]
AnyDocument = TypeVar("AnyDocument", bound=Document)


def validated(model: type[AnyDocument], value: Any, where: str) -> AnyDocument:
    """Check a value of a document against a model; errors name the place, the key and the value."""
    try:
        return model.model_validate(value)
    except pydantic.ValidationError as error:
        text = _sentence(model, value, error.errors(include_url=False)[0]["loc"], where)
        raise FileFormatError(text) from error


def _sentence(model: type[Document], value: Any, keys: Sequence[int | str], where: str) -> str:
    if not isinstance(value, dict):
        return f"{where}: must be a JSON object, found {shown(value)}."
    key = str(keys[0])
    annotation = model.model_fields[key].annotation
    for part in (annotation, *get_args(annotation)):
        if isinstance(part, type) and issubclass(part, Document):
            return _sentence(part, value.get(key), keys[1:], f"{where}: {key!r}")
    schema = model.model_json_schema()["properties"][key]
    required = schema.get("description") or schema["anyOf"][0]["description"]  # X, X | None
    found = shown(value[key]) if key in value else "none"
    return f"{where}: {key!r} must be {required}, found {found}."


def read_json(path: Path) -> Any:
    """Read and parse a JSON file."""
    with open_input(path) as file:
        return parse_json(file.read(), path)


def parse_json(data: bytes, path: str | Path) -> Any:
    """Parse JSON that is read already."""
    try:
        return json.loads(data.decode("utf-8-sig"))
    except json.JSONDecodeError as error:
        raise FileFormatError(
            f"{path}: must be JSON, found an error in line {error.lineno}, column {error.colno}: "
            f"{error.msg.lower()}."
        ) from error
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{path}: must be JSON in UTF-8, found another byte at {error.start:,}."
        ) from error
    except (RecursionError, ValueError) as error:  # nested without end; numbers without end
        raise FileFormatError(f"{path}: must be plain JSON, found: {error}.") from error
