"""From samples to lines: feeds the supervisor, and reports once in every interval, counted from the stream's beginning
whatever the blocks; where samples are missing or rejected the lines go on, and say so.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from ambid.recursive.lines import Event, StartWords, TrackedValue, TrackHeader, TrackLine, TrackSummary
from ambid.tracking.evidence import Samples
from ambid.tracking.supervisor import Supervisor

if TYPE_CHECKING:
    from ambid.recursive.lines import Latency
    from ambid.tracking.blocks import Rejection


_LONGEST_GAP_S = 60.0  # a longer gap has no lines
_PASSING = ("gap", "nan", "range", "stuck")  # rejections of samples that had their place in the stream
_EXTRA_UNITS = {"unbalance": "kg m", "unbalance_phase": "rad"}


class Reporter:
    """Feeds a supervisor, whose listener is `Reporter.note`, and makes lines of what it says. `every_s`: reporting
    interval, s, at least a sample; `on_line`: called with each line, may return the operator's flags; `flags`: what is
    set when, s of record; `t0`: time of sample 0, s of record; `first`: number of the first tracked sample. `lines`,
    `samples`, `rejected`: lines made, samples used, samples rejected.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        *,
        every_s: float,
        on_line: Callable[[TrackLine], Sequence[str] | None],
        flags: Sequence[tuple[float, str]] = (),
        t0: float = 0.0,
        first: int = 0,
    ) -> None:
        self.supervisor, self._on_line, self._t0 = supervisor, on_line, t0
        self._rate = supervisor.rpem.numbers.rate_hz
        self.every_s = max(every_s, 1.0 / self._rate)
        self._count = int(first / (self.every_s * self._rate))
        self._next = 0
        self._pass_interval()
        supervisor.begin(first)
        self._flags = sorted(flags, key=lambda flag: flag[0])
        self._events: list[Event] = []
        self._counts: Counter[str] = Counter()
        self.lines = self.samples = self.rejected = 0

    def note(self, event: Event) -> None:
        """Count an event, and keep it for the next line."""
        self._counts[event.kind] += 1
        self._events.append(event)

    def consume(self, samples: Samples, first: int, *, restart: bool = False) -> None:
        """Take in finite samples from number `first` on and make the lines that they complete; `restart`: some are
        missing before.
        """
        self._pass(first)
        self._obey(first)
        k, n = 0, samples.y.shape[0]
        while k < n:
            stop = min(n, self._next - first)
            self.supervisor.feed(samples.part(k, stop), first + k, restart=restart and k == 0)
            self.samples += stop - k
            k = stop
            if first + k == self._next:
                self._report()

    def reject(self, rejection: Rejection) -> None:
        """Count samples that were not used, and say so."""
        self.rejected += rejection.samples
        first = round(rejection.t * self._rate)
        passing = rejection.kind in _PASSING
        if passing:
            self._pass(first)
        self.note(
            Event(
                kind="rejected",
                t=self._t0 + rejection.t,
                why=f"{rejection.kind}: {rejection.why}",
                samples=rejection.samples,
            )
        )
        if passing:
            self._pass(first + rejection.samples)

    def finish(self) -> None:
        """Report what has happened since the last line."""
        if self._events:
            self._report()

    def _pass_interval(self) -> None:
        """Go to the end of the next interval, a whole number of samples."""
        before = self._next
        while self._next <= before:
            self._count += 1
            self._next = round(self._count * self.every_s * self._rate)

    def _pass(self, sample: int) -> None:
        """Report intervals that end before a sample: nothing came in the rest of them."""
        if sample - self._next > _LONGEST_GAP_S * self._rate:
            self._report()
            self._count = int((sample - 1) / (self.every_s * self._rate))
            self._pass_interval()
        while self._next <= sample:
            self._report()

    def _obey(self, sample: int) -> None:
        """Set the flags that are due."""
        t = self._t0 + sample / self._rate
        while self._flags and self._flags[0][0] <= t:
            self.supervisor.order(self._flags.pop(0)[1])

    def _report(self) -> None:
        s = self.supervisor
        self._obey(self._next)
        s.wait(self._next)
        events, self._events = tuple(self._events), []
        line = TrackLine(
            t=self._t0 + self._count * self.every_s,
            parameters=s.parameters,
            error=s.error,
            state=s.state,
            events=events,
            extra=s.extra,
            choices=s.choices,
        )
        self._pass_interval()
        self.lines += 1
        for flag in self._on_line(line) or ():
            s.order(flag)

    def summary(self, *, computing_s: float, latency: Latency | None = None, complete: bool = True) -> TrackSummary:
        """Return the last line. `complete`: whether the run came to the end of its record."""
        s = self.supervisor
        return TrackSummary(
            samples=self.samples,
            seconds_of_record=self.samples / self._rate,
            computing_s=computing_s,
            updates=s.publication.updates,
            rejected_samples=self.rejected,
            changes=tuple(s.diagnosis.changes),
            counts=dict(self._counts),
            latency=latency,
            complete=complete,
            update_s=s.diagnosis.update_s,
        )


def header(
    supervisor: Supervisor,
    *,
    limit: float,
    every_s: float,
    method: str,
    record: Mapping[str, object],
    said: StartWords | None = None,
) -> TrackHeader:
    """Return the first line of a track by a supervisor before its first sample; `said`: of the start."""
    numbers = supervisor.rpem.numbers
    start: dict[str, TrackedValue] = supervisor.parameters
    gains = [name for name, kind in zip(numbers.names, numbers.kinds, strict=True) if kind == "gain"]
    units = dict(zip(numbers.names, numbers.units, strict=True))
    return TrackHeader(
        rate_hz=numbers.rate_hz,
        limit=limit,
        method=method,
        model=numbers.problem.model.name,
        units={**{name: units[name] for name in (*start, *gains)}, **_EXTRA_UNITS},
        every_s=every_s,
        start=start,
        record=record,
        **(said or {}),
    )
