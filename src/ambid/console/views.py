"""What the page is shown of a record, a result or a ledger of its folder, in the types of JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.console.envelope import rounded
from ambid.errors import AmbidError
from ambid.estimation.result import NORMAL_95

if TYPE_CHECKING:
    from ambid.ledger import History, Series

_MOST_ESTIMATES = 2000  # of a history, the latest, that are drawn


def preview(
    path: Path, reading: Mapping[str, Any], *, tick: Callable[[str], object], note: Callable[[str], object]
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the plots of a record, read with ``rate_hz`` or ``gaps``; then what it holds, and the draft of its rig,
    empty where there can be none.
    """
    from ambid.console.look import look
    from ambid.job.drafting import draft, guess
    from ambid.job.presentation import content
    from ambid.record import read_record
    from ambid.validation.inspection import inspect

    record = read_record(path, **reading)
    tick("channels")
    yield "look", {**look(record), "limits": {}}
    tick("diagnostics")
    try:
        drafted = draft(record, first=True, **reading).text
    except AmbidError as refusal:
        drafted = ""
        note(str(refusal))
    yield "preview", {
        "channels": [{"name": c.name, "unit": c.unit} for c in record.channels],
        "rate_hz": record.rate_hz, "samples": record.n_samples, "draft": drafted,
        "content": content(inspect(record, guess=guess(record))),
    }  # fmt: skip


def bearings(path: Path, bearing: str | None, tick: Callable[[str], object]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield which bearings a ledger has, and one of them over time: that which is asked for, else the first."""
    from ambid.ledger import open_ledger

    with open_ledger(path, write=False) as ledger:
        names = [b.name for b in ledger.bearings()]
        failed = [{"bearing": f.bearing, "record": f.record, "reason": f.reason} for f in ledger.failures().values()]
        yield "bearings", {"names": names, "failed": failed[-50:], "failures": len(failed)}
        tick("history")
        if names:
            yield "history", drawn(ledger.history(bearing or names[0]))


def drawn(found: History) -> Mapping[str, Any]:
    """Return verdict, series, estimates and events of a history; of a long one the latest."""
    from ambid.job.presentation import content

    first = max(0, len(found.estimates) - _MOST_ESTIMATES)
    asked = ("taken_at", "record", "job", "status", "verdict", "failed", "version")
    return {
        "bearing": found.bearing, "plant": found.plant, "content": content(found), "left_out": first,
        "estimates": [{k: getattr(e, k) for k in asked} for e in found.estimates[first:]],
        "series": {name: _series(found, name, s, first) for name, s in found.measured.items()},
        "events": [{k: getattr(e, k) for k in ("at", "kind", "text", "parameter")} for e in found.events],
    }  # fmt: skip


def _series(found: History, name: str, s: Series, first: int) -> Mapping[str, Any]:
    """Return one series; `verdict`: of each estimate, or that its record did not show this number."""
    from ambid.console.look import meanings

    of = s.estimate >= first
    said = zip(s.estimate[of], s.identifiable[of], strict=True)
    return {
        "unit": s.unit, "meaning": meanings(found.plant).get(name, ""),
        "t": s.taken_at[of].tolist(), "value": rounded(s.value[of], 9),
        "sd": rounded(s.sd[of]), "half": rounded(NORMAL_95 * s.sd[of]),
        "verdict": [found.estimates[k].verdict if seen else "hidden" for k, seen in said],
        "known": int(np.count_nonzero(np.isfinite(s.value))),
    }  # fmt: skip
