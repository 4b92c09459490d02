"""What a simulated bench and a replayed record share: there is no line, and blocks are made when somebody asks.

As fast as possible, a block is made whenever one is read. In real time, every call first makes the blocks that are due
by now, and a command also the part of one, so that it acts between two samples as it would on a bench; what nobody
reads waits, and without room is counted.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Literal, NoReturn, Self

from ambid.acquisition.device import (
    MODES,
    Counters,
    DeviceEvent,
    DeviceInfo,
    LawTrial,
    Mode,
    Program,
    SelfTest,
    State,
    check_mode,
)
from ambid.acquisition.devices.frames import FrameQueue
from ambid.errors import DeviceError
from ambid.tracking.blocks import Block, Frame

Pace = Literal["real", "fastest"]

_BLOCKS_PER_SECOND = 100


def check_pace(pace: str) -> None:
    """Refuse a pace that no device has."""
    if pace not in ("real", "fastest"):
        raise DeviceError(f"pace is {pace!r}; a device goes in 'real' time or 'fastest'. Give one of them")


class PlayedDevice(ABC):
    """A device without a line. See `ambid.acquisition.device.Device` for what its methods promise.

    `rate_hz`: samples in one second; `block_samples`: samples of a block at most; default those of 10 ms.
    """

    def __init__(self, rate_hz: float, pace: Pace, block_samples: int | None = None) -> None:
        check_pace(pace)
        size = max(1, round(rate_hz / _BLOCKS_PER_SECOND)) if block_samples is None else block_samples
        if size < 1:
            raise DeviceError(f"a block of {size} samples holds nothing; it has at least one. Correct block_samples")
        self._rate, self._pace, self._size = rate_hz, pace, size
        self._lock = threading.Condition(threading.RLock())
        self._frames = FrameQueue()
        self._open = self._flowing = False
        self._state: State = "idle"
        self._next = 0  # number of the next sample
        self._began_s, self._began = 0.0, 0  # host time and number at which samples began to flow
        self._events: list[DeviceEvent] = []
        self._samples = self._lost = 0

    # What the two differ in.
    _info: DeviceInfo

    @abstractmethod
    def _opened(self) -> None:
        """Make ready."""

    @abstractmethod
    def _made(self, room: int) -> Block | None:
        """Make the next block of at most `room` samples; None where nothing is left."""

    @abstractmethod
    def _begin(self, mode: Mode) -> None:
        """Start out of idle, or from sampling."""

    @abstractmethod
    def _play(self, program: Program | None) -> None:
        """Excite."""

    @abstractmethod
    def _tested(self) -> SelfTest:
        """Look at itself."""

    def _clears(self) -> None:  # noqa: B027 - a record has no fault
        """Refuse while the cause of a fault is there."""

    # The contract.
    @property
    def info(self) -> DeviceInfo:
        """Who is there."""
        return self._info

    @property
    def state(self) -> State:
        """The state now."""
        with self._lock:
            self._catch_up(partly=False)
            return self._state

    def __enter__(self) -> Self:
        with self._lock:
            if self._open:
                raise DeviceError(f"{self._where} is open already; a device is opened once. Close it first")
            self._opened()
            self._open = True
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            if self._open:
                self.stop()
                self._open = False

    def self_test(self) -> SelfTest:
        """As `Device.self_test`."""
        with self._lock:
            self._ready("self_test")
            if self._state != "idle":
                self._refuse("self_test", "it is done when idle. Stop it first")
            return self._tested()

    def start(self, mode: Mode) -> None:
        """As `Device.start`."""
        with self._lock:
            self._ready("start")
            check_mode(mode, self._where)
            if self._state == "fault":
                self._refuse("start", "it does not start before clear. Remove the cause, then clear it")
            if self._state not in ("idle", "sampling") or (self._state == "sampling" and mode == "sample"):
                self._refuse("start", "it starts from idle, or from sampling to drive or levitate. Stop it first")
            self._begin(mode)
            if not self._flowing:
                self._flowing, self._began_s, self._began = True, time.perf_counter(), self._next
            self._enter_state(MODES[mode])

    def excite(self, program: Program | None) -> None:
        """As `Device.excite`."""
        with self._lock:
            self._ready("excite")
            if program is not None and self._state not in ("driving", "levitating"):
                self._refuse("excite", "an excitation is played while driving or levitating. Start one of these first")
            self._play(program)

    def load(self, program: Program) -> None:  # noqa: B027 - there is no line on which it would take time
        """As `Device.load`."""

    def arm(self, trial: LawTrial) -> None:  # noqa: ARG002 - a contract
        """As `Device.arm`: refused, as only the firmware keeps an old law."""
        self._refuse("arm", "only the firmware tries a law. Arm it on 'emulated' or a serial port")

    def confirm(self) -> None:
        """As `Device.confirm`."""
        self._refuse("confirm", "no law is on trial. Omit it")

    def read(self, timeout_s: float) -> Frame | None:
        """As `Device.read`."""
        end = time.perf_counter() + timeout_s
        with self._lock:
            if not self._open and self._frames.ended:
                self._ready("read")
            while True:
                self._catch_up(partly=False)
                if self._frames.ended and self._flowing and self._pace == "fastest":
                    self._make(self._size, time.perf_counter())
                frame = self._frames.take(0.0)
                if frame is not None:
                    return frame
                now = time.perf_counter()
                if not self._flowing or now >= end:
                    return None
                self._lock.wait(min(end, self._due(self._next + self._size)) - now if self._flowing else 0.0)

    @property
    def ended(self) -> bool:
        """Whether nothing more will come."""
        with self._lock:
            self._catch_up(partly=False)
            return not self._flowing and self._frames.ended

    def events(self) -> Sequence[DeviceEvent]:
        """As `Device.events`."""
        with self._lock:
            self._catch_up(partly=False)
            found, self._events = tuple(self._events), []
            return found

    def counters(self) -> Counters:
        """As `Device.counters`."""
        with self._lock:
            return Counters(samples=self._samples, lost=self._lost, overruns=self._frames.overruns)

    def stop(self) -> None:
        """As `Device.stop`; those that are due can still be read."""
        with self._lock:
            self._catch_up(partly=True)
            self._flowing = False
            if self._state != "fault":
                self._enter_state("idle")
            self._lock.notify_all()

    def clear(self) -> None:
        """As `Device.clear`; refused where there is no fault."""
        with self._lock:
            self._ready("clear")
            if self._state != "fault":
                self._refuse("clear", "there is no fault to clear. Omit it")
            self._clears()
            self._flowing = False
            self._enter_state("idle")
            self._lock.notify_all()

    # How it is done.
    @property
    def _where(self) -> str:
        return f"the {self.info.kind} device {self.info.port}"

    def _ready(self, what: str) -> None:
        if not self._open:
            raise DeviceError(f"{self._where} is not open; {what} needs it open. Use it in a with statement")
        self._catch_up(partly=True)

    def _refuse(self, what: str, rule: str) -> NoReturn:
        raise DeviceError(f"{self._where} refuses {what} in state {self._state}; {rule}")

    def _enter_state(self, state: State) -> None:
        if state != self._state:
            self._state = state
            self._events.append(DeviceEvent(kind="state", sample=self._next, what=state))

    def _due(self, number: int) -> float:
        """Host time at which all samples before `number` are there, s."""
        return self._began_s + (number - self._began) / self._rate

    def _catch_up(self, *, partly: bool) -> None:
        """In real time, make what is due; with `partly` up to this very sample, else whole blocks."""
        if self._pace != "real":
            return
        now = time.perf_counter()
        while self._flowing:
            due = int((now - self._began_s) * self._rate) - (self._next - self._began)
            size = min(due, self._size)
            if size < (1 if partly else self._size):
                return
            self._make(size, None)

    def _make(self, size: int, arrived_s: float | None) -> None:
        block = self._made(size)
        if block is None:
            self._flowing = False
            if self._state != "fault":
                self._enter_state("idle")
            return
        n = len(block.values)
        if block.first > self._next:
            self._lost += block.first - self._next
            self._events.append(
                DeviceEvent(kind="lost", sample=self._next, what="gap in the numbers", count=block.first - self._next)
            )
        self._next = max(self._next, block.first + n)  # a torn record may run back
        if not self._frames.put(
            Frame(block=block, arrived_s=self._due(self._next) if arrived_s is None else arrived_s)
        ):
            self._lost += n
            self._events.append(DeviceEvent(kind="lost", sample=block.first, what="the host read too slowly", count=n))
            return
        self._samples += n
