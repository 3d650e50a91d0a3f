"""The documentation site: `make docs` builds it from this folder's Markdown and the docstrings."""

import re
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from sphinx.addnodes import desc_signature

import signorini_cr

project = "signorini_cr"
copyright = "the signorini_cr authors"
author = "The signorini_cr authors"
version = release = signorini_cr.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build"]
html_theme = "furo"
# Formulas are drawn by a file of the site's own: it is to be read without a network.
mathjax = Path(find_spec("sphinx-mathjax-offline").origin).parent / "static" / "mathjax"
html_static_path = [str(mathjax / "tex-svg.js"), "site.css"]
html_css_files = ["site.css"]
mathjax_path = "tex-svg.js"
html_title = "signorini_cr"
# Debian's Sphinx and pip's spell some things differently; words in code are left as they are.
smartquotes = False

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
# Tables and pictures of the benchmarks are files beside this folder, for download.
suppress_warnings = ["myst.header"]

autodoc_member_order = "bysource"
autodoc_typehints = "description"
python_use_unqualified_type_names = True
autodoc_typehints_description_target = "documented"
# Types by the names that the program gives them.
autodoc_type_aliases = {
    **{f"{kind}Array": f"{kind}Array" for kind in ("Bool", "Float", "Index", "Int32", "Int64")},
    "Data": "Data",
    "npt.ArrayLike": "ArrayLike",
}
autodoc_default_options = {"members": True}
napoleon_use_ivar = True
napoleon_preprocess_types = False
nitpicky = False
# In docstrings `name` is code.
default_role = "code"


def _as_text(app, what, name, obj, options, lines):
    """Keep |F| the measure of F, and y. the name of y; reStructuredText sees other things there."""
    lines[:] = [line.replace("|", r"\|") for line in lines]
    lines[:] = [re.sub(r"^( *(?::\w+ \w+: *)?)(\w\.)$", r"\1\\\2", line) for line in lines]


def _for_download(app, name, content):
    """Files beside this folder are handed over as they are."""
    content[0] = re.sub(r"\]\((\.\./[^)]*\.md)\)", r"](path:\1)", content[0])


def _where_it_is_defined(app, doctree):
    """Have the places that source pages link back to: names by the modules that define them."""
    for signature in doctree.findall(desc_signature):
        for name in list(signature["ids"]):
            thing, (_, *rest) = signorini_cr, name.split(".")
            while rest and isinstance(thing, ModuleType):
                thing = getattr(thing, rest.pop(0))
            if not isinstance(thing, ModuleType) and hasattr(thing, "__qualname__"):
                other = ".".join([thing.__module__, thing.__qualname__, *rest])
                if other not in signature["ids"]:
                    signature["ids"].append(other)


def setup(app):
    """Called by Sphinx."""
    app.connect("doctree-read", _where_it_is_defined)
    app.connect("autodoc-process-docstring", _as_text, priority=900)
    app.connect("source-read", _for_download)
