"""The engine around a tracker: blocks go source -> ring -> guard -> consumer, timed, until they end or are interrupted.

The ring serves a producer in another process, never kept waiting by the consumer. Every wait can be ended.
"""

from __future__ import annotations

import pickle
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import ceil, log10
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any, Literal, cast

import numpy as np

from ambid.errors import EstimationError
from ambid.recursive.lines import Latency
from ambid.tracking.blocks import Block, Frame, Passed, Rejection, Stretch, paced
from ambid.tracking.guard import StreamGuard
from ambid.tracking.ring import BlockRing

_LOWEST = 1e-7  # s: upper edge of the first bin
_PER_DECADE = 100
_DECADES = 11  # up to 10 000 s; what is beyond is in the last bin


class LatencyStatistics:
    """Counts latencies: `count` of blocks; `largest`, s; `overruns`: lost because the ring was full; `late`: come
    before the work on the one before had ended; `start`: largest until `caught_up`, s, left out of the others, None
    before.
    """

    def __init__(self) -> None:
        self.overruns = self.late = self.count = 0
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
        if not latency_s < float("inf"):
            raise EstimationError(
                f"a latency of {latency_s} s cannot be counted; it must be a number. Correct the clock"
            )
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
        if not 0 <= fraction <= 1:
            raise EstimationError(f"the fraction of a quantile is {fraction}; it must lie within 0 and 1. Correct it")
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
            overruns=self.overruns,
            late=self.late,
            start=self.start,
        )


Pace = Literal["fastest", "real-time"]

_LOOK_S = 0.1  # how often a wait looks whether it should end
_PATIENCE_S = 5.0  # for a producer that was asked to stop


@contextmanager
def produced_beside(source: Iterable[Block], ring: BlockRing, rate_hz: float, pace: Pace) -> Iterator[_Producer]:
    """Run a source, which can be pickled, in another process while the context lasts; on leaving, tell it to stop and
    raise its exception, unless another is on its way.
    """
    maker = _Producer(source, ring, rate_hz, pace)
    try:
        yield maker
    except BaseException:
        ring.stop()
        maker.end()
        raise
    ring.stop()
    failure = maker.end()
    if failure is not None:
        raise failure


def fill(
    source: Iterable[Block], ring: BlockRing, rate_hz: float, pace: Pace, *, alone: Callable[[], bool] = lambda: False
) -> None:
    """Put a source's blocks into a ring until they end or the consumer wants no more, or is dead, by `alone`."""

    def stopped() -> bool:
        return ring.stopping or alone()

    try:
        if pace == "real-time":
            for frame in paced(source, rate_hz, stopped=stopped):
                if stopped():
                    return
                ring.put(frame.block, frame.arrived_s)
            return
        for block in source:
            while not ring.wait_for_room(_LOOK_S):
                if stopped():
                    return
            if ring.stopping:
                return
            ring.put(block)
    finally:
        ring.end()


class _Producer:
    """The source in a fresh process; a forked one could inherit locks that nobody will open."""

    def __init__(self, source: Iterable[Block], ring: BlockRing, rate_hz: float, pace: Pace) -> None:
        try:
            packed = pickle.dumps(source)
        except (pickle.PicklingError, TypeError, AttributeError) as failure:
            raise EstimationError(
                f"the source of blocks cannot be sent to another process ({failure}). Use a Replay"
            ) from None
        context = get_context("spawn")
        self._ours, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_child, args=(packed, ring.name, rate_hz, pace, theirs), daemon=True)
        with ignoring_interrupts():  # the child begins so, and one that comes before it runs does not end it
            self._process.start()
        theirs.close()

    def alive(self) -> bool:
        """Return whether something may still come."""
        return self._process.is_alive()

    def end(self) -> BaseException | None:
        try:
            failure: BaseException | None = self._ours.recv() if self._ours.poll(_PATIENCE_S) else None
            dead = False
        except EOFError:
            failure, dead = None, True
        self._process.join(_PATIENCE_S)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()
        if dead:
            return EstimationError(
                f"the source process ended early with exit code {self._process.exitcode}. Start it again"
            )
        return failure


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


