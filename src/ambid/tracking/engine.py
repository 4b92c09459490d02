"""The engine around a tracker: blocks go source -> guard -> consumer, timed, until they end or are interrupted. Every
wait can be ended.
"""

from __future__ import annotations

import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil, log10
from types import FrameType
from typing import Any, Literal, cast

import numpy as np

from ambid.recursive.lines import Latency
from ambid.tracking.blocks import Block, Frame, Passed, Rejection, Stretch, paced
from ambid.tracking.guard import StreamGuard

_LOWEST = 1e-7  # s: upper edge of the first bin
_PER_DECADE = 100
_DECADES = 11  # up to 10 000 s; what is beyond is in the last bin


class LatencyStatistics:
    """Counts latencies: `count` of blocks; `largest`, s; `late`: come before the work on the one before had ended;
    `start`: largest until `caught_up`, s, left out of the others, None before.
    """

    def __init__(self) -> None:
        self.late = self.count = 0
        self.start: float | None = None
        self.largest = 0.0
        self._bins = np.zeros(_PER_DECADE * _DECADES + 1, dtype=np.int64)

    def caught_up(self) -> None:
        """Count from now on; what came before is of the start. Only the first call does something."""
        if self.start is None and self.count:
            self.start, self.largest, self.late, self.count = self.largest, 0.0, 0, 0
            self._bins[:] = 0

    def add(self, latency_s: float) -> None:
        """Count a block."""
        at = 0  # of what the clock cannot resolve
        if latency_s > _LOWEST:
            at = ceil(_PER_DECADE * log10(latency_s / _LOWEST))
            self.largest = max(self.largest, latency_s)
        self._bins[min(at, self._bins.size - 1)] += 1
        self.count += 1

    def quantile(self, fraction: float) -> float:
        """Return the latency in s that this fraction of blocks does not exceed: upper edge of its bin, or the largest
        latency if less; NaN without any block.
        """
        if not self.count:
            return float("nan")
        at = int(np.searchsorted(np.cumsum(self._bins), max(fraction * self.count, 1.0)))
        return self.largest if at >= self._bins.size - 1 else min(_LOWEST * 10.0 ** (at / _PER_DECADE), self.largest)

    def summary(self) -> Latency | None:
        """Return what a track reports of them; None without any block."""
        if not self.count:
            return None
        return Latency(
            median=self.quantile(0.5),
            p99=self.quantile(0.99),
            largest=self.largest,
            late=self.late,
            start=self.start,
        )


Pace = Literal["fastest", "real-time"]


@contextmanager
def ignoring_interrupts() -> Iterator[None]:
    """Let processes that are started meanwhile leave Ctrl-C to this one, from their first moment on."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamReport:
    """What went through an engine; samples and rejections are counted by the `guard`."""

    guard: StreamGuard
    blocks: int  # that came
    seconds: float  # from the first wait to the end, s of clock
    working_s: float  # of these, in the guard and the consumer
    latency: Latency | None  # in real time from when a block was due; None if nothing came
    interrupted: bool  # whether it ended by an interrupt, everything up to then being delivered


def run(
    source: Iterable[Block | Frame],
    consume: Callable[[Stretch], object],
    reject: Callable[[Rejection], object] | None = None,
    *,
    guard: StreamGuard,
    pace: Pace = "fastest",
    stopped: Callable[[], bool] = lambda: False,
) -> StreamReport:
    """Pump blocks (of the fastest pace also frames, with their time of arrival) through a fresh `guard` to `consume`,
    given each clean stretch, and `reject`, given each rejection. An interrupt (Ctrl-C), or `stopped` asked between
    blocks, ends the stream: what was acquired is delivered, and the report says so; a second one interrupts the
    consumer. Exceptions of source or consumer are raised again.
    """
    pump = _Pump(guard, consume, reject)
    with _Interrupt() as interrupt:

        def ending() -> bool:
            return interrupt.came or stopped()

        frames = (
            paced(cast("Iterable[Block]", source), guard.rate_hz, stopped=ending)
            if pace == "real-time"
            else (x if isinstance(x, Frame) else Frame(block=x, arrived_s=time.perf_counter()) for x in source)
        )
        pump.pull(frames, ending, interrupt)
        return pump.finish(interrupted=interrupt.came)


class _Pump:
    """Takes frames through guard and consumer, and the time of each."""

    def __init__(
        self, guard: StreamGuard, consume: Callable[[Stretch], object], reject: Callable[[Rejection], object] | None
    ) -> None:
        self._guard, self._consume, self._reject = guard, consume, reject
        self._statistics = LatencyStatistics()
        self._arrivals: deque[float] = deque()  # of blocks whose work is not done: some wait in the guard
        self._done = float("-inf")
        self._begun = time.perf_counter()
        self._working = 0.0
        self.blocks = 0

    def take(self, frame: Frame) -> None:
        """Work on one frame."""
        began = time.perf_counter()
        if frame.arrived_s < self._done:
            self._statistics.late += 1
        else:
            self._statistics.caught_up()
        self.blocks += 1
        self._arrivals.append(frame.arrived_s)
        self._deliver(self._guard.take(frame.block), self._guard.n_waiting)
        self._working += self._done - began

    def _deliver(self, entries: Iterable[Passed], waiting: int) -> None:
        """Hand on what the guard lets pass, and count the latency of blocks that are done with."""
        for passed in entries:
            if isinstance(passed, Stretch):
                self._consume(passed)
            elif self._reject is not None:
                self._reject(passed)
        self._done = time.perf_counter()
        while len(self._arrivals) > waiting:
            self._statistics.add(self._done - self._arrivals.popleft())

    def pull(self, frames: Iterator[Frame], ending: Callable[[], bool], interrupt: _Interrupt) -> None:
        """Take all frames of a source; a source that keeps us waiting is interrupted there."""
        while not ending():
            try:
                with interrupt.now():
                    frame = next(frames, None)
            except _Interrupted:
                return
            if frame is None:
                return
            self.take(frame)

    def finish(self, *, interrupted: bool) -> StreamReport:
        """Deliver what waits in the guard, and say what went through."""
        self._deliver(self._guard.flush(), 0)
        return StreamReport(
            guard=self._guard,
            blocks=self.blocks,
            seconds=time.perf_counter() - self._begun,
            working_s=self._working,
            latency=self._statistics.summary(),
            interrupted=interrupted,
        )


class _Interrupted(BaseException):
    """An interrupt that came while a source kept us waiting."""


class _Interrupt:
    """Turns the first interrupt into a wish to end; the second is an ordinary one."""

    def __init__(self) -> None:
        self.came = False
        self._waiting = False
        self._before: Any = None

    def __enter__(self) -> _Interrupt:
        if threading.current_thread() is threading.main_thread():
            before = signal.getsignal(signal.SIGINT)
            if before is signal.default_int_handler:  # whoever handles interrupts otherwise, keeps doing so
                self._before = before
                signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        if self.came:
            raise KeyboardInterrupt
        self.came = True
        if self._waiting:
            raise _Interrupted

    @contextmanager
    def now(self) -> Iterator[None]:
        """Let an interrupt act at once while the context lasts."""
        self._waiting = True
        try:
            yield
        finally:
            self._waiting = False
