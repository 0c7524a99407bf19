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
        """Print the versions and end.

        Args:
            parser: The parser of the command line.
            namespace: What was parsed so far.
            values: Nothing.
            option_string: How the option was written.
        """
        print("\n".join(version_lines()))
        parser.exit()


def version_lines() -> list[str]:
    """Give a line for cvtgs, for Python, and for every package that computes.

    Returns:
        The lines, that of cvtgs first.

    Example:
        >>> [line.split()[0] for line in version_lines()][:3]
        ['cvtgs', 'Python', 'torch']
    """
    lines = [f"cvtgs {cvtgs.__version__}", f"Python {platform.python_version()}"]
    return lines + [f"{name} {version_of(name)}" for name in BACKENDS]


def version_of(package: str) -> str:
    """Give the version of a package.

    Args:
        package: Its name.

    Returns:
        The version, or ``not installed``.

    Example:
        >>> version_of("no-such-package")
        'not installed'
    """
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
