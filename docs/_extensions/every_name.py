"""Warn of public names that the reference does not show; with ``-W`` such a build fails."""

from collections.abc import Iterator
from importlib import import_module
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging

import cvtgs

logger = logging.getLogger(__name__)


def public_names() -> Iterator[tuple[str, set[str]]]:
    """Return all public names, and what else they are called."""
    packages = [f"cvtgs.{name}" for name in cvtgs._MODULES]
    pairs = [(home, name) for name, home in cvtgs._HOME.items()]
    pairs += [
        (package, name)
        for package in packages
        for name in getattr(import_module(package), "__all__", ())
    ]
    for home, name in pairs:
        value = getattr(import_module(home), name)
        own = f"{getattr(value, '__module__', home)}.{getattr(value, '__qualname__', name)}"
        yield f"{home}.{name}", {f"{home}.{name}", own}


def check(app: Sphinx, env: BuildEnvironment) -> None:
    """Compare with what the Python domain knows."""
    known = set(env.domains.python_domain.objects)
    for name, spellings in public_names():
        if not spellings & known:
            logger.warning("public name %s is not in the API reference", name)


def resolve_front_page(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element
) -> nodes.reference | None:
    """Find ``cvtgs.Simplifier`` where it is documented."""
    package, _, name = node["reftarget"].rpartition(".")
    if node["refdomain"] != "py" or package != "cvtgs" or name not in cvtgs._HOME:
        return None
    value = getattr(cvtgs, name)
    for home in (cvtgs._HOME[name], getattr(value, "__module__", "")):
        if f"{home}.{name}" in env.domains.python_domain.objects:
            return env.domains.python_domain.resolve_xref(
                env, node["refdoc"], app.builder, node["reftype"], f"{home}.{name}", node, content
            )
    return None


def setup(app: Sphinx) -> dict[str, Any]:
    """Check when all pages are read, and help references to the front page."""
    app.connect("missing-reference", resolve_front_page)
    app.connect("env-check-consistency", check)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
