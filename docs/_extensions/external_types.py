"""Link types of other packages to their documentation, by a table and without a download.

A name that is neither ours nor in the table is still reported, since Sphinx is nitpicky.
"""

import sys
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

PYTHON = "https://docs.python.org/3/library"
TORCH = "https://docs.pytorch.org/docs/stable"
JAXTYPING = "https://docs.kidger.site/jaxtyping/api/array/"
PYDANTIC = "https://docs.pydantic.dev/latest/api"

PAGES = {
    "torch.Tensor": f"{TORCH}/tensors.html",
    "torch.device": f"{TORCH}/tensor_attributes.html#torch.device",
    "torch.dtype": f"{TORCH}/tensor_attributes.html#torch.dtype",
    "torch.Generator": f"{TORCH}/generated/torch.Generator.html",
    "torch.nn.Module": f"{TORCH}/generated/torch.nn.Module.html",
    "jaxtyping.Bool": JAXTYPING,
    "jaxtyping.Float": JAXTYPING,
    "jaxtyping.Int": JAXTYPING,
    "jaxtyping.UInt8": JAXTYPING,
    "pydantic.BaseModel": f"{PYDANTIC}/base_model/",
    "pydantic.ValidationError": f"{PYDANTIC}/pydantic_core/#pydantic_core.ValidationError",
    "distributed.Client": "https://distributed.dask.org/en/stable/api.html#distributed.Client",
    "numpy.dtype": "https://numpy.org/doc/stable/reference/generated/numpy.dtype.html",
    "numpy.ndarray": "https://numpy.org/doc/stable/reference/generated/numpy.ndarray.html",
    "numpy.typing.ArrayLike": "https://numpy.org/doc/stable/reference/typing.html",
}
"""Full name to page."""

ALIASES = {
    "Tensor": "torch.Tensor",
    "nn.Module": "torch.nn.Module",
    "torch.nn.modules.module.Module": "torch.nn.Module",
    "pydantic.main.BaseModel": "pydantic.BaseModel",
    "Path": "pathlib.Path",
    "Client": "distributed.Client",
    "ndarray": "numpy.ndarray",
    "torch._C.Generator": "torch.Generator",
    "pydantic_core._pydantic_core.ValidationError": "pydantic.ValidationError",
    "np.ndarray": "numpy.ndarray",
}
"""Other names under which annotations know the same types."""


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


def resolve(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element
) -> nodes.reference | None:
    """Answer a reference that Sphinx could not resolve."""
    page = page_of(node["reftarget"]) if node["refdomain"] == "py" else None
    if page is None:
        return None
    return nodes.reference("", "", content.deepcopy(), internal=False, refuri=page)


def setup(app: Sphinx) -> dict[str, Any]:
    """Listen to unresolved references."""
    app.connect("missing-reference", resolve)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
