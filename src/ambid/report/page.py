"""The report: one HTML file with everything in it, for the archive and for other people."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from ambid.estimation.result import Verdict
from ambid.report.document import Document, Part, Preformatted, Section, grid, page_sections, pieces, warnings_of
from ambid.report.drawing import STYLES, WIDE
from ambid.report.picture import picture
from ambid.report.text import SPREAD, WORDS, Cell, columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    Said = tuple[str, dict[str, Any]]
    """A line of text, and how it is set."""


_LIBRARIES = ("ambid", "numpy", "scipy", "numba")


def drawn_picture(section: Section, k: int) -> tuple[str, str]:
    """Return the figure of the k-th section as HTML, and as JSON the points that a pointer reads of it."""
    from markupsafe import Markup

    assert section.figure is not None
    html_text, read = picture(section.figure(WIDE), section.title, f"f{k}-")
    return Markup(html_text), data_json(read) if read and not section.signals else ""


def origin(document: Document, made: str) -> list[tuple[str, str]]:
    """Return where a page comes from, as names and values; `made`: its date, left out where empty."""
    versions = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    return [*document.provenance, *([("made", made)] if made else []), ("versions", versions)]


def page_html(document: Document, verdict: Verdict, *, made: str = "") -> str:
    """Return a page as HTML with its figures inside; `made` is its date, left out where empty."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    def data(name: str) -> str:
        return files("ambid").joinpath("data", name).read_text(encoding="utf-8")

    sections = page_sections(document)
    interactive = any(s.signals for s in sections)
    sheet = "\n".join(data(name) for name in ("uPlot.min.css", "report.css")[not interactive :])
    script = "\n".join(data(name) for name in ("uPlot.iife.min.js", "report.js")[not interactive :])
    template = Environment(autoescape=True, undefined=StrictUndefined).from_string(data("report.html.j2"))
    words, style = WORDS[verdict.word]
    return template.render(
        title=document.headline or document.title,
        subtitle=document.subtitle,
        warnings=warnings_of(document),
        sections=sections,
        pieces=pieces,
        picture=drawn_picture,
        packed=lambda s: [data_json(part) for strips in s.signals for part in strips.packed()],
        history=document.history,
        words=words,
        spread=SPREAD,
        style=style,
        reasons=verdict.reasons,
        provenance=origin(document, made),
        sheet=Markup(sheet),
        script=Markup(script),
        style_hash=_hash(sheet),
        script_hash=_hash(script),
    )


