"""Shared by configurations and reports: strict models, TOML reading, error texts."""

import json
import os
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import pydantic

from cvtgs.errors import ConfigError, check_path
from cvtgs.text import SETTING_LIKENESS, shortened, shown, suggestion

MOST_PROBLEMS = 4  # maximum number of problems that one error message names


class Record(pydantic.BaseModel):
    """Base of reports and measurements: frozen; infinite numbers are strings in JSON."""

    model_config: ClassVar[pydantic.ConfigDict] = pydantic.ConfigDict(
        frozen=True, extra="forbid", ser_json_inf_nan="strings"
    )

    def to_json(self) -> str:
        """Return everything as lines of indented JSON; infinity is the string ``Infinity``."""
        return self.model_dump_json(indent=2) + "\n"


class Section(pydantic.BaseModel):
    """Base of settings: frozen; unknown keys and non-finite numbers are errors."""

    model_config: ClassVar[pydantic.ConfigDict] = pydantic.ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False
    )

    def __init__(self, /, **values: Any) -> None:
        """Check the values; raise ConfigError with the first problems."""
        try:
            super().__init__(**values)
        except pydantic.ValidationError as error:
            raise ConfigError(explain(error, type(self))) from None

    @pydantic.field_validator("*", mode="before")
    @classmethod
    def _refuse_truth_values(cls, value: Any, info: pydantic.ValidationInfo) -> Any:
        """Make texts, which are no numbers, of true and false for numbers: they equal 1 and 0."""
        field = cls.model_fields[info.field_name or ""]
        is_wrong = isinstance(value, bool) and field.annotation in (int, float)
        return str(value) if is_wrong else value

    # Sections in other sections are checked without a call of __init__, so keys keep their path.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a TOML file; a byte order mark, as editors on Windows write it, is skipped.

    Args:
        path: The file.

    Returns:
        The tables of the file.

    Raises:
        ConfigError: The file cannot be read, or is not TOML.
        InvalidArgumentError: ``path`` is no path.
    """
    found: dict[str, Any] = _parsed(path, tomllib.loads, "a TOML")
    return found


def read_settings(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a TOML file, or from a ``.json`` file the configuration of a report."""
    check_path(path)
    if Path(path).suffix.lower() != ".json":
        return read_toml(path)
    report = _parsed(path, json.loads, "a JSON")
    config = report.get("config") if isinstance(report, dict) else None
    if not isinstance(config, dict):
        raise ConfigError(f"{path}: must be a report with a config, or a TOML file.")
    return config


def _parsed(path: str | os.PathLike[str], parse: Callable[[str], Any], kind: str) -> Any:
    """Parse a text file; raise if it is not of its kind."""
    check_path(path)
    try:
        return parse(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}.") from None
    except RecursionError:
        raise ConfigError(
            f"{path}: is not {kind} file: its values are nested too deeply."
        ) from None
    except ValueError as error:  # another kind, not UTF-8, or a number of thousands of digits
        raise ConfigError(f"{path}: is not {kind} file: {shortened(str(error), 200)}.") from None


def explain(
    error: pydantic.ValidationError, model: type[pydantic.BaseModel] = pydantic.BaseModel
) -> str:
    """Describe the first validation errors of some settings in one sentence, with keys and values.

    Names of the model are suggested for unknown ones; long values are shortened.
    """
    found = error.errors(include_url=False)
    wrong = {problem["loc"][:-1] for problem in found}  # what lacks entries since these are wrong
    found = [one for one in found if one["type"] != "too_short" or one["loc"] not in wrong]
    problems, count = [], len(found)
    for problem in found[:MOST_PROBLEMS]:
        key = named(".".join(str(part) for part in problem["loc"])) or "the value"
        if problem["type"] == "extra_forbidden":
            problems.append(f"{key}: is not a known setting{_nearest(model, problem['loc'])}")
        elif problem["type"] == "model_type":
            problems.append(f"{key}: holds settings, found {shown(problem['input'], 120)}")
        elif problem["type"] == "value_error":  # raised by cvtgs, as a whole sentence
            problems.append(str(problem["ctx"]["error"]).removesuffix("."))
        else:
            problems.append(
                f"{key}: {problem['msg'].lower()}, found {shown(problem['input'], 120)}"
            )
    if count > MOST_PROBLEMS:
        problems.append(f"and {count - MOST_PROBLEMS:,} more")
    text = "; ".join(problems)
    return text if text.endswith("?") else f"{text}."


def _nearest(model: type[pydantic.BaseModel], path: Sequence[int | str]) -> str:
    """Return which setting of its section an unknown one may be meant to be."""
    *sections, name = map(str, path)
    for part in sections:
        field = model.model_fields.get(part)
        section = None if field is None else field.annotation
        if not (isinstance(section, type) and issubclass(section, pydantic.BaseModel)):
            return ""
        model = section
    known = [".".join([*sections, other]) for other in model.model_fields]
    return suggestion(".".join([*sections, name]), known, likeness=SETTING_LIKENESS)


def named(key: str) -> str:
    """Return a key as messages show it: short, on one line."""
    return shortened(key, 80) if key.isprintable() else shortened(repr(key), 80)
