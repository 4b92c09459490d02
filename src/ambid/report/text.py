"""What every result shows on a terminal: columns, parameters, fits, checks, warnings, times; 80 columns, no colour
needed."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, cast

import numpy as np

from ambid.arrays import Array
from ambid.errors import counted
from ambid.estimation.estimate import Check, Delay, EstimatedParameter, OutputFit
from ambid.estimation.result import Verdict
from ambid.report.numbers import Quantity, quantity, sized

Style = Literal["good", "doubt", "bad", "dim", "strong"]
Paint = Callable[[str, Style], str]

WIDTH = 80
USABLE = Verdict(word="usable", reasons=())


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


def columns(rows: Sequence[Sequence[str]], *, right: Sequence[int] = ()) -> list[str]:
    """Return rows of cells, all of one length, as lines in columns two spaces apart; `right` are aligned right."""
    widths = [max(len(row[j]) for row in rows) for j in range(len(rows[0]))]
    cells = [
        [cell.rjust(w) if j in right else cell.ljust(w) for j, (cell, w) in enumerate(zip(row, widths, strict=True))]
        for row in rows
    ]
    return ["  ".join(row).rstrip() for row in cells]


def title_line(name: object, what: str, samples: int, rate_hz: float, status: str, paint: Paint = plain) -> str:
    """State what was made of how long a record, and whether the search converged."""
    return (
        f"{paint(str(name or 'record'), 'strong')}: {what}, {counted(samples, 'sample')} at {rate_hz:g} Hz "
        f"({samples / rate_hz:.4g} s){status_words(status, paint)}"
    )


def record_line(found: Any, what: str, paint: Paint = plain) -> str:
    """State what was made of the record that a result remembers, and whether the search converged."""
    of = found.record
    return title_line(of.get("file"), what, int(str(of["samples"])), float(str(of["rate_hz"])), found.status, paint)


SPREAD = "± is one standard deviation; intervals and bands are 95 %"
"""The one convention, which every result states once where it has a ±, and every figure and page."""

WORDS: dict[str, tuple[str, Style]] = {
    "usable": ("usable", "good"),
    "caution": ("use with caution", "doubt"),
    "unusable": ("do not use", "bad"),
}


def verdict_lines(found: Verdict, *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Say whether a result may be used, and what stands against it, a reason a paragraph."""
    words, style = WORDS[found.word]
    lines = [f"verdict: {paint(words, style)}"]
    for r in found.reasons:
        lines += hanging(f"  {paint('✗', 'bad')} {r.check}: ", r.text, width, 4, first=len(r.check) + 6)
    return lines


def status_words(status: str, paint: Paint = plain) -> str:
    """Name a status other than converged."""
    return "" if status == "converged" else paint(f" – {status}", "bad")


def parameter_lines(
    parameters: Sequence[EstimatedParameter],
    *,
    width: int = WIDTH,
    paint: Paint = plain,
    found: Verdict = USABLE,
) -> list[str]:
    """Return the table of parameters; where the verdict on all of them is not good, none is called identified.

    Where the terminal is too narrow the column of SI values is left out.
    """
    rows = parameter_rows(parameters, found)
    head = ("", "value ± sd", "95 % interval", "in SI", "verdict")
    return verdict_table(head, rows, right=2, spare=3, width=width, paint=paint)


def parameter_rows(
    parameters: Sequence[EstimatedParameter], found: Verdict = USABLE
) -> list[tuple[str, str, str, str, str, Style]]:
    """Return name, value, interval, value in SI and verdict of each parameter, and how the verdict is painted."""
    rows: list[tuple[str, str, str, str, str, Style]] = []
    for p in parameters:
        q = quantity(p.value, p.sd, p.unit, ci95=p.ci95)
        words = verdict(p, found)
        good = p.identifiable and word_for_all(found) == "usable"
        style: Style = (
            "dim" if p.role == "fixed" else "good" if good else WORDS[found.word][1] if found.reasons else "bad"
        )
        rows.append((p.name, q.text, interval_words(q), q.si, words, style))
    return rows


def interval_words(q: Quantity) -> str:
    """Write the interval of a quantity; empty where it has none."""
    return f"{q.low} … {q.high}" if q.low else ""


def verdict_table(
    head: tuple[str, ...],
    rows: Sequence[tuple[str, ...]],
    *,
    right: int,
    spare: int,
    width: int,
    paint: Paint,
) -> list[str]:
    """Return a table whose rows end with a verdict and its style, the column `right` aligned right.

    The column `spare` is left out where the terminal is too narrow.
    """
    table = [head, *(row[:-1] for row in rows)]
    lines = columns(table, right=(right,))
    if max(map(len, lines)) > width:
        lines = columns([row[:spare] + row[spare + 1 :] for row in table], right=(right - (spare < right),))
    ends = [(row[-2], cast("Style", row[-1])) for row in rows]
    body = zip(lines[1:], ends, strict=True)
    return [lines[0], *(line.removesuffix(x) + paint(x, style) if x else line for line, (x, style) in body)]


