"""References that Sphinx does not resolve, and a warning for public names without a page.

Names that ``cvtgs`` or a package re-exports are found where they are documented. Types of other
packages are linked by a table, without a download. All other unknown names are still reported,
since Sphinx is nitpicky.
"""

import sys
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging

import cvtgs

PYTHON = "https://docs.python.org/3/library"
TORCH = "https://docs.pytorch.org/docs/stable"
JAXTYPING = "https://docs.kidger.site/jaxtyping/api/array/"
PYDANTIC = "https://docs.pydantic.dev/latest/api"
NUMPY = "https://numpy.org/doc/stable/reference"

PAGES = {
    "torch.Tensor": f"{TORCH}/tensors.html",
    "torch.device": f"{TORCH}/tensor_attributes.html#torch.device",
    "torch.dtype": f"{TORCH}/tensor_attributes.html#torch.dtype",
    "torch.Generator": f"{TORCH}/generated/torch.Generator.html",
    "torch.nn.Module": f"{TORCH}/generated/torch.nn.Module.html",
    "torch.nn.ParameterDict": f"{TORCH}/generated/torch.nn.ParameterDict.html",
    "jaxtyping.Bool": JAXTYPING,
    "jaxtyping.Float": JAXTYPING,
    "jaxtyping.Int": JAXTYPING,
    "jaxtyping.Integer": JAXTYPING,
    "jaxtyping.Shaped": JAXTYPING,
    "jaxtyping.UInt8": JAXTYPING,
    "pydantic.BaseModel": f"{PYDANTIC}/base_model/",
    "pydantic.ValidationError": f"{PYDANTIC}/pydantic_core/#pydantic_core.ValidationError",
    "distributed.Client": "https://distributed.dask.org/en/stable/api.html#distributed.Client",
    "numpy.bool": f"{NUMPY}/arrays.scalars.html#numpy.bool",
    "numpy.dtype": f"{NUMPY}/generated/numpy.dtype.html",
    "numpy.ndarray": f"{NUMPY}/generated/numpy.ndarray.html",
    "numpy.typing.ArrayLike": f"{NUMPY}/typing.html",
}
"""Full name to page."""

ALIASES = {
    "Tensor": "torch.Tensor",
    "nn.Module": "torch.nn.Module",
    "torch.nn.modules.module.Module": "torch.nn.Module",
    "torch.nn.modules.container.ParameterDict": "torch.nn.ParameterDict",
    "torch._C.Generator": "torch.Generator",
    "pydantic.main.BaseModel": "pydantic.BaseModel",
    "pydantic_core._pydantic_core.ValidationError": "pydantic.ValidationError",
    "Path": "pathlib.Path",
    "Client": "distributed.Client",
    "ndarray": "numpy.ndarray",
    "np.ndarray": "numpy.ndarray",
}
"""Other names under which annotations know the same types."""

logger = logging.getLogger(__name__)


def page_of(target: str) -> str | None:
    """Return the page of a type of another package, or of the standard library."""
    target = ALIASES.get(target, target)
    if target in PAGES:
        return PAGES[target]
    module, _, name = target.rpartition(".")
    if module and module.split(".")[0] in sys.stdlib_module_names:
        public = module.removeprefix("_")
        return f"{PYTHON}/{public}.html#{public}.{name}"
    return None


def documented_name(env: BuildEnvironment, package: str, name: str) -> str | None:
    """Return the name under which the reference has a public name of a package."""
    known = env.domains.python_domain.objects
    value = getattr(import_module(package), name)
    own = f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', '')}"
    for spelling in (f"{package}.{name}", own):
        if spelling in known:
            return spelling
    return None


def public_names() -> Iterator[tuple[str, str]]:
    """Return the package and the name of everything that is public."""
    yield from ((home, name) for name, home in cvtgs._HOME.items())
    for package in (f"cvtgs.{name}" for name in cvtgs._MODULES):
        yield from ((package, name) for name in getattr(import_module(package), "__all__", ()))


def check(app: Sphinx, env: BuildEnvironment) -> None:
    """Warn of public names that the reference does not show; with ``-W`` such a build fails."""
    for package, name in public_names():
        if documented_name(env, package, name) is None:
            logger.warning("public name %s.%s is not in the API reference", package, name)


def resolve(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element
) -> nodes.reference | None:
    """Find a name that Sphinx could not resolve."""
    if node["refdomain"] != "py":
        return None
    target = node["reftarget"]
    package, _, name = target.rpartition(".")
    if package == "cvtgs":
        package = cvtgs._HOME.get(name, package)
    elif not package:  # a name of the same package, from one of its modules
        package = ".".join((node.get("py:module") or "").split(".")[:2])
    if (package, name) in set(public_names()):
        found = documented_name(env, package, name)
        return env.domains.python_domain.resolve_xref(
            env, node["refdoc"], app.builder, node["reftype"], found or target, node, content
        )
    page = page_of(target)
    if page is None:
        return None
    return nodes.reference("", "", content.deepcopy(), internal=False, refuri=page)


def setup(app: Sphinx) -> dict[str, Any]:
    """Listen to unresolved references, and check when all pages are read."""
    app.connect("missing-reference", resolve)
    app.connect("env-check-consistency", check)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
