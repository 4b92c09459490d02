"""The engine around a tracker: blocks go source -> ring -> guard -> consumer, timed, until they end or are interrupted.

In process, the blocks come straight from the source. With a producer of its own (a thread or another process), they
come through the ring, so that the source is never kept waiting by the consumer. Every wait is one that can be ended.
"""

from __future__ import annotations

import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import FrameType, MappingProxyType
from typing import Any, Literal

from ambid.recursive.lines import Latency
from ambid.track.stream.block import Block, Frame
from ambid.track.stream.guard import StreamGuard
from ambid.track.stream.latency import LatencyStatistics
from ambid.track.stream.outcome import Rejection, RejectionKind, Stretch
from ambid.track.stream.producer import Pace, Producer, produced_in
from ambid.track.stream.replay import paced
from ambid.track.stream.ring import BlockRing

_LOOK_S = 0.1  # how often a wait looks whether it should end


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamReport:
    """What went through an engine."""

    blocks: int  # that came
    samples: int
    given: int  # samples that the consumer got; that came and were not given; that never came
    rejected: int
    missing: int
    reordered: int  # blocks that came too late but in time to be put right
    drift: float  # of the acquisition's clock, relative to the stated rate
    events: Mapping[RejectionKind, int]  # rejections of each kind, and the samples in them
    rejected_samples: Mapping[RejectionKind, int]
    seconds: float  # from the first wait to the end, s of clock
    working_s: float  # of these, in the guard and the consumer
    # none if nothing came. In real time from when a block was due; as fast as possible, with the time in the ring.
    latency: Latency | None
    torn: int  # blocks lost because their check value was wrong
    interrupted: bool  # whether it ended by an interrupt, everything up to then being delivered


def run(
    source: Iterable[Block] | BlockRing,
    consume: Callable[[Stretch], object],
    reject: Callable[[Rejection], object] | None = None,
    *,
    guard: StreamGuard,
    pace: Pace = "fastest",
    producer: Literal["none", "thread", "process"] = "none",
    ring_blocks: int = 64,
    block_samples: int = 200,
    stopped: Callable[[], bool] = lambda: False,
) -> StreamReport:
    """Pump blocks from a source through the guard to a consumer.

    An interrupt (Ctrl-C) between two blocks ends the stream: what was acquired up to then is delivered, and the report
    says so. A second one interrupts the consumer itself. An exception of source or consumer ends everything and is
    raised again; the ring is removed in any case.

    `consume`: given each clean stretch; `reject`: given each rejection; `guard`: a fresh one, of this stream; `pace`:
    of a source that is no ring; `ring_blocks`, `block_samples`: capacity of the ring, with a producer; `stopped`: asked
    between blocks; True ends the stream as an interrupt does.
    """
    pump = _Pump(guard, consume, reject)
    with _Interrupt() as interrupt:

        def ending() -> bool:
            return interrupt.came or stopped()

        if isinstance(source, BlockRing):
            pump.drain(source, ending, None)
        elif producer == "none":
            frames = paced(source, guard.rate_hz, stopped=ending) if pace == "real-time" else _at_once(source)
            pump.pull(frames, ending, interrupt)
        else:
            names = [f"c{k}" for k in range(guard.n_channels)]
            with (
                BlockRing.create(
                    rate_hz=guard.rate_hz, channels=names, slots=ring_blocks, block_samples=block_samples
                ) as ring,
                produced_in(producer, source, ring, guard.rate_hz, pace) as maker,
            ):
                pump.drain(ring, ending, maker)
        pump.finish()
        return pump.report(interrupted=interrupt.came)


def _at_once(source: Iterable[Block]) -> Iterator[Frame]:
    for block in source:
        yield Frame(block=block, arrived_s=time.perf_counter())


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
        self.blocks = self.torn = 0

    def take(self, frame: Frame) -> None:
        """Work on one frame."""
        began = time.perf_counter()
        self._statistics.late += frame.arrived_s < self._done
        self.blocks += 1
        self._arrivals.append(frame.arrived_s)
        for passed in self._guard.take(frame.block):
            if isinstance(passed, Stretch):
                self._consume(passed)
            elif self._reject is not None:
                self._reject(passed)
        self._count(self._guard.n_waiting)
        self._working += self._done - began

    def _count(self, waiting: int) -> None:
        """Count the latency of blocks that are done with."""
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

    def drain(self, ring: BlockRing, ending: Callable[[], bool], maker: Producer | None) -> None:
        """Take all frames of a ring; when it should end, those that it holds by then."""
        left: int | None = None
        while left is None or left > 0:
            if left is None and ending():
                if maker is not None:  # a ring of others is left to go on
                    ring.stop()
                left = ring.filled
                continue
            frame = ring.read(_LOOK_S if left is None else 0.0)
            left = None if left is None else left - 1
            if frame is not None:
                self.take(frame)
            elif ring.ended or (maker is not None and not maker.alive() and not ring.filled):
                break
        self._statistics.overruns, self.torn = ring.overruns, ring.torn

    def finish(self) -> None:
        """Deliver what waits in the guard."""
        for passed in self._guard.flush():
            if isinstance(passed, Stretch):
                self._consume(passed)
            elif self._reject is not None:
                self._reject(passed)
        self._count(0)

    def report(self, *, interrupted: bool) -> StreamReport:
        guard = self._guard
        return StreamReport(
            blocks=self.blocks,
            samples=guard.n_received,
            given=guard.n_given,
            rejected=guard.n_rejected,
            missing=guard.n_missing,
            reordered=guard.n_reordered,
            drift=guard.drift,
            events=MappingProxyType(dict(guard.events)),
            rejected_samples=MappingProxyType(dict(guard.samples)),
            seconds=time.perf_counter() - self._begun,
            working_s=self._working,
            latency=self._statistics.summary(),
            torn=self.torn,
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

    def now(self) -> _Waiting:
        """Return a context in which an interrupt acts at once."""
        return _Waiting(self)


class _Waiting:
    def __init__(self, interrupt: _Interrupt) -> None:
        self._interrupt = interrupt

    def __enter__(self) -> None:
        self._interrupt._waiting = True

    def __exit__(self, *_: object) -> None:
        self._interrupt._waiting = False