def verdict(p: EstimatedParameter, found: Verdict = USABLE) -> str:
    """Say in a word or two where a parameter's value comes from, such as ``"prior, 87 % data"``."""
    if p.role == "fixed":
        return "fixed"
    word = word_for_all(found)
    if word != "usable":
        return WORDS[word][0]
    if p.role == "prior":
        share = "" if p.data_share is None else f", {100 * p.data_share:.0f} % data"
        return f"prior{share}" if p.identifiable else f"prior, not identifiable{share}"
    return "identified" if p.identifiable else "not identifiable"


def word_for_all(found: Verdict) -> str:
    """The verdict on every parameter: what the record does not show concerns some of them alone."""
    alone = all(r.check == "identifiable" for r in found.reasons)
    return "usable" if alone and found.word == "caution" else found.word


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


def pole_table(
    poles: Sequence[tuple[complex, Array | None]],
    dt: float | None = None,
    *,
    times: bool = False,
    paint: Paint = plain,
) -> list[str]:
    """Write poles, each with its covariance or None, with frequency, damping and standard deviation.

    `dt` is the sampling interval in s of discrete ones, `times` adds time constants; of each pair one is given.
    """
    rows = [(f"poles [{'z' if dt else 'rad/s'}]", "frequency", "damping", "")]
    for p, covariance in poles:
        sd = np.zeros(2) if covariance is None else np.sqrt(np.maximum(np.diag(covariance), 0.0))
        text = pure(p.real, float(sd[0])) + (f" ± j({pure(p.imag, float(sd[1]))})" if p.imag else "")
        if p == 0:
            rows.append((text, "", "", "delay" if dt else "integrator"))
            continue
        s = complex(np.log(p) / dt) if dt else p
        unstable = abs(p) > 1 if dt else p.real > 0
        frequency = sized(abs(s) / (2 * np.pi), "Hz") if abs(s) else "0 Hz"
        damping = f"{-s.real / abs(s):.3g}" if abs(s) else ""
        words = "unstable" if unstable else ""
        if times and s.real and not s.imag:
            words += f"{', ' if words else ''}time constant {sized(1 / abs(s.real), 's')}"
        rows.append((text, frequency, damping, paint(words, "bad") if unstable else words))
    return columns(rows) if poles else []


def fit_rows(fits: Mapping[str, OutputFit], units: Mapping[str, str], no_simulation: str) -> list[tuple[str, ...]]:
    """Return a table of the fit of each output; `no_simulation` says why there may be no simulation."""
    rows: list[tuple[str, ...]] = [("fit", "one step", "simulation", "innovations")]
    for output, f in fits.items():
        free = no_simulation if f.simulation is None else fraction(f.simulation)
        rows.append((output, fraction(f.one_step), free, f"{sized(f.innovation_sd, units[output])} rms"))
    return rows


def fraction(x: float | None) -> str:
    """Write a fit, or a dash where there is none."""
    return "–" if x is None else f"{x:.4f}"


def criteria_lines(criteria: Mapping[str, float], n_estimated: int, width: int) -> list[str]:
    """Write the information criteria of a fit."""
    if not criteria:
        return []
    text = ", ".join(f"{name} {value:.6g}" for name, value in criteria.items())
    return textwrap.wrap(f"criteria: {text}; {n_estimated} parameters estimated", width)


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


def checks_of(validation: Mapping[str, Any]) -> dict[str, Check]:
    """Return the checks that a validation holds as JSON."""
    return {
        name: Check(passed=bool(c["passed"]), detail=str(c["detail"]), p=c.get("p"))
        for name, c in validation["checks"].items()
    }


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
    said = {c.detail for c in checks.values()}
    return [warning for warning in warnings if warning not in said]


def ending(found: Any, *, width: int = WIDTH, paint: Paint = plain) -> list[list[str]]:
    """Return what a result ends with: its checks, the warnings that say more than they do, and how long it took."""
    return [
        check_lines(found.checks, width=width, paint=paint, above=True),
        warning_lines(other_warnings(found.checks, found.warnings), width=width, paint=paint),
        timing_lines(found.timing_s, width=width, paint=paint),
    ]


def timing_lines(timing_s: Mapping[str, float], *, width: int = 10 * WIDTH, paint: Paint = plain) -> list[str]:
    """Say how long each stage took, and all together."""
    if not timing_s:
        return []
    parts = ", ".join(f"{name} {seconds:.2g} s" for name, seconds in timing_s.items())
    return [paint(line, "dim") for line in textwrap.wrap(f"{parts}; {sum(timing_s.values()):.2g} s in all", width)]
