"""A bearing over time, and what a ledger holds, as tables for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime

import numpy as np

from ambid.errors import counted
from ambid.ledger.history import History, Series
from ambid.ledger.store import Failure, KnownBearing
from ambid.report.numbers import quantity
from ambid.report.text import WIDTH, Paint, columns, hanging, joined, plain
from ambid.settings.caller import setting

_SHOWN = 12  # events, and failures


def day(at: float) -> str:
    """Write a time, s since 1970, as a date and time of UTC, to the minute."""
    return datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%d %H:%M")


def percent(value: float, sd: float) -> str:
    """Write a relative change."""
    return f"{quantity(100 * value, 100 * sd, '1').text} %"


def history_text(found: History, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a history, below its verdict: the latest number of each parameter, and what happened."""
    first, last = found.estimates[0], found.estimates[-1]
    n = len(found.estimates)
    words = {w: sum(e.verdict == w for e in found.estimates) for w in ("usable", "caution", "unusable")}
    span = f"{day(first.taken_at)} to {day(last.taken_at)} UTC"
    head = [
        f"{paint(found.bearing, 'strong')}: {counted(n, 'estimate')}, {span}",
        f"verdicts: {words['usable']} usable, {words['caution']} with caution, {words['unusable']} not to be used",
    ]
    rows: list[tuple[str, ...]] = [("", "latest value ± sd", "taken", "since the first", "known")]
    rows += [_row(s, n) for s in found.measured.values()]
    events: list[str] = []
    for e in found.events[-_SHOWN:]:
        who = f"{e.parameter}: " if e.parameter else ""
        events += hanging(f"{day(e.at)}  {e.kind}  ", who + e.text, width, 4, first=len(e.kind) + 20)
    rest = len(found.events) - _SHOWN
    more = [f"{counted(rest, 'earlier event')} in {setting('json')}"] if rest > 0 else []
    return joined([head, columns(rows), [*([paint("events", "strong")] if events else []), *more, *events]])


def _row(s: Series, n: int) -> tuple[str, ...]:
    known = np.flatnonzero(np.isfinite(s.value))
    seen = f"{known.size} of {n}"
    if not known.size:
        return s.name, "never identifiable", "", "", seen
    a, z = int(known[0]), int(known[-1])
    said = quantity(float(s.value[z]), float(s.sd[z]), s.unit).text
    change = ""
    if a != z and s.value[a]:
        change = percent(float(s.value[z] / s.value[a] - 1), math.hypot(s.sd[a], s.sd[z]) / abs(float(s.value[a])))
    return s.name, said, day(float(s.taken_at[z])), change, seen


def bearings_text(found: Sequence[KnownBearing], failures: Iterable[Failure], *, paint: Paint = plain) -> str:
    """Write what a ledger holds: its bearings, and the records that gave no estimate."""
    rows = [("bearing", "rig", "estimates", "first", "last")]
    rows += [(b.name, b.plant, str(b.estimates), day(b.first), day(b.last)) for b in found]
    failed = list(failures)
    lines = [f"{f.record or f.sha[:12]} ({f.bearing}): {f.reason}" for f in failed[:_SHOWN]]
    rest = len(failed) - _SHOWN
    title = paint(f"{counted(len(failed), 'record')} without an estimate", "strong")
    return joined(
        [
            columns(rows, right=(2,)) if found else ["no estimates yet"],
            [title, *lines, *([f"… and {rest} more"] if rest > 0 else [])] if failed else [],
        ]
    )
