"""Options that take several words: ``0.1,0.01`` and ``draft,fast``."""

import argparse

from cvtgs.errors import InvalidArgumentError


def add_ratios_option(parser: argparse.ArgumentParser) -> None:
    """Describe the option that :func:`ratios_of` reads."""
    ratios = "0.1,0.01,0.001"
    parser.add_argument("--rho", default=ratios, metavar="R,R", help=f"ratios (default {ratios})")


def words_of(text: str) -> list[str]:
    """Read words with commas between them."""
    return [word.strip() for word in text.split(",") if word.strip()]


def ratios_of(text: str) -> list[float]:
    """Read ratios of Gaussians to keep with commas between them."""
    try:
        ratios = [float(word) for word in words_of(text)]
    except ValueError:
        ratios = []
    if not ratios or len(set(ratios)) < len(ratios):
        raise InvalidArgumentError(
            f"--rho must be different numbers with commas, for example 0.1,0.01; found {text!r}."
        )
    return ratios
