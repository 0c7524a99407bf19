"""``--effects``: switch effects on or off, and read no more of a file than they need."""

import argparse
from typing import TYPE_CHECKING

from cvtgs.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

    from cvtgs.config import SimplifyConfig
    from cvtgs.scene import GaussianScene


def add_effects_option(parser: argparse.ArgumentParser) -> None:
    """Describe the option."""
    parser.add_argument(
        "--effects",
        metavar="NAME=VALUE,...",
        help="what to compute whatever the scene calls for, for example sh=1,mip=off; names: sh "
        "(0 to 3), mip, unbounded, haze, duplicates (on or off), flat, extras, visibility (off)",
    )


def effect_settings(text: str | None) -> dict[str, str]:
    """Turn the option into settings of the configuration."""
    settings = {}
    for word in [] if text is None else text.split(","):
        name, equals, value = (part.strip() for part in word.partition("="))
        if not (name and equals and value):
            raise ConfigError(
                f"--effects needs NAME=VALUE, for example sh=1,mip=off; found {word!r}."
            )
        settings[f"effects.{name}"] = value
    return settings


def load_needed(path: "Path", config: "SimplifyConfig") -> "GaussianScene":
    """Read a scene without what is switched off."""
    from cvtgs.io import load  # noqa: PLC0415 (keeps --help fast)

    choices = config.effects
    degree = None if choices.sh == "auto" else choices.sh
    return load(path, sh_degree=degree, extras=choices.extras != "off")