def _child(packed: bytes, name: str, rate_hz: float, pace: Pace, tell: Connection) -> None:
    """Fill the ring from another process; interrupts are the consumer's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    outcome: BaseException | None = None
    parent = parent_process()
    with BlockRing.attach(name) as ring:
        try:
            fill(pickle.loads(packed), ring, rate_hz, pace, alone=lambda: parent is not None and not parent.is_alive())
        except Exception as failure:
            outcome = failure
    with suppress(BrokenPipeError):  # the consumer was killed: nobody is there to be told
        try:
            tell.send(outcome)
        except BrokenPipeError:
            raise
        except Exception:
            tell.send(EstimationError(f"the source of blocks failed: {outcome!r}. Correct the source"))


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamReport:
    """What went through an engine; samples and rejections are counted by the `guard`."""

    guard: StreamGuard
    blocks: int  # that came
    seconds: float  # from the first wait to the end, s of clock
    working_s: float  # of these, in the guard and the consumer
    # none if nothing came. In real time from when a block was due; as fast as possible, with the time in the ring.
    latency: Latency | None
    torn: int  # blocks lost because their check value was wrong
    interrupted: bool  # whether it ended by an interrupt, everything up to then being delivered


def run(
    source: Iterable[Block | Frame] | BlockRing,
    consume: Callable[[Stretch], object],
    reject: Callable[[Rejection], object] | None = None,
    *,
    guard: StreamGuard,
    pace: Pace = "fastest",
    producer: Literal["none", "process"] = "none",
    ring_blocks: int = 64,
    block_samples: int = 200,
    stopped: Callable[[], bool] = lambda: False,
) -> StreamReport:
    """Pump blocks (of the fastest pace also frames, with their time of arrival) through a fresh `guard` to `consume`,
    given each clean stretch, and `reject`, given each rejection. An interrupt (Ctrl-C), or `stopped` asked between
    blocks, ends the stream: what was acquired is delivered, and the report says so; a second one interrupts the
    consumer. Exceptions of source or consumer are raised again; the ring, of `ring_blocks` times `block_samples`, is
    removed in any case. `pace`: of a source that is no ring.
    """
    pump = _Pump(guard, consume, reject)
    with _Interrupt() as interrupt:

        def ending() -> bool:
            return interrupt.came or stopped()

        if isinstance(source, BlockRing):
            pump.drain(source, ending, None)
        elif producer == "none":
            frames = (
                paced(cast("Iterable[Block]", source), guard.rate_hz, stopped=ending)
                if pace == "real-time"
                else (x if isinstance(x, Frame) else Frame(block=x, arrived_s=time.perf_counter()) for x in source)
            )
            pump.pull(frames, ending, interrupt)
        else:
            names = [f"c{k}" for k in range(guard.n_channels)]
            with (
                BlockRing.create(
                    rate_hz=guard.rate_hz, channels=names, slots=ring_blocks, block_samples=block_samples
                ) as ring,
                produced_beside(cast("Iterable[Block]", source), ring, guard.rate_hz, pace) as maker,
            ):
                pump.drain(ring, ending, maker)
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
        self.blocks = self.torn = 0

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

    def drain(self, ring: BlockRing, ending: Callable[[], bool], maker: _Producer | None) -> None:
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

    def finish(self, *, interrupted: bool) -> StreamReport:
        """Deliver what waits in the guard, and say what went through."""
        self._deliver(self._guard.flush(), 0)
        return StreamReport(
            guard=self._guard,
            blocks=self.blocks,
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

    @contextmanager
    def now(self) -> Iterator[None]:
        """Let an interrupt act at once while the context lasts."""
        self._waiting = True
        try:
            yield
        finally:
            self._waiting = False
