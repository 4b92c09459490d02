"""A track as a table for the terminal: parameters at its end with intervals, changes, rejected samples, throughput."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

from ambid.recursive.lines import Event, TrackedValue, TrackHeader, TrackLine, TrackSummary
from ambid.report.numbers import quantity, sized
from ambid.report.text import WIDTH, Paint, columns, plain, warning_lines
from ambid.track.lines_file import NORMAL_95

_MOST = 20  # events that are listed one by one


def track_text(
    header: TrackHeader,
    last: TrackLine,
    summary: TrackSummary,
    *,
    events: Sequence[Event] = (),
    troubles: Sequence[str] = (),
    width: int = WIDTH,
    paint: Paint = plain,
) -> str:
    """Write what a track came to.

    `last`: the last one; `events`: decisions that are told in their order, beside the changes of the summary;
    `troubles`: as `troubles_of` gives them; `width`: columns of the terminal; `paint`: adds colour; the layout does not
    depend on it. Returns without a final line feed.
    """
    told = events or summary.changes
    blocks = [
        [header_line(header, summary, paint)],
        parameter_lines(header, last, width=width, paint=paint),
        extra_lines(header, last),
        state_lines(header, last, troubles, width=width, paint=paint),
        event_lines(told, width=width, paint=paint),
        closing_lines(summary, paint),
        warning_lines(header.warnings, width=width, paint=paint),
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def header_line(header: TrackHeader, summary: TrackSummary, paint: Paint = plain) -> str:
    """Say what was tracked, how, and how far.

    `paint`: adds colour. Returns one line.
    """
    name = str(header.record.get("file") or "record")
    stopped = "" if summary.complete else paint(" – stopped before its end", "bad")
    return (
        f"{paint(name, 'strong')}: model {header.model}, {header.method}, {summary.seconds_of_record:.4g} s"
        f" at {header.rate_hz:g} Hz{stopped}"
    )


def parameter_lines(header: TrackHeader, last: TrackLine, *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Write the table of the parameters at the end of a track.

    `width`: columns of the terminal; where they are too few, the interval is left out; `paint`: adds colour. Returns a
    header and a line for each parameter.
    """
    rows = [("", "value ± sd", "95 % interval", "from start", "verdict")]
    for name, v in last.parameters.items():
        value, interval = value_words(v, header.units.get(name, ""))
        rows.append((name, value, interval, change_words(v, header.start.get(name)), "STALE" if v.stale else "tracked"))
    lines = columns(rows, right=(3,))
    if max(map(len, lines)) > width:
        lines = columns([(r[0], r[1], r[3], r[4]) for r in rows], right=(2,))
    painted = [lines[0]]
    for line, row in zip(lines[1:], rows[1:], strict=True):
        painted.append(line.removesuffix(row[4]) + paint(row[4], "bad" if row[4] == "STALE" else "good"))
    return painted


def value_words(v: TrackedValue, unit: str) -> tuple[str, str]:
    """Write a tracked value and its interval.

    `unit`: SI unit. Returns `value, interval`: ``"4.002 ± 0.016 kg"`` and ``"3.971 … 4.033"``; the interval is empty
    where there is none.
    """
    if not math.isfinite(v.value):
        return "not known", ""
    if not math.isfinite(v.sd):
        return f"{sized(v.value, unit, 5)} ± ?", ""
    ci95 = (v.value - NORMAL_95 * v.sd, v.value + NORMAL_95 * v.sd)
    q = quantity(v.value, v.sd, unit, ci95=ci95)
    return q.text, f"{q.low} … {q.high}" if q.low else ""


def change_words(v: TrackedValue, start: TrackedValue | None) -> str:
    """Say by how much a value has moved since the start.

    Returns such as ``"-15.1 %"``; empty where it cannot be said.
    """
    if start is None or not math.isfinite(v.value) or not math.isfinite(start.value) or start.value == 0:
        return ""
    percent = 100 * (v.value / start.value - 1)
    text = f"{percent:+.0f} %" if abs(percent) >= 1000 else f"{percent:+.2f} %"
    return text.replace("-0.00", "+0.00")


def extra_lines(header: TrackHeader, last: TrackLine) -> list[str]:
    """Write what is tracked beside the parameters."""
    rows = [(name, value_words(v, header.units.get(name, ""))[0]) for name, v in last.extra.items()]
    return columns(rows) if rows else []


