"""Blocks in the order of their samples, each placed by its sample number and its time stamp together.

The stamp of sample n is t_0 + (n - n_0) T (1 + d) + jitter, T = 1 / rate as stated, d the crystal's drift; a Kalman
filter of (t_0, d) predicts the next. A block that contradicts the stream is doubted until the next confirms it (clock
or counter jumped) or not (damaged). Missing blocks are waited for as far as a small buffer reaches.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError, counted
from ambid.tracking.blocks import Passed, Rejection, RejectionKind, Stretch


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """A block under its number in the stream."""

    first: int  # number of the first sample, with wrap-arounds and new counts taken out
    time_s: float  # its stamp, s; NaN if it has none
    values: Array  # (n_samples, n_channels)

    @property
    def size(self) -> int:
        """Number of samples."""
        return int(self.values.shape[0])

    @property
    def end(self) -> int:
        """Number of the sample after the last."""
        return self.first + int(self.values.shape[0])


class Ledger:
    """Collects what is given in the order of the stream, and counts: `events`, rejections by kind; `samples` in them;
    `n_given`, samples in stretches. `rate_hz` turns sample numbers into times.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate = rate_hz
        self._entries: list[Passed] = []
        self.events: dict[RejectionKind, int] = {}
        self.samples: dict[RejectionKind, int] = {}
        self.n_given = 0

    def reject(self, kind: RejectionKind, samples: int, first: int, why: str) -> None:
        """Enter a rejection. `first`: number of the first of them; `why`: one line for people."""
        self.events[kind] = self.events.get(kind, 0) + 1
        self.samples[kind] = self.samples.get(kind, 0) + samples
        self._entries.append(Rejection(kind=kind, samples=samples, t=first / self._rate, why=why))

    def give(self, stretch: Stretch) -> None:
        """Enter a stretch."""
        self.n_given += stretch.values.shape[0]
        self._entries.append(stretch)

    def taken(self) -> list[Passed]:
        """Return the entries since the last call."""
        entries, self._entries = self._entries, []
        return entries


DRIFT_SD = 1e-4  # of a crystal against its stated rate, before anything is known
_DRIFT_WALK = 1e-6  # wander of the drift in one second
_SIGMAS = 4.0


class SampleClock:
    """Predicts the time stamp of a sample number, and learns from stamps that agree; `rate_hz`: as stated; `drift`:
    estimated relative deviation of the stamps' period from it.
    """

    def __init__(self, rate_hz: float, tolerance_s: float) -> None:
        if not 0 < rate_hz < float("inf"):
            raise EstimationError(f"the clock's rate is {rate_hz}; it must be a positive number of Hz. Correct rate_hz")
        if not tolerance_s > 0:
            raise EstimationError(f"the clock's tolerance is {tolerance_s} s; it must be positive. Give seconds")
        self._period = 1.0 / rate_hz
        self._tolerance = tolerance_s
        self._jitter = (tolerance_s / 3.0) ** 2
        self.drift = 0.0
        self.start(0, 0.0)

    def start(self, number: int, time_s: float) -> None:
        """Begin again at one stamp, s, of sample `number`, keeping what is known of the drift."""
        self._number, self._time = number, time_s
        self._p00, self._p01, self._p11 = self._jitter, 0.0, DRIFT_SD**2

    def deviation(self, number: int, time_s: float) -> float:
        """Return how far a stamp lies from its prediction, s; positive if it is late."""
        return time_s - self._time - (number - self._number) * self._period * (1.0 + self.drift)

    def agrees(self, number: int, time_s: float) -> bool:
        """Tell whether a stamp, s, lies within tolerance of its prediction and the drift's addition; NaN does not."""
        dt = (number - self._number) * self._period
        # The spread of the offset is left out: it is jitter, which the tolerance covers, and one sample must stand out.
        return abs(self.deviation(number, time_s)) <= self._tolerance + _SIGMAS * sqrt(self._p11) * abs(dt)

    def agree(self, number: int, time_s: float, other: int, other_s: float) -> bool:
        """Tell whether two stamps, s, agree with each other, whatever was known before; not if one is NaN."""
        dt = (other - number) * self._period
        between = other_s - time_s - dt * (1.0 + self.drift)
        return abs(between) <= self._tolerance + _SIGMAS * DRIFT_SD * abs(dt)

    def learn(self, number: int, time_s: float) -> None:
        """Take in a stamp, s, that agrees; nothing is learned from a number below that of the last stamp."""
        if number <= self._number:
            return
        error = self.deviation(number, time_s)
        dt = (number - self._number) * self._period
        p00 = self._p00 + dt * (2.0 * self._p01 + dt * self._p11)
        p01 = self._p01 + dt * self._p11
        p11 = self._p11 + _DRIFT_WALK**2 * max(dt, 0.0)
        # Joseph form for one measurement of the first state.
        total = p00 + self._jitter
        k0, k1 = p00 / total, p01 / total
        self._time = time_s - (1.0 - k0) * error
        self._number = number
        self.drift += k1 * error
        self._p00 = (1.0 - k0) ** 2 * p00 + k0**2 * self._jitter
        self._p01 = (1.0 - k0) * (p01 - k1 * p00) + k0 * k1 * self._jitter
        self._p11 = p11 - 2.0 * k1 * p01 + k1**2 * total


