"""A track as JSON lines, schema ``ambid.track/1`` (contracts.md), written as the numbers come, counted, and read back.

First the header, then a line per reporting interval, last the summary, each flushed, so that others may follow. Only
the end of a file may be missing, as of a run that was killed; anything else that does not fit is refused on one line.
"""

from __future__ import annotations

import json
import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self, TextIO, TypeVar

from ambid.errors import AmbidError, RecordError
from ambid.estimation.estimate import fields_json, plain_json, read_as
from ambid.estimation.result import NORMAL_95, Verdict
from ambid.record.record import file_bytes
from ambid.recursive.lines import RECENT_S, Event, Track, TrackedValue, TrackHeader, TrackLine, TrackSummary

T = TypeVar("T")
_APART_S = 0.15  # of record, within which what is noticed belongs together

SCHEMA = "ambid.track/1"

_dumps = json.JSONEncoder(ensure_ascii=False, allow_nan=False, check_circular=False).encode


# What a reader has to know first, when several things happened in one reporting interval.
_IMPORTANCE = (
    "change", "reverted", "disturbed", "refused", "accepted", "operator", "rejected", "frozen", "thawed",
)  # fmt: skip


def header_json(header: TrackHeader) -> dict[str, Any]:
    """Return the first line of a track; a number that is not finite is None."""
    start = {name: _value(v) for name, v in header.start.items()}
    return {"schema": SCHEMA, **fields_json(header, without=("start",)), "start": start}


def line_json(line: TrackLine) -> dict[str, Any]:
    """Return the line of one interval: ``event``, the most important of ``events`` or None; ``ci95``, value ± 1.96 sd;
    None for what is not known.
    """
    document: dict[str, Any] = {
        "t": plain_json(line.t),
        "parameters": {name: _value(v) for name, v in line.parameters.items()},
        "error": plain_json(line.error),
        "state": line.state,
        "event": None if not line.events else event_json(most_important(line.events)),
    }
    if line.events:
        document["events"] = [event_json(e) for e in line.events]
    if line.extra:
        document["extra"] = {name: _value(v) for name, v in line.extra.items()}
    return document


def event_json(event: Event) -> dict[str, Any]:
    """Return one event: ``kind``, ``t`` and ``why``; ``parameter``, ``samples`` and ``values`` where there are any."""
    entries = fields_json(event).items()
    return {name: x for name, x in entries if name in ("kind", "t", "why") or x not in (None, {})}


def summary_json(summary: TrackSummary, verdict: Verdict) -> dict[str, Any]:
    """Return the last line of a track, with the keys ``verdict`` and ``summary``."""
    more = {
        "changes": [event_json(e) for e in summary.changes],
        "unanswered": [event_json(e) for e in summary.unanswered],
        "latency_s": None if summary.latency is None else fields_json(summary.latency),
    }
    document = {**fields_json(summary, without=("changes", "unanswered", "latency")), **more}
    return {"verdict": plain_json(verdict), "summary": document}


def track_document(track: Track) -> str:
    """Return the whole text of a track."""
    end = summary_json(track.totals, track.verdict)
    return "".join(f"{_dumps(x)}\n" for x in (header_json(track.header), *map(line_json, track.lines), end))


def _value(v: TrackedValue) -> dict[str, Any]:
    value, sd = float(v.value), float(v.sd)
    low, high = value - NORMAL_95 * sd, value + NORMAL_95 * sd
    finite = math.isfinite(low) and math.isfinite(high)
    return {
        "value": value if math.isfinite(value) else None,
        "sd": sd if math.isfinite(sd) else None,
        "ci95": [low, high] if finite else None,
        "stale": bool(v.stale),
    }


