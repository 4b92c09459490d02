"""What every result shows on a terminal: columns, parameters, fits, checks, warnings, times; 80 columns, no colour
needed."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, cast

from ambid.errors import counted
from ambid.estimation.estimate import Check, Delay
from ambid.estimation.result import RecordEntry, Verdict
from ambid.report.numbers import quantity, sized

Style = Literal["good", "doubt", "bad", "dim", "strong"]
Paint = Callable[[str, Style], str]
Cell = str | tuple[str, str]
"""A text; or a text and its style, empty for words among numbers."""
Line = str | Sequence[Cell]
"""A text, or its parts."""

WIDTH = 80


def plain(text: str, style: Style) -> str:
    """Return a text without any colour; the default way of painting."""
    del style
    return text


def joined(blocks: Sequence[Sequence[str]]) -> str:
    """Return blocks of lines with an empty line between them, without a final line feed; empty blocks vanish."""
    return "\n\n".join("\n".join(block) for block in blocks if block)


def wrapped(lines: Sequence[str], width: int, indent: str = "") -> list[str]:
    """Return lines that are no longer than the terminal is wide; what goes on is indented."""
    return [part for line in lines for part in textwrap.wrap(line, width, subsequent_indent=indent)]


def parts_of(line: Line) -> list[Cell]:
    """Return the parts of a line."""
    return [line] if isinstance(line, str) else list(line)


def text_of(parts: Sequence[Cell]) -> str:
    """Return parts of a line without their styles."""
    return "".join(x if isinstance(x, str) else x[0] for x in parts)


def painted(parts: Sequence[Cell], paint: Paint) -> str:
    """Return parts of a line, each in its style."""
    return "".join(x if isinstance(x, str) else paint(x[0], cast("Style", x[1])) if x[1] else x[0] for x in parts)


def columns(rows: Sequence[Sequence[Cell]], *, right: Sequence[int] = (), paint: Paint = plain) -> list[str]:
    """Return rows of cells, all of one length, as lines in columns two spaces apart; `right` are aligned right."""
    widths = [max(len(text_of([cell])) for cell in column) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = []
        for j, (cell, width) in enumerate(zip(row, widths, strict=True)):
            room = " " * (width - len(text_of([cell])))
            cells.append(room + painted([cell], paint) if j in right else painted([cell], paint) + room)
        lines.append("  ".join(cells).rstrip())
    return lines


def title_line(record: RecordEntry, what: str, status: str = "converged") -> Line:
    """State what was made of how long a record, and whether the search converged."""
    about = f": {what}, {counted(record.samples, 'sample')} at {record.rate_hz:g} Hz ({record.seconds:.4g} s)"
    return [(record.name, "strong"), about, *status_words(status)]


def names_words(names: Sequence[str]) -> str:
    """Name one record, or say how many there are."""
    return names[0] if len(names) == 1 else f"{len(names)} records"


SPREAD = "± is one standard deviation; intervals and bands are 95 %"
"""The one convention, which every result states once where it has a ±, and every figure and page."""

WORDS: dict[str, tuple[str, Style]] = {
    "usable": ("usable", "good"),
    "caution": ("use with caution", "doubt"),
    "unusable": ("do not use", "bad"),
}


def verdict_lines(verdict: Verdict, *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Say whether a result may be used, and what stands against it, a reason a paragraph."""
    words, style = WORDS[verdict.word]
    lines = [f"verdict: {paint(words, style)}"]
    for r in verdict.reasons:
        lines += hanging(f"  {paint('✗', 'bad')} {r.check}: ", r.text, width, 4, first=len(r.check) + 6)
    return lines


def status_words(status: str) -> list[Cell]:
    """Name a status other than converged."""
    return [] if status == "converged" else [(f" – {status}", "bad")]


def delay_line(what: str, d: Delay, rate_hz: float) -> str:
    """Say by how much an input is delayed, and how that is known."""
    return f"delay of {what}: {late(d, rate_hz)}, {d.how}"


def late(d: Delay, rate_hz: float) -> str:
    """Write a delay in samples and seconds."""
    total = d.samples + d.fraction
    count = f"{total:.3g}" if d.sd is None else pure(total, d.sd)
    return counted(count, "sample") + (f" ({sized(total / rate_hz, 's')})" if total else "")


def pure(value: float, sd: float) -> str:
    """Write a number without unit ± its standard deviation."""
    return quantity(value, sd, "1").text


def coefficient_text(value: float, sd: float | None) -> str:
    """Write value ± sd, or another spread; in a power of ten where decimals would be too many to read."""
    if sd is None:
        return f"{value:.5g}"
    largest = max(abs(value), sd)
    exponent = math.floor(math.log10(largest)) if largest else 0
    if -4 <= exponent < 7:
        return pure(value, sd)
    scale = 10.0**exponent
    return f"({pure(value / scale, sd / scale)})e{exponent}"


def fraction(x: float | None) -> str:
    """Write a fit, or a dash where there is none."""
    return "–" if x is None else f"{x:.4f}"


def check_lines(
    checks: Mapping[str, Check], *, width: int = WIDTH, paint: Paint = plain, above: bool = False
) -> list[str]:
    """Write checks, one after the other, each with its mark and what it found; `above`: failed ones stand there."""
    wide = max((len(name) for name in checks), default=0)
    lines: list[str] = []
    for name, check in checks.items():
        mark = paint("✓", "good") if check.passed else paint("✗", "bad")
        detail = check.detail if check.passed or not above else "see the verdict"
        lines += hanging(f"{mark} {name.ljust(wide)}  ", detail, width, wide + 4)
    return lines


def hanging(head: str, text: str, width: int, indent: int, first: int | None = None) -> list[str]:
    """Return a text behind a head of `first` columns, colour not counted (default `indent`); it goes on `indent` in."""
    first = indent if first is None else first
    lines = textwrap.wrap(
        "x" * first + text, max(width, indent + 30), subsequent_indent=" " * indent, break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip
    return [head + lines[0][first:], *lines[1:]] if lines else [head]


def warning_lines(warnings: Sequence[str], *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Write warnings, one after the other."""
    return [line for x in warnings for line in hanging(f"{paint('warning:', 'bad')} ", x, width, 9)]


def other_warnings(checks: Mapping[str, Check], warnings: Sequence[str]) -> list[str]:
    """Return the warnings that say more than the detail of a failed check, which stands with the checks."""
    details = {c.detail for c in checks.values()}
    return [warning for warning in warnings if warning not in details]
