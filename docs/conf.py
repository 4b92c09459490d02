"""Sphinx settings. Pages are in Markdown, examples are run, commands and Python names describe themselves.

Nothing is loaded from elsewhere when a page is read: MathJax comes from an installed package, in the form that
draws without font files, and the theme uses the fonts of the machine.
"""

import re
import sys
from importlib.metadata import files as installed_files
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
from reference import write_reference  # noqa: E402

project = "ambid"
author = "the ambid contributors"
copyright = author  # noqa: A001
release = version = installed_version("ambid")

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_site", "_templates", "examples", "notebooks", "**/*.ipynb"]
myst_enable_extensions = ["amsmath", "dollarmath", "deflist"]
myst_heading_anchors = 4
# The scraper below is a function, which Sphinx cannot compare; an attribute of many classes has several targets.
suppress_warnings = ["config.cache", "ref.python"]

autodoc_typehints = "none"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False

_MATHJAX = next(f for f in installed_files("sphinx-mathjax-offline") or () if f.name == "tex-svg.js")

html_theme = "furo"
html_title = "ambid"
html_show_sourcelink = False
html_copy_source = False
html_static_path = ["static", str(_MATHJAX.locate())]
html_css_files = ["pages.css"]
mathjax_path = _MATHJAX.name
mathjax3_config = {"options": {"enableMenu": False}}  # which would load more
html_theme_options = {"footer_icons": []}
smartquotes_action = "qe"  # two hyphens begin an option
pygments_style = "friendly"


def _last_figure(block: tuple[Any, ...], names: dict[str, Any], settings: dict[str, Any]) -> str:
    """Save the figure that a block of an example ends with, as a notebook would show it, or calls `figure`."""
    from matplotlib.figure import Figure
    from sphinx_gallery.scrapers import figure_rst

    del block
    known = names["example_globals"]
    found = known.pop("figure") if "figure" in known else known.get("___")
    if not isinstance(found, Figure):
        return ""
    path = next(names["image_path_iterator"])
    found.savefig(path, dpi=110)
    return str(figure_rst([path], settings["src_dir"]))


sphinx_gallery_conf = {
    "examples_dirs": ["notebooks", "examples"],
    "gallery_dirs": ["made/notebooks", "made/gallery"],
    "filename_pattern": r"\.py$",
    "ignore_pattern": "real_maglev",  # its records are not part of the repository
    "image_scrapers": (_last_figure,),
    "capture_repr": ("_repr_html_", "__repr__"),
    "ignore_repr_types": r"matplotlib\.figure",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "write_computation_times": False,
    "show_signature": False,
    "reset_modules": (),
    "abort_on_example_error": True,
}


def _formulas_are_text(_app: object, _what: str, _name: str, _obj: object, _options: object, lines: list[str]) -> None:
    """Keep |x|, x* and *args of formulas from being read as markup, outside of ``code``."""
    for k, line in enumerate(lines):
        parts = line.split("``")
        parts[::2] = [re.sub(r"(?<!\\)([|*])", r"\\\1", part) for part in parts[::2]]
        lines[k] = "``".join(parts)


def _keep_numbers(_app: object, page: nodes.document) -> None:
    """Give a numbered formula an environment that takes a number also where it holds several rows."""
    for formula in page.findall(nodes.math_block):
        text = formula.astext()
        if "\\tag{" in text:
            formula.children = [nodes.Text(rf"\begin{{equation}}{text.strip()}\end{{equation}}")]
            formula["nowrap"] = True


write_reference(HERE / "made" / "reference")


def setup(app: Sphinx) -> None:
    """Connect what is above; first, so that numpydoc's own markup comes after it."""
    app.connect("autodoc-process-docstring", _formulas_are_text, priority=1)
    app.connect("doctree-read", _keep_numbers)
