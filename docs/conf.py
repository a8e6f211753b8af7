"""The documentation site: `make docs` builds build/docs without network; warnings are errors."""

from __future__ import annotations

import inspect
import re
import sys
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent))

import reference_pages

project = "fhash"
version = release = installed("fhash")
author = "the fhash developers"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["examples"]
default_role = "code"

myst_enable_extensions = ["colon_fence", "attrs_block"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # outputs are those of `make notebooks`; tests run the cells

maximum_signature_line_length = 88
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "pydata_sphinx_theme"
html_title = f"fhash {version}"
html_static_path = ["_static"]
html_css_files = ["fhash.css"]
html_show_sourcelink = False
html_theme_options: dict[str, Any] = {
    "logo": {"text": "fhash"},
    "show_prev_next": True,
    "navigation_with_keys": False,
    "header_links_before_dropdown": 7,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": ["sphinx-version"],
}
html_sidebars = {"index": [], "first-hour": [], "gallery": [], "results": []}
copyright = "the fhash developers"
linkcheck_anchors = True
copybutton_exclude = ".linenos, .gp, .go"


def fields_of_parameters(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Turn paragraphs `name: text` on parameters into field lists, and indented code into blocks.

    Docstrings are written to be read in a terminal; this gives them the markup of a site.
    """
    known = set()
    if what in ("function", "method", "class"):
        known = set(inspect.signature(thing).parameters)
    made: list[str] = []
    field = code = False
    for line in lines:
        match = re.match(r"((?:[a-z_]+, )*[a-z_]+): (.*)", line)
        if match and known.issuperset(match[1].split(", ")):
            made += ([] if field else [""]) + [f":param {match[1]}: {match[2]}"]
            field = True
            continue
        if line.startswith("    ") and not field and not code and made and not made[-1]:
            made += [".. code-block:: python", ""]
            code = True
        elif line and not line.startswith(" "):
            made += [""] if field else []
            field = code = False
        made.append(line)
    lines[:] = [*made, ""]


def signature_as_written(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, shown: str, returned: str
) -> tuple[str, str] | None:
    """A signature with annotations as the source has them, not as unions of numpy's protocols."""
    if what not in ("function", "method", "class") or not shown:
        return None
    text = str(inspect.signature(thing))
    text = re.sub(r"(: |-> )'([^']+)'", r"\1\2", text)
    text = re.sub(r"<function (\w+) at \w+>", r"\1", text)
    text = re.sub(r"\b(self|cls)(, |(?=\)))", "", text, count=1)
    arguments, _, result = text.partition(" -> ")
    return arguments, "" if what == "class" else result


def setup(app: Sphinx) -> None:
    """Register what this site adds to Sphinx."""
    reference_pages.write(Path(__file__).parent / "reference" / "made")
    app.connect("autodoc-process-docstring", fields_of_parameters)
    app.connect("autodoc-process-signature", signature_as_written)
