"""What is shown of a result, declared once: tables by column, lines, checks, sections and figures.

Terminal (`terminal`), HTML page (`page.page_html`), PDF (`book.page_pdf`), DataFrame (`Table.frame`) and the short
forms render the same `Document`. A column that is added to a table appears in all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from ambid.estimation.estimate import Check, fields_json
from ambid.report.text import (
    WIDTH,
    Cell,
    Line,
    Paint,
    check_lines,
    columns,
    hanging,
    joined,
    other_warnings,
    painted,
    parts_of,
    plain,
    text_of,
    warning_lines,
    wrapped,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ambid.report.signals import Strips

Frame = tuple[str, Mapping[str, Sequence[object]]]
"""Name of the column that is the index, and the columns of a DataFrame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One column of a table: what people read of a row, and the numbers that a DataFrame has of it."""

    label: Cell = ""
    cell: Callable[[Any], Cell] | None = None  # of a row; None: the column is in frames alone
    wide: Callable[[Any], Cell] | None = None  # the same on pages, where that is another text
    frame: Mapping[str, Callable[[Any], object]] = field(default_factory=lambda: MappingProxyType({}))
    right: bool = False  # whether a terminal aligns it right
    spare: bool = False  # whether a terminal that is too narrow leaves it out
    page: bool = False  # whether it is on pages alone
    about: bool = False  # whether it says more of the first column, as a page may where a pointer rests
    sparse: bool = False  # whether it is left out where no row has a text in it


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows of any kind, seen through columns."""

    columns: Sequence[Column]
    rows: Sequence[Any]
    bare: bool = False  # whether a terminal shows no labels

    def cells(self, *, page: bool = False, spare: bool = True) -> tuple[list[list[Cell]], list[int]]:
        """Return the labels and the cells of each row as they are written, and which columns are aligned right."""
        right, written = [], list[list[Cell]]()
        for column in self.columns:
            if column.cell is None or (column.page and not page) or (column.spare and not spare):
                continue
            write = (column.wide if page else None) or column.cell
            cells = [write(row) for row in self.rows]
            if column.sparse and not any(text_of([cell]) for cell in cells):
                continue
            if column.right:
                right.append(len(written))
            written.append([column.label, *cells])
        return [list(row) for row in zip(*written, strict=True)], right

    def lines(self, width: int, paint: Paint) -> list[str]:
        """Return the table in columns of a terminal, without the spare ones where it is too narrow."""
        cells, right = self.cells()
        if max(map(len, columns(cells, right=right))) > width and any(c.spare for c in self.columns):
            cells, right = self.cells(spare=False)
        return columns(cells[self.bare :], right=right, paint=paint)

    def frame(self) -> Frame:
        """Return the numbers of the rows by column; the first one is the index."""
        numbers = {
            name: [cell(row) for row in self.rows] for column in self.columns for name, cell in column.frame.items()
        }
        return next(iter(numbers)), numbers


def grid(rows: Sequence[Sequence[Cell]], right: Sequence[int] = (), *, bare: bool = False) -> Table:
    """Return rows of written cells, the labels first, as a table; columns `right` are aligned right.

    `bare`: whether a terminal shows no labels.
    """
    head, *body = rows
    columns = [Column(label=x, cell=itemgetter(k), right=k in right) for k, x in enumerate(head)]
    return Table(columns=columns, rows=body, bare=bare)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lines:
    """Lines of text; on a page each is a paragraph."""

    lines: Sequence[Line]
    indent: int = 0  # columns by which what goes on is indented
    hang: bool = False  # whether the last part of a line goes on below, behind a head that is not broken
    wrap: bool = True
    style: str = ""  # of all

    def written(self, width: int, paint: Paint) -> list[str]:
        """Return the lines as a terminal shows them."""
        lines = list[str]()
        for line in self.lines:
            parts = parts_of(line)
            if self.hang:
                head = text_of(parts[:-1])
                lines += hanging(painted(parts[:-1], paint), text_of(parts[-1:]), width, self.indent, len(head))
                continue
            shown = (self.wrap and wrapped([text_of(parts)], width, " " * self.indent)) or [text_of(parts)]
            for part in (x for x in parts if not isinstance(x, str)):
                at = next((k for k, x in enumerate(shown) if part[0] in x), None)
                if at is not None:
                    shown[at] = shown[at].replace(part[0], painted([part], paint), 1)
            lines += shown
        return [painted([(line, self.style)], paint) for line in lines] if self.style else lines


