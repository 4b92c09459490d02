"""Sphinx settings. Pages are in Markdown, examples are run, commands and Python names describe themselves.

Nothing is loaded from elsewhere when a page is read: formulas become MathML, and the theme brings no font from outside.
"""

import re
import sys
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
from reference import write_reference  # noqa: E402

project = "ambid"
author = "the ambid contributors"
copyright = author  # noqa: A001
release = version = installed_version("ambid")

extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc", "sphinx_gallery.gen_gallery"]
exclude_patterns = ["_site", "_templates", "examples", "notebooks", "**/*.ipynb"]
myst_enable_extensions = ["amsmath", "dollarmath", "deflist"]
myst_heading_anchors = 4
suppress_warnings = ["config.cache"]  # the scraper below is a function, which Sphinx cannot compare

autodoc_typehints = "none"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False

html_theme = "furo"
html_title = "ambid"
html_show_sourcelink = False
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["pages.css"]
html_math_renderer = "mathml"
html_theme_options = {"footer_icons": []}
smartquotes_action = "qe"  # two hyphens begin an option
pygments_style = "friendly"


def _last_figure(block: tuple[Any, ...], names: dict[str, Any], settings: dict[str, Any]) -> str:
    """Save the figure that a block of an example ends with, as a notebook would show it, or calls `figure`."""
    from matplotlib.figure import Figure
    from sphinx_gallery.scrapers import figure_rst

    del block
    found = names["example_globals"].get("___") or names["example_globals"].pop("figure", None)
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


def _formula(self: Any, node: Any) -> None:
    """Write a formula as MathML, which browsers draw by themselves."""
    block = node.tagname == "math_block"
    text = node.astext()
    if block and "\\begin{" not in text and ("\\\\" in text or "&" in text):
        text = rf"\begin{{aligned}}{text}\end{{aligned}}"
    try:
        drawn = convert(text, display="block" if block else "inline")
    except Exception as why:  # whatever the converter dislikes names the page
        logging.getLogger(__name__).warning("formula %r: %s", text, why, location=node)
        drawn = ""
    self.body.append(f'<div class="formula">{drawn}</div>' if block else drawn)
    from docutils.nodes import SkipNode

    raise SkipNode


def _formulas_are_text(_app: object, _what: str, _name: str, _obj: object, _options: object, lines: list[str]) -> None:
    """Keep |x|, x* and *args of formulas from being read as markup, outside of ``code``."""
    for k, line in enumerate(lines):
        parts = line.split("``")
        parts[::2] = [re.sub(r"(?<!\\)([|*])", r"\\\1", part) for part in parts[::2]]
        lines[k] = "``".join(parts)


write_reference(HERE / "made" / "reference")


def setup(app: Sphinx) -> None:
    """Connect what is above; first, so that numpydoc's own markup comes after it."""
    app.add_html_math_renderer("mathml", inline_renderers=(_formula, None), block_renderers=(_formula, None))
    app.connect("autodoc-process-docstring", _formulas_are_text, priority=1)