def data_json(data: Mapping[str, Any]) -> str:
    """Return data as JSON that may stand in a page, whatever its texts hold."""
    from markupsafe import Markup

    return Markup(json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"))


def _hash(text: str) -> str:
    """Return what a page's security policy calls a script or sheet, which no other text has."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


_LEAF = (11.69, 8.27)  # inches, A4 on its side; a taller figure gets A3 upright, which is as wide

_TALL = 16.54

_EDGE = (_LEAF[0] - WIDE) / 2

_HEAD, _FOOT = 1.0, 0.35  # inches above and below a figure

_LETTERS, _HEADLINE = 160, 85  # of a line

_PLAIN: dict[str, Any] = {"size": 8, "family": "monospace"}

_DIM = {"size": 9, "color": "#5f5f5f"}

_STEP = 1.45  # of the size of its letters that a line is high


def page_pdf(document: Document, verdict: Verdict, *, made: str = "") -> bytes:
    """Return a page as PDF, with the sections that `page_html` shows; `made` is its date, left out where empty."""
    from matplotlib.backends.backend_pdf import PdfPages

    words, style = WORDS[verdict.word]
    title = document.headline or document.title
    headline: dict[str, Any] = {"size": 15, "weight": "bold"}
    lines: list[Said] = [(line, headline) for line in textwrap.wrap(title, _HEADLINE)]
    lines += _wrapped(document.subtitle, _DIM)
    lines += [(f"verdict: {words}", {"size": 12, "weight": "bold", "color": STYLES[style]}), (f"{SPREAD}.", _DIM)]
    for reason in verdict.reasons:
        lines += _wrapped(f"{reason.check}: {reason.text}", {"size": 9})
    for warning in warnings_of(document):
        lines += _wrapped(warning, {"size": 9, "color": STYLES["doubt"]})
    buffer = io.BytesIO()
    with PdfPages(buffer, metadata={"Title": title, "Creator": "ambid", "CreationDate": None}) as book:
        for section in page_sections(document):
            drawn = section.figure is not None
            if section.signals and not drawn:  # their figure stands in another section
                continue
            if section.parts or not drawn:
                lines += _section(section)
            if drawn:
                _write(book, lines)
                lines = []
                _draw(book, section)
        parts: list[Part] = [grid([("", ""), *origin(document, made)]), Preformatted(text="\n".join(document.history))]
        lines += _section(Section(title="Where it comes from", parts=parts))
        _write(book, lines)
    return buffer.getvalue()


def _section(section: Section) -> Iterator[Said]:
    """Set title, texts and tables of a section."""
    yield "", _PLAIN
    yield section.title, {"size": 11, "weight": "bold"}
    yield from _wrapped(section.caption, _DIM)
    for kind, piece in pieces(section.parts):
        if kind == "table":
            yield from _table(piece)
        elif kind == "paragraph":
            yield from _wrapped(piece, {"size": 9})
        else:
            for line in piece.splitlines():
                yield from _wrapped(line or " ", _PLAIN)
    yield from _wrapped(section.note, _DIM)


def _table(rows: Sequence[Sequence[Cell]]) -> Iterator[Said]:
    """Set a table in columns, each row in the colour of what it warns of."""
    for row, line in zip(rows, columns(rows), strict=True):
        styles = {cell[1] for cell in row if not isinstance(cell, str)}
        colour = next((STYLES[name] for name in ("bad", "doubt") if name in styles), "#1a1a1a")
        yield from _wrapped(line, {**_PLAIN, "color": colour})


def _wrapped(text: str, how: dict[str, Any]) -> Iterator[Said]:
    """Set a text in lines that fit."""
    for line in textwrap.wrap(
        text, _LETTERS, subsequent_indent="    ", replace_whitespace=False, drop_whitespace=False
    ):
        yield line, how


def _write(book: Any, lines: Sequence[Said]) -> None:
    """Write lines on as many leaves as they need."""
    from matplotlib.figure import Figure

    leaf, left = None, 0.0
    for text, how in lines:
        high = _STEP * how["size"] / 72
        if leaf is None or left < high + _FOOT + 0.8 * ("weight" in how):  # no title at the foot
            if leaf is not None:
                book.savefig(leaf)
            leaf, left = Figure(figsize=_LEAF), _LEAF[1] - _FOOT
        left -= high
        leaf.text(_EDGE / _LEAF[0], left / _LEAF[1], text, va="baseline", parse_math=False, **how)
    if leaf is not None:
        book.savefig(leaf)


def _draw(book: Any, section: Section) -> None:
    """Draw the figure of a section on a leaf, below its title and caption."""
    from matplotlib.transforms import Bbox

    assert section.figure is not None
    figure: Figure = section.figure(WIDE)
    width, height = figure.get_size_inches()
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for part in (figure, *figure.subfigs):
        for legend in part.legends:  # those outside would follow the leaf's border
            box = legend.get_window_extent().transformed(figure.transFigure.inverted())
            legend.set_loc("center")
            legend.set_bbox_to_anchor(box, transform=figure.transFigure)
    lines = [(section.title, {"size": 12, "weight": "bold"}), *_wrapped(section.caption, _DIM)]
    top = _HEAD + 0.1
    for text, how in lines:
        top -= _STEP * how["size"] / 72
        drawn_text = figure.text(0.0, (height + top - 0.35) / height, text, va="baseline", parse_math=False, **how)
        drawn_text.set_in_layout(False)
    whole = next((x for x in (_LEAF[1], _TALL) if x >= height + _HEAD + _FOOT), height + _HEAD + _FOOT)
    book.savefig(figure, bbox_inches=Bbox([[-_EDGE, height + _HEAD - whole], [width + _EDGE, height + _HEAD]]))
