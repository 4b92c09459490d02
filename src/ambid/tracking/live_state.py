"""What is known of a run of the tracker while it goes on, apart from its drawing: terminal and browser share it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from typing import TypeVar

from ambid.recursive.lines import Event, TrackHeader, TrackLine
from ambid.tracking.lines_file import Tally

T = TypeVar("T")

_RECENT = 600  # lines whose error is shown
_TOLD = 200  # events that are kept
_NOTABLE = ("change", "disturbed", "reverted", "operator")  # told one by one; of the others the last of its kind


class LiveState:
    """State of a run, to be drawn. One thread adds to it, another may read it meanwhile.

    `header`: of the track; `line`: the last one, None before the first; `tally`: what was counted; `lag_s`: time from
    the last sample of a block to the end of its work, s, None where it is not measured; `begin_s`: begin of the first
    reporting interval, s of record.
    """

    def __init__(self, header: TrackHeader) -> None:
        self.header, self.tally = header, Tally(header)
        self.line: TrackLine | None = None
        self.lag_s: float | None = None
        self.begin_s = 0.0
        self._notable: deque[Event] = deque(maxlen=_TOLD)
        self._latest: dict[str, Event] = {}
        self._unanswered = False
        self._errors: deque[float] = deque(maxlen=_RECENT)
        self._ranges: dict[str, tuple[float, float]] = {}

    def add(self, line: TrackLine) -> None:
        """Take a line."""
        if self.line is None:
            self.begin_s = line.t - self.header.every_s
        self.tally.add(line)
        self._errors.append(line.error)
        for event in line.events:
            self._tell(event)
        self.line = line

    def _tell(self, event: Event) -> None:
        if event.kind in _NOTABLE:
            self._unanswered = self._unanswered or event.kind == "change"
            self._notable.append(event)
        elif self._unanswered and event.kind in ("accepted", "refused"):
            self._unanswered = event.kind == "refused"
            self._notable.append(event)
        else:
            self._latest[event.kind] = event

    @property
    def events(self) -> tuple[Event, ...]:
        """Events in their order: changes with what was decided on each, and of routine decisions the last."""
        notable = _copy_of(self._notable)
        routine = [e for e in self._latest.copy().values() if e not in notable]
        return tuple(sorted([*notable, *routine], key=lambda e: e.t))

    @property
    def errors(self) -> tuple[float, ...]:
        """Model errors of recent lines, oldest first."""
        return _copy_of(self._errors)

    @property
    def length_s(self) -> float | None:
        """Length of the record, s; None where it is not known."""
        samples = self.header.record.get("samples")
        return samples / self.header.rate_hz if isinstance(samples, (int, float)) else None

    def widened(self) -> Mapping[str, tuple[float, float]]:
        """Return between which ends each number is shown, SI: they stay until an interval passes them."""
        numbers = {} if self.line is None else {**self.line.parameters, **self.line.extra}
        for name, v in numbers.items():
            reach = max(2.5 * v.sd, 0.02 * abs(v.value))
            low, high = v.value - reach, v.value + reach
            if low < high < math.inf:
                before = self._ranges.get(name, (low - reach, high + reach))
                self._ranges[name] = (min(before[0], low), max(before[1], high))
        return dict(self._ranges)


def _copy_of(things: deque[T]) -> tuple[T, ...]:
    """Copy what the other thread adds to meanwhile."""
    while True:
        with suppress(RuntimeError):
            return tuple(things)
