"""What all configurations share: sections that refuse unknown keys, files, error texts."""

import tomllib
from pathlib import Path
from typing import Any

import pydantic

from cvtgs.errors import ConfigError


class Section(pydantic.BaseModel):
    """Some settings: frozen, unknown keys and numbers that are not finite are errors."""

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False
    )


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Args:
        path: The file.

    Returns:
        Its tables.

    Raises:
        ConfigError: It cannot be read, or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not a TOML file: {error}.") from None


def explain(error: pydantic.ValidationError) -> str:
    """Say in one sentence what is wrong with some settings.

    Args:
        error: What pydantic found.

    Returns:
        Every problem, with key and value.
    """
    problems = []
    for problem in error.errors():
        key = ".".join(str(part) for part in problem["loc"])
        if problem["type"] == "extra_forbidden":
            problems.append(f"{key}: is not a known setting")
        else:
            problems.append(f"{key}: {problem['msg'].lower()}, found {problem['input']!r}")
    return "; ".join(problems) + "."