_REMEMBERED = 8  # blocks that came but were refused: their numbers are not waited for
_LEAP_S = 1.0  # a number that leads by more is doubted where no clock says that so much time went by


class BlockOrder:
    """Places blocks, each sample once, later than all before; `depth`: blocks that may wait for a missing one; `place`:
    given each part in order, less what had been passed. `next`: number wanted next; `offset`: of the stream's numbers
    against the acquisition's.
    """

    def __init__(
        self,
        *,
        rate_hz: float,
        clock: SampleClock,
        depth: int,
        patience_s: float,
        ledger: Ledger,
        place: Callable[[Part], None],
        broke: Callable[[], None],
    ) -> None:
        self._clock, self._depth = clock, depth
        self._patience, self._leap = patience_s * rate_hz, _LEAP_S * rate_hz
        self._ledger, self._place_it, self._broke = ledger, place, broke
        self._started = False
        self._doubtful: Part | None = None
        self._waiting: list[Part] = []
        self._refused: deque[tuple[int, int]] = deque(maxlen=_REMEMBERED)
        self._tail: Part | None = None  # the last one placed
        self._old: Part | None = None  # the last one whose numbers had passed
        self._old_samples = 0  # in sequence up to that
        self.next = self.offset = 0

    @property
    def n_waiting(self) -> int:
        """Number of blocks that wait for a missing or a confirming one."""
        return len(self._waiting) + (self._doubtful is not None)

    def take(self, part: Part) -> None:
        """Take in a block: place it, hold it, or refuse it."""
        if not self._started:  # until another block confirms the first: a damaged number must not number the stream
            doubtful = self._doubtful
            if doubtful is None:
                self._doubtful = part
            elif self._confirms(doubtful, part):
                self._doubtful = None
                low, high = sorted((doubtful, part), key=lambda each: each.first)
                self._start(low)
                self._line_up(low)
                self._line_up(high)
            elif doubtful.first == part.first and doubtful.size == part.size:
                self._reject("repeated", part, "came again")
            else:
                self._dismiss()
                self._doubtful = part
        elif part.end <= self.next:
            before = self._old
            follows = before is not None and part.first == before.end and self._confirms(before, part)
            self._old_samples = part.size + (self._old_samples if follows else 0)
            self._old = part
            # A clock that runs on while the counter is set back shows a new count at once; else only its length does.
            if before is not None and follows and (self._runs_on(before) or self._old_samples >= self._patience):
                self._count_anew([part])
            else:
                self._reject("repeated", part, f"came again or too late: expected {self.next}")
        elif self.fits(part):
            self._dismiss()
            self._line_up(part)
        else:
            self._doubt(part)

    def finish(self) -> None:
        """Place what waits: nothing else will come."""
        if not self._started and self._doubtful is not None:
            only, self._doubtful = self._doubtful, None
            self._start(only)
            self._line_up(only)
        self._dismiss()
        self._release_all()

    def fits(self, part: Part) -> bool:
        """Tell whether number and stamp of a block agree with the stream. Returns false before the stream has begun."""
        return self._started and self._clock.agrees(part.first, part.time_s)

    def pass_over(self, part: Part) -> None:
        """Remember numbers that came but were refused: they are not waited for."""
        if self._started and part.end > self.next:
            self._refused.append((part.first, part.end))

    def _confirms(self, one: Part, other: Part) -> bool:
        """Tell whether two blocks belong to one stream, whatever was known before."""
        same = one.first == other.first
        return not same and self._clock.agree(one.first, one.time_s, other.first, other.time_s)

    def _runs_on(self, part: Part) -> bool:
        """Tell whether a block is stamped as the next one should be, whatever its number."""
        return self._clock.agrees(self.next, part.time_s)

    def _start(self, part: Part) -> None:
        """Begin to count at a block."""
        self._started, self.next = True, part.first
        self._clock.start(part.first, part.time_s)

    def _count_anew(self, parts: Sequence[Part]) -> None:
        """Follow a counter that jumped, under numbers that go on."""
        self._dismiss()
        self._release_all()
        shift = self.next - parts[0].first
        raw = parts[0].first - self.offset
        self.offset += shift
        self._ledger.reject(
            "number", 0, self.next, f"the acquisition counts again from {raw}; its samples are numbered on"
        )
        self._broke()
        self._tail = None
        self._clock.start(self.next, parts[0].time_s)
        for part in parts:
            self._line_up(Part(first=part.first + shift, time_s=part.time_s, values=part.values))

    def _doubt(self, part: Part) -> None:
        """Hold a block that contradicts the stream, or follow it and the one before if they agree with each other."""
        doubtful = self._doubtful
        if doubtful is None or not self._confirms(doubtful, part):
            self._dismiss()
            self._doubtful = part
            return
        self._doubtful = None
        low, high = sorted((doubtful, part), key=lambda each: each.first)
        if low.first - self.next > self._leap and self._runs_on(low):
            self._count_anew([low, high])  # nobody lost so much in no time
            return
        self._release_all()  # what waits came before the jump
        off = self._clock.deviation(low.first, low.time_s)
        jump = f"{'forward' if off > 0 else 'back'} by {abs(off):.4g} s" if isfinite(off) else "by an implausible time"
        self._ledger.reject("clock", 0, low.first, f"the clock jumped {jump} against the sample numbers")
        self._clock.start(low.first, low.time_s)
        self._broke()
        for each in (low, high):
            self._line_up(each)

    def _dismiss(self) -> None:
        """Refuse the doubtful block: nothing confirmed it."""
        part, self._doubtful = self._doubtful, None
        if part is None:
            return
        number = self._started and part.first != self.next and self._runs_on(part)
        why = "are out of sequence" if number else f"are stamped {part.time_s:.9g} s"
        self._reject("number" if number else "clock", part, f"{why}, and no other block agrees")
        self.pass_over(part)

    def _line_up(self, part: Part) -> None:
        """Place a block in order: it waits while one before it may still come."""
        self._old = None
        if any(part.first == each.first and part.end == each.end for each in self._waiting):
            self._reject("repeated", part, "came again")
            return
        if self._missing_before(part):
            self._waiting.append(part)
            self._waiting.sort(key=lambda each: each.first)
            while len(self._waiting) > self._depth:
                self._release()
        else:
            self._place(part)
        while self._waiting and not self._missing_before(self._waiting[0]):
            self._place(self._waiting.pop(0))

    def _missing_before(self, part: Part) -> int:
        """Return how many numbers from the wanted one up to a block neither came nor were refused."""
        missing, at = part.first - self.next, self.next
        if missing <= 0:
            return 0
        for start, stop in sorted(self._refused):
            covered = min(stop, part.first) - max(start, at)
            if covered > 0:
                missing -= covered
                at = min(stop, part.first)
        return missing

    def _release(self) -> None:
        """Give up what is missing before the first of the waiting blocks, and place that."""
        part = self._waiting.pop(0)
        missing = self._missing_before(part)
        if missing:
            self._ledger.reject(
                "gap", missing, self.next, f"{counted(missing, 'sample')} before {part.first} never came"
            )
        self._place(part)

    def _release_all(self) -> None:
        while self._waiting:
            self._release()

    def _place(self, part: Part) -> None:
        """Hand on a block that is next, less what had been passed."""
        if part.end <= self.next:
            self._reject("repeated", part, "came again")
            return
        again = self.next - part.first
        if again > 0:
            if self._contradicts(part):
                self._reject("contradiction", part, "hold other values than when they came before")
                self.pass_over(part)
                self._broke()
                return
            self._ledger.reject("overlap", again, part.first, f"the first {again} samples of a block had come before")
        if self._clock.agrees(part.first, part.time_s):
            self._clock.learn(part.first, part.time_s)
        self.next, self._tail = part.end, part
        while self._refused and self._refused[0][1] <= self.next:
            self._refused.popleft()
        fresh = max(again, 0)
        self._place_it(
            part if not fresh else Part(first=part.first + fresh, time_s=part.time_s, values=part.values[fresh:])
        )

    def _contradicts(self, part: Part) -> bool:
        """Tell whether the overlap with the last placed block differs where both hold numbers."""
        tail = self._tail
        low = max(tail.first, part.first) if tail is not None else part.end
        high = min(tail.end, part.end) if tail is not None else part.end
        if tail is None or low >= high:
            return False
        mine, theirs = (each.values[low - each.first : high - each.first] for each in (part, tail))
        return bool(((mine != theirs) & np.isfinite(mine) & np.isfinite(theirs)).any())

    def _reject(self, kind: RejectionKind, part: Part, why: str) -> None:
        self._ledger.reject(kind, part.size, part.first, f"samples {part.first} to {part.end - 1} {why}")
