"""``cvtgs --version``: the versions of what computes, without loading any of it."""

import argparse
import platform
from collections.abc import Sequence
from importlib import metadata
from typing import Any, NoReturn

import cvtgs

BACKENDS = ("torch", "numpy", "scipy", "numba", "gsplat")
"""The packages that compute; the last two are optional."""


class ShowVersions(argparse.Action):
    """Print the versions and end."""

    def __init__(self, option_strings: Sequence[str], dest: str, **settings: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, **settings)

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> NoReturn:
        """Print the versions and end."""
        print("\n".join(version_lines()))
        parser.exit()


def version_lines() -> list[str]:
    """Return a line for cvtgs, for Python, and for every package that computes."""
    lines = [f"cvtgs {cvtgs.__version__}", f"Python {platform.python_version()}"]
    return lines + [f"{name} {version_of(name)}" for name in BACKENDS]


def version_of(package: str) -> str:
    """Return the version of a package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
