"""Sphinx settings: pages in Markdown (MyST), API pages from numpydoc docstrings."""

import re
from importlib.metadata import version as installed_version
from pathlib import Path

from sphinx.application import Sphinx

project = "ambid"
author = "the ambid contributors"
copyright = author  # noqa: A001
release = version = installed_version("ambid")

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
myst_enable_extensions = ["amsmath", "dollarmath", "deflist"]
myst_heading_anchors = 3

autosummary_generate = True
# Each name is described once, on the page of the module that defines it.
autodoc_default_options = {"ignore-module-all": True}
autodoc_typehints = "none"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

templates_path = ["_templates"]
exclude_patterns = ["_site", "_templates"]
html_theme = "alabaster"
html_title = f"ambid {release}"
html_theme_options = {
    "description": "Active magnetic bearings, identified",
    "page_width": "72em",
    "fixed_sidebar": True,
}
html_sidebars = {"**": ["about.html", "navigation.html", "searchbox.html"]}
html_show_sourcelink = False

_PACKAGE = Path(__file__).resolve().parent.parent / "src" / "ambid"


def _public_modules() -> list[str]:
    """Name the public modules of the package, rooms before their files; private ones begin with an underscore."""
    names = []
    for path in sorted(_PACKAGE.rglob("*.py")):
        parts = path.relative_to(_PACKAGE.parent).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        if len(parts) > 1 and not any(part.startswith("_") for part in parts):
            names.append(".".join(parts))
    return sorted(names)


def _write_api_index() -> None:
    """List every public module, so that a new file has its page without an entry by hand."""
    lines = ["# API reference", "", "From the docstrings; one page per module.", ""]
    lines += ["```{eval-rst}", ".. autosummary::", "   :toctree: generated", "   :template: module.rst", ""]
    lines += [*(f"   {name}" for name in _public_modules()), "```", ""]
    target = Path(__file__).resolve().parent / "api" / "index.md"
    target.parent.mkdir(exist_ok=True)
    text = "\n".join(lines)
    if not target.is_file() or target.read_text(encoding="utf-8") != text:
        target.write_text(text, encoding="utf-8")


_write_api_index()


def _formulas_are_text(_app: object, _what: str, _name: str, _obj: object, _options: object, lines: list[str]) -> None:
    """Keep |x|, x* and *args of formulas from being read as markup, outside of ``code``."""
    for k, line in enumerate(lines):
        parts = line.split("``")
        parts[::2] = [re.sub(r"(?<!\\)([|*])", r"\\\1", part) for part in parts[::2]]
        lines[k] = "``".join(parts)


def setup(app: Sphinx) -> None:
    """Connect what is above; first, so that numpydoc's own markup comes after it."""
    app.connect("autodoc-process-docstring", _formulas_are_text, priority=1)
