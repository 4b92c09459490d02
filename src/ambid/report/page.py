"""The report: one HTML file with everything in it, for the archive and for other people."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from typing import TYPE_CHECKING

from ambid.estimation.estimate import Check
from ambid.estimation.result import Verdict
from ambid.report.drawing import NARROW, WIDE, save
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
    note: str = ""  # behind tables and figure
    folded: bool = False

    def image(self, width: float) -> str:
        """Return the figure as PNG in base 64, drawn for a page of some width in inches; empty without one."""
        if self.figure is None:
            return ""
        buffer = io.BytesIO()
        save(self.figure(width), buffer, kind="png")
        return base64.b64encode(buffer.getvalue()).decode()


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


def page_html(page: Page, verdict: Verdict, *, made: str = "") -> str:
    """Return a page as HTML with its figures inside; `made` is its date, left out where empty."""
    from jinja2 import Environment, StrictUndefined

    source = files("ambid").joinpath("data", "report.html.j2").read_text(encoding="utf-8")
    template = Environment(autoescape=True, undefined=StrictUndefined).from_string(source)
    last = [("made", made)] if made else []
    last += [("versions", ", ".join(f"{name} {version(name)}" for name in _LIBRARIES))]
    words, style = WORDS[verdict.word]
    return template.render(
        page=page,
        words=words,
        spread=SPREAD,
        style=style,
        reasons=verdict.reasons,
        provenance=[*page.provenance, *last],
        wide=WIDE,
        narrow=NARROW,
    )
