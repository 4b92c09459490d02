"""The samples of a controller on their way to whoever reads: numbered, in blocks, with what their states tell."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace

from ambid.acquire.device import DeviceEvent, State
from ambid.acquire.devices.frames import FrameQueue
from ambid.acquire.link.reader import ClockDrift, Drift
from ambid.acquire.protocol.codec import Message
from ambid.acquire.protocol.samples import SampleCounters, SampleDecoder, Samples
from ambid.acquire.protocol.table import table
from ambid.arrays import Array
from ambid.errors import DeviceError
from ambid.track.blocks import Block, Frame

_FLOWING: tuple[State, ...] = ("sampling", "driving", "levitating")
_STATES: tuple[State, ...] = ("idle", "sampling", "driving", "levitating", "fault")


class SampleStream:
    """Turns frames of samples into blocks and events. `heard` and `told` are called from the listener's thread.

    `mask`: stream mask; `real`: whether the controller's time runs with the host's; else no drift is estimated;
    `convert`: from counts, shape (n_samples, n_columns), to what blocks hold; `room`: samples that wait at most.

    `frames`: what is read; `live`: whether what the controller tells is of this session; `ending`: whether it was asked
    to stop.
    """

    def __init__(self, mask: int, rate_hz: float, *, real: bool, convert: Callable[[Array], Array], room: int) -> None:
        self._rate, self._real, self._convert = rate_hz, real, convert
        self._decoder = SampleDecoder(mask, rate_hz=rate_hz if real else None)
        self._lock = threading.RLock()
        self.frames = FrameQueue(room)
        self._base = self._next = 0  # number of tick 0 of this run, and of the next sample
        self._state: State = "idle"
        self._latched = False  # a fault that was told
        self._running = False
        self.live = self.ending = False
        self._events: list[DeviceEvent] = []
        self._clock: ClockDrift | None = None
        self._drift = Drift()

    @property
    def state(self) -> State:
        """The state as last heard."""
        with self._lock:
            return self._state

    @property
    def counters(self) -> SampleCounters:
        """What became of the samples."""
        with self._lock:
            return replace(self._decoder.counters)

    def drift(self) -> Drift:
        """Return what is known of the clock."""
        with self._lock:
            now = self._clock.estimate() if self._clock is not None else Drift()
            if now.drift == now.drift and not now.drift_sd > self._drift.drift_sd:
                self._drift = now
            return self._drift

    def events(self) -> list[DeviceEvent]:
        """Return what was told since the last call."""
        with self._lock:
            found, self._events = self._events, []
            return found

    def tell(self, event: DeviceEvent) -> None:
        """Add an event."""
        with self._lock:
            self._events.append(event)

    def begin(self) -> None:
        """Expect tick 0; numbers count on."""
        with self._lock:
            self._base = self._next
            self._decoder.restart()
            if self._real:
                self.drift()
                self._clock = ClockDrift(self._rate)
            self._running = True
            self.frames.begin()

    def finish(self, ticks: int | None) -> None:
        """Give out what was held back: the controller has stopped.

        `ticks`: since start, as its status says.
        """
        with self._lock:
            if self._running:
                # A stop may break off the tick under way: it has a number, but never became a sample.
                whole = ticks is not None and ticks - (self._decoder.next_tick or 0) > 1
                self._pass_on(self._decoder.finish(ticks if whole else None), None)
            self._running = False
            self.frames.end()

    def fail(self, failure: DeviceError) -> None:
        """The line is lost: what came can be read, then the error is raised."""
        with self._lock:
            if self._running:
                self._pass_on(self._decoder.finish(), None)
            self._running = False
            self.tell(DeviceEvent(kind="link", sample=self._next, what=str(failure)))
            self.frames.end(failure)

    def enter(self, state: State, *, unless_fault: bool = False) -> None:
        """Note a state that a command brought about.

        `unless_fault`: only `clear` leaves a fault.
        """
        with self._lock:
            if unless_fault and self._state == "fault":
                return
            if state != self._state:
                self._state = state
                self._events.append(DeviceEvent(kind="state", sample=self._next, what=state))
            if state != "fault":
                self._latched = False

    def heard(self, payloads: list[bytes], arrived_s: float) -> None:
        """Take frames of samples.

        `arrived_s`: by `time.perf_counter`, s.
        """
        with self._lock:
            if not self._running:
                return  # of an earlier session
            samples = self._decoder.decode(payloads, arrived_s if self._real else None)
            self._pass_on(samples, arrived_s)
            if len(samples) and self._clock is not None:
                self._clock.learn(int(samples.ticks[-1]), arrived_s)

    def told(self, what: Message) -> None:
        """Take a fault, or a status."""
        with self._lock:
            if not self.live:
                return
            if what.name == "fault":
                self._fault(what["cause"], what["tick"])
            elif _state_of(what["state"]) == "fault":
                self._fault(what["cause"], what["fault_tick"])
            elif _state_of(what["state"]) == "idle" and self._state in _FLOWING and not self.ending:
                self._state = "idle"
                self.fail(
                    DeviceError(
                        "the controller is idle though it was started: it was reset on the way, by its watchdog or a"
                        " dip of its supply. Look at the supply, and start again"
                    )
                )

    def _pass_on(self, samples: Samples, arrived_s: float | None) -> None:
        for first, count in samples.gaps:
            self._events.append(DeviceEvent(kind="lost", sample=self._base + first, what="never came", count=count))
            self._next = max(self._next, self._base + first + count)
        faulty = samples.states == table().value("state", "fault")
        if faulty.any():
            at = int(faulty.argmax())
            self._fault(int(samples.causes[at]), int(samples.ticks[at]))
        values = self._convert(samples.values) if len(samples) else samples.values
        for run in samples.runs():
            self._put(self._base + int(samples.ticks[run.start]), values[run], arrived_s)

    def _put(self, first: int, values: Array, arrived_s: float | None) -> None:
        self._next = first + len(values)
        block = Block(first=first, time_s=first / self._rate, values=values)
        if not self.frames.put(Frame(block=block, arrived_s=time.perf_counter() if arrived_s is None else arrived_s)):
            self._events.append(
                DeviceEvent(kind="lost", sample=first, what="the host reads too slowly", count=len(values))
            )

    def _fault(self, cause: int, tick: int) -> None:
        if self._latched:
            return
        self._latched, self._state = True, "fault"
        at = self._base + tick if self._running else None
        self._events.append(DeviceEvent(kind="fault", sample=at, what=table().name("cause", cause)))


def _state_of(number: int) -> State | None:
    return _STATES[number] if 0 <= number < len(_STATES) else None
