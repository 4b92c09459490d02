"""Tracks read back from JSON lines, schema ``ambid.track/1``, whole or cut off where the run was killed.

Only the end of a file may be missing; anything else that does not fit is refused on one line.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

from ambid.errors import RecordError
from ambid.record.files import file_bytes
from ambid.recursive.lines import (
    Event,
    EventKind,
    Latency,
    State,
    Track,
    TrackedValue,
    TrackHeader,
    TrackLine,
    TrackSummary,
)
from ambid.track.lines_json import SCHEMA
from ambid.track.tally import Tally

T = TypeVar("T")

_STATES, _KINDS = get_args(State), get_args(EventKind)


def read_track(path: str | Path) -> Track:
    """Read a track back.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Track
        Of a file that ends before its summary (the run was killed, or still goes on) all whole lines, and a summary
        made from them whose `complete` is False. None in the file is NaN here.

    Raises
    ------
    RecordError
        If the file cannot be read, is no track, or is damaged elsewhere than at its end.
    """
    path = Path(path)
    data = file_bytes(path, what="track")
    rows = data.split(b"\n")
    if rows[-1] and not _whole(rows[-1]):  # cut off in the middle of a line
        del rows[-1]
    numbered = [(k, row) for k, row in enumerate(rows, start=1) if row.strip()]
    if not numbered:
        raise RecordError(f"track {path} ends within its first line; nothing can be read from it. Run it again")
    header = _parsed(path, *numbered[0], _header)
    tally, lines, summary = Tally(header), list[TrackLine](), None
    for k, row in numbered[1:]:
        if summary is not None:
            raise RecordError(f"track {path}, line {k}: it stands behind the summary, which is the last. Remove it")
        line = _parsed(path, k, row, _line_or_summary)
        if isinstance(line, TrackSummary):
            summary = line
            continue
        others = line.parameters.keys() ^ (lines[0].parameters if lines else header.start or line.parameters).keys()
        if others:
            raise RecordError(
                f"track {path}, line {k}: parameter {min(others)!r} stands here or in the lines before, not in both."
                " Restore the file"
            )
        if lines and not line.t > lines[-1].t:
            raise RecordError(
                f"track {path}, line {k}: time {line.t:g} s does not come after {lines[-1].t:g} s. Restore the file"
            )
        lines.append(line)
        tally.add(line)
    return Track(header=header, lines=tuple(lines), summary=summary or tally.summary(complete=False))


def _whole(row: bytes) -> bool:
    try:
        return isinstance(_loaded(row), dict)
    except ValueError:
        return False


def _loaded(row: bytes) -> Any:
    """Read JSON in the strict sense: without NaN and Infinity, and not nested without end."""
    try:
        return json.loads(row, parse_constant=_no_number)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")


def _parsed(path: Path, number: int, row: bytes, read: Callable[[Mapping[str, Any]], T]) -> T:
    try:
        document = _loaded(row)
    except ValueError:
        raise RecordError(f"track {path}, line {number}: it is no JSON. Restore the file") from None
    try:
        return read(document)
    except KeyError as missing:
        raise RecordError(f"track {path}, line {number}: {missing} is missing. Restore the file") from None
    except (TypeError, ValueError, AttributeError, IndexError) as wrong:
        raise RecordError(f"track {path}, line {number}: {wrong}. Restore the file") from None


def _header(document: Mapping[str, Any]) -> TrackHeader:
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema != SCHEMA:
        raise ValueError(f"the schema is {schema!r}; a track begins with {SCHEMA!r}")
    start = {name: _tracked(v) for name, v in document.get("start", {}).items()}
    return TrackHeader(
        rate_hz=_float(document["rate_hz"]),
        limit=_float(document["limit"]),
        method=str(document["method"]),
        model=str(document.get("model", "")),
        units={str(k): str(u) for k, u in document["units"].items()},
        every_s=_float(document["every_s"]),
        start=start,
        record=dict(document.get("record", {})),
        warnings=tuple(str(w) for w in document.get("warnings", ())),
    )


def _line_or_summary(document: Mapping[str, Any]) -> TrackLine | TrackSummary:
    if "summary" in document:
        return _summary(document["summary"])
    state = document["state"]
    if state not in _STATES:
        raise ValueError(f"state {state!r} is unknown; known: {', '.join(_STATES)}")
    events = document.get("events")
    if events is None:
        events = [] if document.get("event") is None else [document["event"]]
    return TrackLine(
        t=_float(document["t"]),
        parameters={name: _tracked(v) for name, v in document["parameters"].items()},
        error=_float(document["error"]),
        state=state,
        events=tuple(_event(e) for e in events),
        extra={name: _tracked(v) for name, v in document.get("extra", {}).items()},
    )


def _summary(s: Mapping[str, Any]) -> TrackSummary:
    waits = s.get("latency_s")
    return TrackSummary(
        samples=int(s["samples"]),
        seconds_of_record=_float(s["seconds_of_record"]),
        computing_s=_float(s["computing_s"]),
        update_s=_float(s.get("update_s", 0.0)),
        updates=int(s["updates"]),
        rejected_samples=int(s["rejected_samples"]),
        changes=tuple(_event({"kind": "change", "why": "", **e}) for e in s["changes"]),
        counts={str(k): int(n) for k, n in s.get("counts", {}).items()},
        latency=None
        if waits is None
        else Latency(
            median=_float(waits["median"]),
            p99=_float(waits["p99"]),
            largest=_float(waits["largest"]),
            overruns=int(waits["overruns"]),
            late=int(waits["late"]),
        ),
        complete=bool(s.get("complete", True)),
    )


def _event(e: Mapping[str, Any]) -> Event:
    if e["kind"] not in _KINDS:
        raise ValueError(f"event {e['kind']!r} is unknown; known: {', '.join(_KINDS)}")
    return Event(
        kind=e["kind"],
        t=_float(e.get("t")),
        why=str(e.get("why", "")),
        parameter=e.get("parameter"),
        samples=_count(e.get("samples")),
        values={name: _float(v) for name, v in e.get("values", {}).items()},
    )


def _count(x: Any) -> int | None:
    if x is not None and (isinstance(x, bool) or not isinstance(x, int)):
        raise TypeError(f"{x!r} stands where a count belongs")
    return x


def _tracked(v: Mapping[str, Any]) -> TrackedValue:
    return TrackedValue(value=_float(v["value"]), sd=_float(v["sd"]), stale=bool(v.get("stale", False)))


def _float(x: Any) -> float:
    if x is None:
        return math.nan
    if isinstance(x, bool) or not isinstance(x, (int, float)):
        raise TypeError(f"{x!r} stands where a number belongs")
    return float(x)
