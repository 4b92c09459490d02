"""A source that is iterated in a thread or process of its own, and fills a ring."""

from __future__ import annotations

import pickle
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from typing import Literal, Protocol

from ambid.errors import EstimationError
from ambid.track.stream.block import Block
from ambid.track.stream.replay import paced
from ambid.track.stream.ring import BlockRing

Pace = Literal["fastest", "real-time"]

_LOOK_S = 0.1  # how often a wait looks whether it should end
_PATIENCE_S = 5.0  # for a producer that was asked to stop


class Producer(Protocol):
    """Whoever fills the ring."""

    def alive(self) -> bool:
        """Return whether something may still come."""
        ...


@contextmanager
def produced_in(
    where: Literal["thread", "process"], source: Iterable[Block], ring: BlockRing, rate_hz: float, pace: Pace
) -> Iterator[Producer]:
    """Run a source beside the caller while the context lasts.

    `source`: for a process, one that can be pickled. Returns on leaving, it is told to stop; an exception of the source
    is raised then, unless another is on its way.
    """
    maker = _Thread(source, ring, rate_hz, pace) if where == "thread" else _Process(source, ring, rate_hz, pace)
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
    """Put the blocks of a source into a ring until they end or the consumer wants no more.

    `alone`: tells whether the consumer is dead.
    """

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


class _Thread:
    """The source in a thread of this process."""

    def __init__(self, source: Iterable[Block], ring: BlockRing, rate_hz: float, pace: Pace) -> None:
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(source, ring, rate_hz, pace), daemon=True)
        self._thread.start()

    def _run(self, source: Iterable[Block], ring: BlockRing, rate_hz: float, pace: Pace) -> None:
        try:
            fill(source, ring, rate_hz, pace)
        except BaseException as failure:  # raised again where the blocks are consumed
            self._failure = failure

    def alive(self) -> bool:
        return self._thread.is_alive()

    def end(self) -> BaseException | None:
        self._thread.join(_PATIENCE_S)
        return self._failure


class _Process:
    """The source in a fresh process; a forked one could inherit locks that nobody will open."""

    def __init__(self, source: Iterable[Block], ring: BlockRing, rate_hz: float, pace: Pace) -> None:
        try:
            packed = pickle.dumps(source)
        except (pickle.PicklingError, TypeError, AttributeError) as failure:
            raise EstimationError(
                f"the source of blocks cannot be sent to another process ({failure}). Use a Replay, or a thread"
            ) from None
        context = get_context("spawn")
        self._ours, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_child, args=(packed, ring.name, rate_hz, pace, theirs), daemon=True)
        with _ignoring_interrupts():  # the child begins so, and one that comes before it runs does not end it
            self._process.start()
        theirs.close()

    def alive(self) -> bool:
        return self._process.is_alive()

    def end(self) -> BaseException | None:
        try:
            told: BaseException | None = self._ours.recv() if self._ours.poll(_PATIENCE_S) else None
            dead = False
        except EOFError:
            told, dead = None, True
        self._process.join(_PATIENCE_S)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()
        if dead:
            return EstimationError(
                f"the process of the source died with exit code {self._process.exitcode} before its end. Start it again"
            )
        return told


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
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
            tell.send(EstimationError(f"the source of blocks failed: {outcome!r}. Mend the source"))
