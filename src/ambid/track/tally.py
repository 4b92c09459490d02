"""What a track amounts to so far, counted line by line in constant memory: its summary when a run is stopped.

It also knows which changes are still open: found, and not answered by new values that passed their validation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from ambid.recursive.lines import Event, TrackHeader, TrackLine, TrackSummary

# What a reader has to know first, when several things happened in one reporting interval.
_IMPORTANCE = (
    "change", "reverted", "excluded", "disturbed", "refused", "accepted", "operator", "restored", "rejected", "frozen",
    "thawed",
)  # fmt: skip


def most_important(events: Sequence[Event]) -> Event:
    """Return the event that a reader has to know first; of the same kind the first.

    `events`: at least one.
    """
    return min(events, key=lambda e: _IMPORTANCE.index(e.kind))


class Tally:
    """Counts of a track."""

    def __init__(self, header: TrackHeader) -> None:
        """Begin before the first line."""
        self._header = header
        self._begin_s: float | None = None
        self._end_s = 0.0
        self._values = tuple(v.value for v in header.start.values()) or None
        self._updates = self._rejected = 0
        self._changes: list[Event] = []
        self._open: dict[str | None, Event] = {}
        self._counts: Counter[str] = Counter()

    @property
    def open_changes(self) -> tuple[Event, ...]:
        """Changes after which no new value of that parameter was accepted."""
        return tuple(self._open.values())

    @property
    def rejected_samples(self) -> int:
        """Samples that were not used."""
        return self._rejected

    @property
    def updates(self) -> int:
        """Lines in which the published values differ from those before."""
        return self._updates

    @property
    def counts(self) -> Mapping[str, int]:
        """How many events of each kind there were."""
        return dict(self._counts)

    @property
    def seconds_of_record(self) -> float:
        """From the beginning of the first reporting interval to the end of the last, s."""
        return 0.0 if self._begin_s is None else self._end_s - self._begin_s

    def add(self, line: TrackLine) -> None:
        """Count one line."""
        if self._begin_s is None:
            self._begin_s = line.t - self._header.every_s
        self._end_s = line.t
        values = tuple([v.value for v in line.parameters.values()])
        if values != self._values:
            self._updates += self._values is not None
            self._values = values
        for event in line.events:
            self._event(event)

    def _event(self, event: Event) -> None:
        self._counts[event.kind] += 1
        if event.kind == "rejected":
            self._rejected += event.samples or 0
        elif event.kind == "change":
            self._changes.append(event)
            self._open[event.parameter] = event
        elif event.kind == "accepted":  # without a name: all of them together
            if event.parameter is None:
                self._open.clear()
            else:
                self._open.pop(event.parameter, None)

    def summary(self, *, computing_s: float = float("nan"), complete: bool = True) -> TrackSummary:
        """Return what was counted.

        `computing_s`: time that was spent on it, s; NaN where it is not known; `complete`: whether the run came to the
        end of its record. Returns without latency; `samples` follows from time and rate, `updates` counts lines.
        """
        return TrackSummary(
            samples=round(self.seconds_of_record * self._header.rate_hz),
            seconds_of_record=self.seconds_of_record,
            computing_s=computing_s,
            updates=self._updates,
            rejected_samples=self._rejected,
            changes=tuple(self._changes),
            counts=self.counts,
            complete=complete,
        )