class TrackWriter:
    """A file, or a stream (not closed), to which a track is written line by line, each flushed; opened with the header,
    not before: a run that is refused leaves an older file as it was.
    """

    def __init__(self, target: str | Path | TextIO) -> None:
        """Take note of the `target`."""
        self._path = Path(target) if isinstance(target, (str, Path)) else None
        self._stream: TextIO | None = None if isinstance(target, (str, Path)) else target
        self._begun = False
        self._header: TrackHeader | None = None
        self._last: tuple[TrackLine, ...] = ()

    @property
    def begun(self) -> bool:
        """Whether the header has been written."""
        return self._begun

    def header(self, header: TrackHeader) -> None:
        """Open the file and write the first line."""
        if self._stream is None and self._path is not None:
            try:
                self._stream = self._path.open("w", encoding="utf-8", newline="\n")
            except OSError as failure:
                raise _unwritable(self._path, failure) from None
        self._begun, self._header = True, header
        self._put(header_json(header))

    def line(self, line: TrackLine) -> None:
        """Write the line of one reporting interval."""
        self._last = (line,)
        self._put(line_json(line))

    def summary(self, summary: TrackSummary) -> None:
        """Write the last line, with the verdict."""
        if self._header is not None:
            track = Track(header=self._header, lines=self._last, totals=summary)
            self._put(summary_json(summary, track.verdict))

    def close(self) -> None:
        """Close the file; a stream that was handed in stays open."""
        if self._path is not None and self._stream is not None:
            self._stream.close()
            self._stream = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _put(self, document: Mapping[str, Any]) -> None:
        text = _dumps(document) + "\n"
        if self._stream is None:
            raise RecordError("a line of a track came before its header. Write the header first")
        try:
            self._stream.write(text)
            self._stream.flush()
        except BrokenPipeError:
            raise
        except OSError as failure:
            raise _unwritable(self._path, failure) from None


def _unwritable(path: Path | None, failure: OSError) -> AmbidError:
    where = "the track" if path is None else f"the track {path}"
    return AmbidError(f"{where} cannot be written: {failure.strerror or failure}. Check folder and disk")


def most_important(events: Sequence[Event]) -> Event:
    """Return the event that a reader has to know first; of the same kind the first. `events`: at least one."""
    return min(events, key=lambda e: _IMPORTANCE.index(e.kind))


class Tally:
    """Counts of a track: `updates`, lines whose published values differ from those before; `counts`, events of each
    kind.
    """

    def __init__(self, header: TrackHeader) -> None:
        self._header = header
        self._begin_s: float | None = None
        self._end_s = 0.0
        self._values = tuple(v.value for v in header.start.values()) or None
        self._changes: list[Event] = []
        self._open: dict[str | None, Event] = {}
        self._alarms: deque[float] = deque()
        self.updates = self.rejected_samples = 0
        self.counts: Counter[str] = Counter()

    @property
    def open_changes(self) -> tuple[Event, ...]:
        """Changes after which no new value of that parameter was accepted."""
        return tuple(self._open.values())

    @property
    def recurring(self) -> int:
        """Times that something was noticed in the last `RECENT_S`, as far as they lie apart."""
        return sum(t > self._end_s - RECENT_S for t in self._alarms)

    def add(self, line: TrackLine) -> None:
        """Count one line."""
        if self._begin_s is None:
            self._begin_s = line.t - self._header.every_s
        self._end_s = line.t
        values = tuple([v.value for v in line.parameters.values()])
        if values != self._values:
            self.updates += self._values is not None
            self._values = values
        for event in line.events:
            self.counts[event.kind] += 1
            noticed = event.values.get("detected") if event.kind in ("change", "disturbed") else None
            if noticed is not None and (not self._alarms or noticed > self._alarms[-1] + _APART_S):
                self._alarms.append(noticed)
                while self._alarms[0] <= noticed - RECENT_S:
                    self._alarms.popleft()
            if "named" in event.values:  # what looked like another change, or like one, was none
                self._changes = [e for e in self._changes if e.t != event.t]
                self._open = {name: e for name, e in self._open.items() if e.t != event.t}
            if event.kind == "rejected":
                self.rejected_samples += event.samples or 0
            elif event.kind == "change":
                self._changes.append(event)
                self._open[event.parameter] = event
            elif event.kind == "accepted" and event.parameter is None:  # all of them together
                self._open.clear()
            elif event.kind == "accepted":
                self._open.pop(event.parameter, None)

    def summary(self, *, computing_s: float = float("nan"), complete: bool = True) -> TrackSummary:
        """Return what was counted, without latency; `samples` from time and rate, `updates` in lines. `computing_s`:
        time spent, s; `complete`: whether the run came to the end of its record.
        """
        seconds = 0.0 if self._begin_s is None else self._end_s - self._begin_s
        return TrackSummary(
            samples=round(seconds * self._header.rate_hz),
            seconds_of_record=seconds,
            computing_s=computing_s,
            updates=self.updates,
            rejected_samples=self.rejected_samples,
            changes=tuple(self._changes),
            counts=dict(self.counts),
            complete=complete,
            unanswered=self.open_changes,
            recurring=self.recurring,
        )


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
            raise RecordError(f"track {path}, line {k}: it follows the summary, which must be last. Remove it")
        line = _parsed(path, k, row, _line_or_summary)
        if isinstance(line, TrackSummary):
            summary = line
            continue
        others = line.parameters.keys() ^ (lines[0].parameters if lines else header.start or line.parameters).keys()
        if others:
            raise RecordError(
                f"track {path}, line {k}: parameter {min(others)!r} is either here or in the lines before, not in "
                "both. Restore the file"
            )
        if lines and not line.t > lines[-1].t:
            raise RecordError(
                f"track {path}, line {k}: time {line.t:g} s does not come after {lines[-1].t:g} s. Restore the file"
            )
        lines.append(line)
        tally.add(line)
    return Track(header=header, lines=tuple(lines), totals=summary or tally.summary(complete=False))


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
    raise ValueError(f"{word} is not a JSON number")


