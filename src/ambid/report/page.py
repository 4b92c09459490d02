"""The report: one HTML file with everything in it, for the archive and for other people."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from ambid.estimation.estimate import Check
from ambid.estimation.result import Verdict
from ambid.report.drawing import WIDE
from ambid.report.picture import picture
from ambid.report.strips import Strips
from ambid.report.text import SPREAD, WORDS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    Cell = str | tuple[str, str]
    """A text; or a text and its style: good, doubt, bad, dim."""
    Table = Sequence[Sequence[Cell]]
    """Rows; the first one, and the first cell of each, are heads."""

_LIBRARIES = ("ambid", "numpy", "scipy", "numba")


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A part of a page: what is given of it, in this order."""

    title: str
    caption: str = ""
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    text: str = ""  # as on a terminal
    figure: Callable[[float], Figure] | None = None  # draws it on a page of some width, inches
    signals: Sequence[Strips] = ()  # shown in the figure's place, where scripts run and nothing is printed
    note: str = ""  # behind tables and figure
    folded: bool = False

    def picture(self, k: int) -> tuple[str, str]:
        """Return the figure of the k-th section as HTML, and as JSON the points that a pointer reads of it."""
        from markupsafe import Markup

        assert self.figure is not None
        shown, read = picture(self.figure(WIDE), self.title, f"f{k}-")
        return Markup(shown), data_json(read) if read and not self.signals else ""

    def packed(self) -> list[str]:
        """Return what the page's script draws, as JSON."""
        return [data_json(part) for strips in self.signals for part in strips.packed()]


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """What a report says of a result beside its verdict."""

    title: str
    subtitle: str = ""
    warnings: Sequence[str] = ()
    sections: Sequence[Section] = ()
    provenance: Sequence[tuple[str, str]] = ()
    history: Sequence[str] = ()  # what was done to the record


def check_table(checks: Mapping[str, Check]) -> Table:
    """Return checks as a table without a head."""
    rows: list[Sequence[Cell]] = [("", "finding")]
    for name, c in checks.items():
        rows.append((("✓ " if c.passed else "✗ ") + name, (c.detail, "" if c.passed else "bad")))
    return rows


def origin(page: Page, made: str) -> list[tuple[str, str]]:
    """Return where a page comes from, as names and values; `made`: its date, left out where empty."""
    versions = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    return [*page.provenance, *([("made", made)] if made else []), ("versions", versions)]


def page_html(page: Page, verdict: Verdict, *, made: str = "") -> str:
    """Return a page as HTML with its figures inside; `made` is its date, left out where empty."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    def data(name: str) -> str:
        return files("ambid").joinpath("data", name).read_text(encoding="utf-8")

    interactive = any(s.signals for s in page.sections)
    sheet = "\n".join(data(name) for name in ("uPlot.min.css", "report.css")[not interactive :])
    script = "\n".join(data(name) for name in ("uPlot.iife.min.js", "report.js")[not interactive :])
    template = Environment(autoescape=True, undefined=StrictUndefined).from_string(data("report.html.j2"))
    words, style = WORDS[verdict.word]
    return template.render(
        page=page,
        words=words,
        spread=SPREAD,
        style=style,
        reasons=verdict.reasons,
        provenance=origin(page, made),
        sheet=Markup(sheet),
        script=Markup(script),
        style_hash=_hash(sheet),
        script_hash=_hash(script),
    )


def data_json(found: Mapping[str, Any]) -> str:
    """Return data as JSON that may stand in a page, whatever its texts hold."""
    from markupsafe import Markup

    return Markup(json.dumps(found, separators=(",", ":")).replace("<", "\\u003c"))


def _hash(text: str) -> str:
    """Return what a page's security policy calls a script or sheet, which no other text has."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
