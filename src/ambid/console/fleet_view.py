"""What the page of a fleet shows: how every bearing of a ledger stands."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ambid.console.feed import FeedWriter
from ambid.estimation.progress import Tick
from ambid.ledger import open_ledger
from ambid.ledger.alarm import Alarm
from ambid.ledger.silences import silences
from ambid.ledger.standing import Standing, standing_of
from ambid.ledger.store import Failure
from ambid.report.history import noted_text

_TOGETHER = 50  # bearings that are told at once


def tell_fleet(path: Path, feed: FeedWriter, tick: Tick) -> None:
    """Tell how every bearing of a ledger stands, some at a time."""
    now, rows = time.time(), list[Mapping[str, Any]]()
    with open_ledger(path, write=False) as ledger:
        failed: dict[str, list[Failure]] = {}
        for f in ledger.failures().values():
            failed.setdefault(f.bearing, []).append(f)
        names, said = [b.name for b in ledger.bearings()], silences(ledger)
        for k, name in enumerate(names, 1):
            tick("bearings", k / len(names))
            own = failed.get(name, ())
            found = standing_of(ledger.history(name), failures=own, silences=said, now=now)
            rows.append({**_row(found, now), "without": len(own)})
            if len(rows) == _TOGETHER or k == len(names):
                feed.tell("bearings", {"rows": rows})
                rows = []


def _row(found: Standing, now: float) -> Mapping[str, Any]:
    last, usable = found.last, found.usable
    return {
        "bearing": found.bearing, "rig": found.plant, "estimates": found.estimates, "state": found.state(now),
        "verdict": last.verdict, "failed": last.failed, "last": last.taken_at, "age_s": found.age_s(now),
        "usable": None if usable is None else usable.taken_at, "stale_after_s": found.stale_after_s,
        "alarms": [_line(a) for a in found.alarms],
    }  # fmt: skip


def _line(a: Alarm) -> str:
    change = f"{a.parameter} {'' if a.change is None else f'{100 * a.change:+.1f} %, '}".lstrip()
    return f"{change}rule {a.rule}{noted_text(a)}. {a.cause}"