def _parsed(path: Path, number: int, row: bytes, read: Callable[[Mapping[str, Any]], T]) -> T:
    try:
        document = _loaded(row)
    except ValueError:
        raise RecordError(f"track {path}, line {number}: it is not JSON. Restore the file") from None
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
    return read_as(TrackHeader, {"model": "", "start": {}, **document})


def _line_or_summary(document: Mapping[str, Any]) -> TrackLine | TrackSummary:
    if "summary" in document:
        s = document["summary"]
        fields = {"counts": {}, "unanswered": [], **s, "latency": s.get("latency_s")}
        fields |= {k: [{"kind": "change", **_event(e)} for e in fields[k]] for k in ("changes", "unanswered")}
        return read_as(TrackSummary, fields)
    one = document.get("event")
    events = document.get("events", [] if one is None else [one])
    return read_as(TrackLine, {**document, "events": [_event(e) for e in events]})


def _event(e: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of an event; those of release 1.0 on sensors out of use are read as disturbances."""
    former = {"kind": "disturbed"} if e.get("kind") in ("excluded", "restored") else {}
    return {"t": None, "why": "", **e, **former}


_TOLD = 200  # events that are kept
_NOTABLE = ("change", "disturbed", "reverted", "operator")  # told one by one; of the others the last of its kind


class LiveState:
    """State of a run, to be told; one thread adds, another may read: `header`; the last `line`, None before the first;
    `tally`; `lag_s`: from a block's last sample to the end of its work, s, None if not measured; `begin_s`: begin of
    the first reporting interval, s of record.
    """

    def __init__(self, header: TrackHeader) -> None:
        self.header, self.tally = header, Tally(header)
        self.line: TrackLine | None = None
        self.lag_s: float | None = None
        self.begin_s = 0.0
        self._notable: deque[Event] = deque(maxlen=_TOLD)
        self._latest: dict[str, Event] = {}
        self._unanswered = False

    def add(self, line: TrackLine) -> None:
        """Take a line."""
        if self.line is None:
            self.begin_s = line.t - self.header.every_s
        self.tally.add(line)
        for event in line.events:
            if event.kind in _NOTABLE:
                self._unanswered = self._unanswered or event.kind == "change"
                self._notable.append(event)
            elif self._unanswered and event.kind in ("accepted", "refused"):
                self._unanswered = event.kind == "refused"
                self._notable.append(event)
            else:
                self._latest[event.kind] = event
        self.line = line

    @property
    def events(self) -> tuple[Event, ...]:
        """Events in their order: changes with what was decided on each, and of routine decisions the last."""
        notable = _copy_of(self._notable)
        routine = [e for e in self._latest.copy().values() if e not in notable]
        return tuple(sorted([*notable, *routine], key=lambda e: e.t))

    @property
    def length_s(self) -> float | None:
        """Length of the record, s; None where it is not known."""
        samples = self.header.record.get("samples")
        return samples / self.header.rate_hz if isinstance(samples, (int, float)) else None


def _copy_of(things: deque[T]) -> tuple[T, ...]:
    """Copy what the other thread adds to meanwhile."""
    while True:
        with suppress(RuntimeError):
            return tuple(things)
