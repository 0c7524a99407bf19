"""Sphinx configuration; ``nox -s docs`` builds the pages into ``docs/_build/html``.

Nothing is fetched: formulas become MathML, and types of other packages link to their documentation
by a table (``_extensions/references.py``).
"""

import sys
from pathlib import Path

import cvtgs

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "cvtgs"
author = "the cvtgs authors"
copyright = "the cvtgs authors, Apache-2.0"
version = release = cvtgs.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "commands",
    "docstrings",
    "mathml",
    "references",
]
exclude_patterns = ["_build", "_extensions", "drawings"]

html_theme = "furo"
html_title = f"cvtgs {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sphinx = False
copybutton_prompt_text = r"\$ |>>> |\.\.\. "
copybutton_prompt_is_regexp = True

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 3
myst_links_external_new_tab = False
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_execution_show_tb = True

nitpicky = True
nitpick_ignore = [  # types that callers only hand on
    ("py:class", "cvtgs.outofcore.job.Job"),
    ("py:class", "cvtgs.views.layout.SceneLayout"),
]
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_class_signature = "mixed"
autodoc_inherit_docstrings = False
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