def troubles_of(header: TrackHeader, last: TrackLine, open_changes: Sequence[Event]) -> tuple[str, ...]:
    """Say what is wrong at the end of a track: what ``--strict`` ends with code 3 for.

    `open_changes`: changes that were found, and not answered by accepted values. Returns empty where nothing is.
    """
    found = []
    for e in open_changes:
        who = f"of {e.parameter} " if e.parameter else ""
        found.append(f"the change {who}at {e.t:.4g} s was not answered by new values that passed their validation")
    if last.state == "frozen":
        found.append("the record ends without information: parameters are frozen, and older than its end")
    if last.state == "changed" and not open_changes:
        found.append("the record ends while the data contradict the published values")
    if last.error > header.limit:
        found.append(f"the model error is {last.error:.3g} at the end, beyond the limit {header.limit:g}")
    elif math.isnan(last.error):
        found.append("the model error at the end is not known")
    if header.warnings:
        n = _counted(len(header.warnings), "warning")
        found.append(f"the start is to be mistrusted: {n}, see below")
    return tuple(found)


def state_lines(
    header: TrackHeader,
    last: TrackLine,
    troubles: Sequence[str],
    *,
    width: int = WIDTH,
    paint: Paint = plain,
) -> list[str]:
    """Write state and error at the end, and what is wrong there.

    `width`: columns of the terminal; `paint`: adds colour.
    """
    error = "not known" if math.isnan(last.error) else f"{last.error:.3g}"
    lines = [f"state at the end: {last.state}; model error {error}, limit {header.limit:g}"]
    for trouble in troubles:
        first, *more = _wrapped(trouble, width, 2, 2)
        lines += [f"{paint('✗', 'bad')} {first}", *("  " + line for line in more)]
    return lines


def event_lines(events: Sequence[Event], *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Write events, one after the other: when, what, why.

    `width`: columns of the terminal; longer reasons go on under themselves; `paint`: adds colour. Returns at most the
    last twenty, and how many came before.
    """
    shown = events[-_MOST:]
    lines = [f"{len(events) - len(shown)} earlier events are not shown"] if len(shown) < len(events) else []
    for e in shown:
        who = f" {e.parameter}" if e.parameter else ""
        head = f"{e.t:10.3f} s  "
        what = f"{e.kind}{who}: "
        first, *more = _wrapped(e.why, width, len(head) + len(what), len(head))
        bad = e.kind in ("change", "reverted", "refused", "disturbed")
        lines.append(head + paint(what, "bad" if bad else "strong") + first)
        lines += [" " * len(head) + line for line in more]
    return lines


def closing_lines(summary: TrackSummary, paint: Paint = plain) -> list[str]:
    """Write counts, throughput and latency.

    `paint`: adds colour.
    """
    places = summary.counts.get("rejected", 0)
    rejected = _counted(summary.rejected_samples, "sample") + " rejected"
    if places:
        rejected += f" in {_counted(places, 'place')}"
    lines = [f"{_counted(summary.updates, 'update')}, {_counted(len(summary.changes), 'change')}, {rejected}"]
    if summary.counts:
        lines.append(f"events: {', '.join(f'{n} {kind}' for kind, n in summary.counts.items())}")
    speed = speed_words(summary.samples, summary.seconds_of_record, summary.computing_s)
    if speed:
        lines.append(paint(f"{summary.computing_s:.2g} s of computing: {speed}", "dim"))
    latency = summary.latency
    if latency is not None and math.isfinite(latency.median):
        lost = f"; {_counted(latency.overruns, 'block')} LOST" if latency.overruns else ""
        median, p99, largest = (sized(x, "s", 3) for x in (latency.median, latency.p99, latency.largest))
        words = f"latency of a block: median {median}, 99 % {p99}, largest {largest}; {latency.late} late{lost}"
        lines.append(paint(words, "bad" if lost else "dim"))
    return lines


def speed_words(samples: int, seconds_of_record: float, computing_s: float) -> str:
    """Say how fast a record went by.

    Returns such as ``"1.2 million samples/s, 60 times real time"``; empty where it is not known.
    """
    if not (computing_s > 0 and samples > 0):
        return ""
    rate = samples / computing_s
    pace = (
        f"{rate / 1e6:.3g} million" if rate >= 1e6 else f"{rate / 1e3:.3g} thousand" if rate >= 1e3 else f"{rate:.3g}"
    )
    return f"{pace} samples/s, {seconds_of_record / computing_s:.3g} times real time"


def _counted(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _wrapped(text: str, width: int, first: int, rest: int) -> list[str]:
    """Lines of a text whose first line begins `first` columns in and the others `rest`, without those spaces."""
    lines = textwrap.wrap(
        "x" * first + text, max(width, first + 20), subsequent_indent=" " * rest, break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip
    return [lines[0][first:], *(line[rest:] for line in lines[1:])] if lines else [""]