@dataclass(frozen=True, slots=True, kw_only=True)
class Checks:
    """Checks, each with what it found."""

    checks: Mapping[str, Check]
    above: bool = False  # whether failed ones stand with the verdict, above


@dataclass(frozen=True, slots=True, kw_only=True)
class Warnings:
    """Warnings; a page has them below its verdict."""

    warnings: Sequence[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fitting:
    """Parts where the terminal is wide enough for all of them, else others; a page has the wide ones."""

    wide: Sequence[Part]
    narrow: Callable[[int], Sequence[Part]]  # for a terminal of so many columns


@dataclass(frozen=True, slots=True, kw_only=True)
class Preformatted:
    """A text whose lines are left as they are."""

    text: str


Part = Table | Lines | Checks | Warnings | Fitting | Preformatted


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """Parts that belong together; an empty line divides sections on a terminal."""

    parts: Sequence[Part] = ()
    title: str = ""  # on a page; a section without title and heading goes on with the one before
    heading: Line = ""  # on a terminal; on a page in the title's place where there is none
    caption: str = ""  # on a page, above and behind the parts
    note: str = ""
    terminal: bool = True  # where it is shown
    page: bool = True
    folded: bool = False  # whether a reader of the page unfolds it
    figure: Callable[[float], Figure] | None = None  # draws it on a page of some width, inches
    signals: Sequence[Strips] = ()  # shown in the figure's place, where scripts run and nothing is printed


@dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """What there is to see of a result."""

    title: str  # what it is, in a few words
    sections: Sequence[Section]
    figure: Callable[[float], Figure]  # all figures on one page of some width, inches
    frame: Callable[[], Frame]
    headline: str = ""  # of the page; default: the title
    subtitle: str = ""
    # of a page: a section each figure, default all in one; and what follows them
    drawings: Callable[[], Sequence[Section]] | None = None
    appendix: Callable[[], Sequence[Section]] = tuple
    provenance: Sequence[tuple[str, str]] = ()
    history: Sequence[str] = ()  # what was done to the record
    numbers: Sequence[tuple[str, str]] = ()  # names and values that short forms show


def terminal(document: Document, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a document for a terminal; colour does not change the layout."""
    return sections_text(document.sections, width=width, paint=paint)


def sections_text(sections: Sequence[Section], *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write sections for a terminal."""
    blocks = []
    for section in sections:
        if section.terminal:
            head = Lines(lines=[section.heading] if section.heading else [], wrap=False)
            lines = [line for part in section.parts for line in part_lines(part, width, paint)]
            blocks.append([*head.written(width, paint), *lines] if lines else [])
    return joined(blocks)


def part_lines(part: Part, width: int, paint: Paint = plain) -> list[str]:
    """Write a part of a section for a terminal."""
    if isinstance(part, Table):
        return part.lines(width, paint) if part.rows else []
    if isinstance(part, Lines):
        return part.written(width, paint)
    if isinstance(part, Checks):
        return check_lines(part.checks, width=width, paint=paint, above=part.above)
    if isinstance(part, Warnings):
        return warning_lines(part.warnings, width=width, paint=paint)
    if isinstance(part, Preformatted):
        return part.text.splitlines()
    lines = [line for x in part.wide for line in part_lines(x, width, plain)]
    parts = part.wide if max(map(len, lines), default=0) <= width else part.narrow(width)
    return [line for x in parts for line in part_lines(x, width, paint)]


def told_sections(document: Document) -> list[Section]:
    """Return the sections of a page that need no figures, each with a title."""
    sections = list[Section]()
    for section in (s for s in document.sections if s.page and (s.parts or s.figure)):
        title = section.title or text_of(parts_of(section.heading))
        if title or not sections:
            sections.append(replace(section, title=title or "Result"))
        else:
            sections[-1] = replace(sections[-1], parts=(*sections[-1].parts, *section.parts))
    return sections


def page_sections(document: Document) -> list[Section]:
    """Return the sections of a page: those of the document, its figures, and what follows them."""
    drawn = [Section(title="Figures", figure=document.figure)] if document.drawings is None else document.drawings()
    return [*told_sections(document), *drawn, *document.appendix()]


def pieces(parts: Sequence[Part]) -> Iterator[tuple[str, Any]]:
    """Yield what a page shows of parts: paragraphs, tables (rows of cells), and lines as they are."""
    for part in parts:
        if isinstance(part, Table) and part.rows:
            yield "table", part.cells(page=True)[0]
        elif isinstance(part, Lines):
            yield from (("paragraph", text) for line in part.lines if (text := text_of(parts_of(line)).strip()))
        elif isinstance(part, Checks) and part.checks:
            rows = [
                (("✓ " if c.passed else "✗ ") + name, (c.detail, "" if c.passed else "bad"))
                for name, c in part.checks.items()
            ]
            yield "table", [("", "finding"), *rows]
        elif isinstance(part, Fitting):
            yield from pieces(part.wide)
        elif isinstance(part, Preformatted):
            yield "lines", part.text


def warnings_of(document: Document) -> list[str]:
    """Return what a page warns of below its verdict."""
    return [x for s in document.sections for part in s.parts if isinstance(part, Warnings) for x in part.warnings]


def plain_parts(parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Return what a page shows of parts in the types of JSON; of a table its rows, the labels first, which columns are
    aligned right, and which one explains the first (None: there is none).
    """
    plain = list[dict[str, Any]]()
    for part in parts:
        if isinstance(part, Fitting):
            plain += plain_parts(part.wide)
        elif isinstance(part, Table) and part.rows:
            rows, right = part.cells(page=True)
            about = [k for c in part.columns if c.about for k, label in enumerate(rows[0]) if label == c.label]
            plain.append({"kind": "table", "content": rows, "right": right, "about": next(iter(about), None)})
        else:
            plain += [{"kind": kind, "content": content} for kind, content in pieces([part])]
    return plain


def ending(result: Any) -> list[Section]:
    """Return what a result ends with: its checks, the warnings that say more than they do, and how long it took."""
    return [
        Section(title="Checks", parts=[Checks(checks=result.checks, above=True)]),
        Section(parts=[Warnings(warnings=other_warnings(result.checks, result.warnings))]),
        timing_section(result.timing_s),
    ]


def timing_section(timing_s: Mapping[str, float], *, wrap: bool = True) -> Section:
    """Say how long each stage took, and all together."""
    parts = ", ".join(f"{name} {seconds:.2g} s" for name, seconds in timing_s.items())
    lines = [f"{parts}; {sum(timing_s.values()):.2g} s in all"] if timing_s else []
    return Section(parts=[Lines(lines=lines, wrap=wrap, style="dim")], page=False)


def numbers_of(rows: Sequence[Any]) -> dict[str, list[object]]:
    """Return the fields that all rows have, by name; those of a field in another behind a dot."""
    flat = [_flat(row if isinstance(row, Mapping) else fields_json(row)) for row in rows]
    return {name: [row.get(name) for row in flat] for name in (flat[0] if flat else ())}


def _flat(row: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for name, x in row.items():
        fields |= _flat(x, f"{before}{name}.") if isinstance(x, Mapping) else {f"{before}{name}": x}
    return fields


def value_columns(rows: Sequence[Any], names: Iterable[str]) -> dict[str, list[object]]:
    """Return value and standard deviation of each name, as rows hold them in `values`."""
    return {
        what: [row.values.get(name, (None, None))[k] for row in rows]
        for name in names
        for k, what in enumerate((name, f"{name} sd"))
    }
