"""A track as JSON lines, schema ``ambid.track/1`` (contracts.md), written as the numbers come.

First the header, then one line per reporting interval, last the summary. A track is a stream that other programs may
follow, so it is written in place, each line flushed; a run that was killed leaves a file that can still be read
(`ambid.track.lines_read`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

from ambid.errors import AmbidError, RecordError
from ambid.recursive.lines import Event, TrackedValue, TrackHeader, TrackLine, TrackSummary
from ambid.track.tally import most_important

SCHEMA = "ambid.track/1"
NORMAL_95 = 1.959963984540054  # sd on either side of the mean that hold 95 % of a normal distribution

_dumps = json.JSONEncoder(ensure_ascii=False, allow_nan=False, check_circular=False).encode


def header_json(header: TrackHeader) -> dict[str, Any]:
    """Return the first line of a track.

    Returns with ``schema``; a number that is not finite is None.
    """
    return {
        "schema": SCHEMA,
        "rate_hz": _number(header.rate_hz),
        "limit": _number(header.limit),
        "method": header.method,
        "model": header.model,
        "every_s": _number(header.every_s),
        "units": dict(header.units),
        "start": {name: _value(v) for name, v in header.start.items()},
        "record": dict(header.record),
        "warnings": list(header.warnings),
    }


def line_json(line: TrackLine) -> dict[str, Any]:
    """Return the line of one reporting interval.

    Returns ``event`` is the most important of ``events``, None without any; ``ci95`` is value ± 1.96 sd; a number that
    is not known is None.
    """
    found: dict[str, Any] = {
        "t": _number(line.t),
        "parameters": {name: _value(v) for name, v in line.parameters.items()},
        "error": _number(line.error),
        "state": line.state,
        "event": None if not line.events else event_json(most_important(line.events)),
    }
    if line.events:
        found["events"] = [event_json(e) for e in line.events]
    if line.extra:
        found["extra"] = {name: _value(v) for name, v in line.extra.items()}
    return found


def event_json(event: Event) -> dict[str, Any]:
    """Return one event.

    Returns ``kind``, ``t`` and ``why``; ``parameter``, ``samples`` and ``values`` where there are any.
    """
    found: dict[str, Any] = {"kind": event.kind, "t": _number(event.t), "why": event.why}
    if event.parameter is not None:
        found["parameter"] = event.parameter
    if event.samples is not None:
        found["samples"] = int(event.samples)
    if event.values:
        found["values"] = {name: _number(v) for name, v in event.values.items()}
    return found


def summary_json(summary: TrackSummary) -> dict[str, Any]:
    """Return the last line of a track.

    Returns one key, ``summary``.
    """
    latency = summary.latency
    waits = ("median", "p99", "largest")
    return {
        "summary": {
            "samples": int(summary.samples),
            "seconds_of_record": _number(summary.seconds_of_record),
            "computing_s": _number(summary.computing_s),
            "updates": int(summary.updates),
            "rejected_samples": int(summary.rejected_samples),
            "changes": [event_json(e) for e in summary.changes],
            "counts": {kind: int(n) for kind, n in summary.counts.items()},
            "latency_s": None
            if latency is None
            else {name: _number(getattr(latency, name)) for name in waits}
            | {"overruns": int(latency.overruns), "late": int(latency.late)},
            "update_s": _number(summary.update_s),
            "complete": summary.complete,
        }
    }


def _number(x: float | None) -> float | None:
    if x is None:
        return None
    number = float(x)
    return number if math.isfinite(number) else None


def _value(v: TrackedValue) -> dict[str, Any]:
    value, sd = float(v.value), float(v.sd)
    low, high = value - NORMAL_95 * sd, value + NORMAL_95 * sd
    known = math.isfinite(low) and math.isfinite(high)
    return {
        "value": value if math.isfinite(value) else None,
        "sd": sd if math.isfinite(sd) else None,
        "ci95": [low, high] if known else None,
        "stale": bool(v.stale),
    }


class TrackWriter:
    """A file or stream to which a track is written line by line, each flushed, so that it can be followed.

    The file is opened with the header, not before: a run that is refused leaves an older file as it was.

    `target`: a stream is not closed.
    """

    def __init__(self, target: str | Path | TextIO) -> None:
        """Take note of the `target`."""
        self._path = Path(target) if isinstance(target, (str, Path)) else None
        self._stream: TextIO | None = None if isinstance(target, (str, Path)) else target
        self._begun = False

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
        self._begun = True
        self._put(header_json(header))

    def line(self, line: TrackLine) -> None:
        """Write the line of one reporting interval."""
        self._put(line_json(line))

    def summary(self, summary: TrackSummary) -> None:
        """Write the last line."""
        self._put(summary_json(summary))

    def close(self) -> None:
        """Close the file; a stream that was handed in stays open."""
        if self._path is not None and self._stream is not None:
            self._stream.close()
            self._stream = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
