"""A page as PDF: its texts and tables on leaves of A4, each figure on a leaf of its own."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from ambid.estimation.result import Verdict
from ambid.report.drawing import STYLES, WIDE
from ambid.report.page import Page, Section, origin
from ambid.report.text import SPREAD, WORDS, columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ambid.report.page import Table

    Said = tuple[str, dict[str, Any]]
    """A line of text, and how it is set."""

_LEAF = (11.69, 8.27)  # inches, A4 on its side; a taller figure gets A3 upright, which is as wide
_TALL = 16.54
_EDGE = (_LEAF[0] - WIDE) / 2
_HEAD, _FOOT = 1.0, 0.35  # inches above and below a figure
_LETTERS = 160  # of a line
_PLAIN: dict[str, Any] = {"size": 8, "family": "monospace"}
_DIM = {"size": 9, "color": "#5f5f5f"}
_STEP = 1.45  # of the size of its letters that a line is high


def page_pdf(page: Page, verdict: Verdict, *, made: str = "") -> bytes:
    """Return a page as PDF, with the sections that `page_html` shows; `made` is its date, left out where empty."""
    from matplotlib.backends.backend_pdf import PdfPages

    words, style = WORDS[verdict.word]
    lines: list[Said] = [(page.title, {"size": 15, "weight": "bold"}), *_wrapped(page.subtitle, _DIM)]
    lines += [(f"verdict: {words}", {"size": 12, "weight": "bold", "color": STYLES[style]}), (f"{SPREAD}.", _DIM)]
    for reason in verdict.reasons:
        lines += _wrapped(f"{reason.check}: {reason.text}", {"size": 9})
    for warning in page.warnings:
        lines += _wrapped(warning, {"size": 9, "color": STYLES["doubt"]})
    kept = io.BytesIO()
    with PdfPages(kept, metadata={"Title": page.title, "Creator": "ambid", "CreationDate": None}) as book:
        for section in page.sections:
            drawn = section.figure is not None
            if section.signals and not drawn:  # their figure stands in another section
                continue
            if not drawn or section.tables or section.text:
                lines += _section(section)
            if drawn:
                _write(book, lines)
                lines = []
                _draw(book, section)
        rows = [("", ""), *origin(page, made)]
        lines += _section(Section(title="Where it comes from", tables=[rows], text="\n".join(page.history)))
        _write(book, lines)
    return kept.getvalue()


def _section(section: Section) -> Iterator[Said]:
    """Set title, texts and tables of a section."""
    yield "", _PLAIN
    yield section.title, {"size": 11, "weight": "bold"}
    yield from _wrapped(section.caption, _DIM)
    for paragraph in section.paragraphs:
        yield from _wrapped(paragraph, {"size": 9})
    for table in section.tables:
        yield from _table(table)
    for line in section.text.splitlines():
        yield from _wrapped(line or " ", _PLAIN)
    yield from _wrapped(section.note, _DIM)


def _table(table: Table) -> Iterator[Said]:
    """Set a table in columns, each row in the colour of what it warns of."""
    plain = [[cell if isinstance(cell, str) else cell[0] for cell in row] for row in table]
    for row, line in zip(table, columns(plain), strict=True):
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
        said = figure.text(0.0, (height + top - 0.35) / height, text, va="baseline", parse_math=False, **how)
        said.set_in_layout(False)
    whole = next((x for x in (_LEAF[1], _TALL) if x >= height + _HEAD + _FOOT), height + _HEAD + _FOOT)
    book.savefig(figure, bbox_inches=Bbox([[-_EDGE, height + _HEAD - whole], [width + _EDGE, height + _HEAD]]))
