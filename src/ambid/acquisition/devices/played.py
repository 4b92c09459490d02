"""Devices without a line, simulated or replayed. As fast as possible, a block is made when one is read. In real time
every call makes what is due, a command also part of a block, so that it acts between two samples as on a bench.
"""

from __future__ import annotations

import os
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NoReturn, Self

import numpy as np

from ambid.acquisition.device import (
    MODES,
    AxesProgram,
    Column,
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
from ambid.errors import DeviceError, RecordError
from ambid.record import Record, read_rows
from ambid.rig.rig import Rig, role_units
from ambid.tracking.blocks import Block, Frame, Replay, blocks_of
from ambid.units import UNKNOWN

ROOM = 4_000_000
"""Samples that wait at most: half an hour at 2 kHz."""


class FrameQueue:
    """A queue of frames with an end, and perhaps a reason for it; `room` samples wait at most.

    `overruns`: blocks dropped for want of room; `overrun_samples`: samples in them.
    """

    def __init__(self, room: int = ROOM) -> None:
        self.room, self._held = room, 0
        self._frames: deque[Frame] = deque()
        self._changed = threading.Condition()
        self._ended = True
        self._failure: DeviceError | None = None
        self.overruns = self.overrun_samples = 0

    def begin(self) -> None:
        """Expect frames; what still waits can be read before them."""
        with self._changed:
            self._ended = False

    def put(self, frame: Frame) -> bool:
        """Append a frame, or count it as lost and return False."""
        n = len(frame.block.values)
        with self._changed:
            if not self._fits(n):
                self.overruns += 1
                self.overrun_samples += n
                return False
            self._frames.append(frame)
            self._held += n
            self._changed.notify_all()
            return True

    def end(self, failure: DeviceError | None = None) -> None:
        """Say that nothing more will come until the next beginning; `failure` is raised once all frames are read."""
        with self._changed:
            self._ended = True
            self._failure = self._failure or failure
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Frame | None:
        """Return the next frame; None if none came within `timeout_s`, or at the end."""
        with self._changed:
            if timeout_s > 0.0:
                self._changed.wait_for(lambda: self._frames or self._ended, timeout_s)
            if self._frames:
                frame = self._frames.popleft()
                self._held -= len(frame.block.values)
                self._changed.notify_all()
                return frame
            if self._failure is not None:
                raise self._failure
            return None

    def wait_for_room(self, n: int, timeout_s: float) -> bool:
        """Wait until `n` samples fit: for a source that can; whether they do."""
        with self._changed:
            return self._changed.wait_for(lambda: self._fits(n), timeout_s)

    def _fits(self, n: int) -> bool:
        return not self._held or self._held + n <= self.room

    @property
    def held(self) -> int:
        """Samples that wait."""
        return self._held

    @property
    def ended(self) -> bool:
        """Whether all was read and nothing more will come."""
        with self._changed:
            return self._ended and not self._frames


Pace = Literal["real", "fastest"]

_BLOCKS_PER_SECOND = 100


def check_pace(pace: str) -> None:
    """Refuse a pace that no device has."""
    if pace not in ("real", "fastest"):
        raise DeviceError(f"pace is {pace!r}; a device goes in 'real' time or 'fastest'. Give one of them")


class PlayedDevice(ABC):
    """A device without a line. See `ambid.acquisition.device.Device` for what its methods promise. Blocks have
    `block_samples` at most, by default those of 10 ms.
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
    def _play(self, program: Program | AxesProgram | None) -> None:
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

    def excite(self, program: Program | AxesProgram | None) -> None:
        """As `Device.excite`."""
        with self._lock:
            self._ready("excite")
            if program is not None and self._state not in ("driving", "levitating"):
                self._refuse("excite", "an excitation is played while driving or levitating. Start one of these first")
            self._play(program)

    def load(self, program: Program | AxesProgram) -> None:  # noqa: B027 - there is no line on which it would take time
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
            events, self._events = tuple(self._events), []
            return events

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


class ReplayDevice(PlayedDevice):
    """A record file as a device: the rig's columns first, then all others. Each start out of idle plays it from its
    first row, numbers counting on; ``Block.time_s`` is the record's, from the first row.
    """

    def __init__(self, path: str | Path, rig: Rig, *, pace: Pace = "real") -> None:
        rows = read_rows(path, rate_hz=rig.record.rate_hz)
        record = rows.record
        missing = [c.column for c in rig.channels if c.column not in record.names]
        if missing:
            raise DeviceError(
                f"record {path} has no column {missing[0]!r}, which the rig needs; it has {', '.join(record.names)}."
                " Correct the rig, or use another record"
            )
        _check_units(record, rig, f"record {path}")
        super().__init__(record.rate_hz, pace)
        roles = {c.column: c.role for c in rig.channels}
        others = {name: name if name == "excitation" else "extra" for name in record.names if name not in roles}
        try:
            self._replay: Replay = blocks_of(record, self._size, channels=(*roles, *others), time_s=rows.time_s)
        except RecordError as failure:
            raise DeviceError(str(failure)) from None
        columns = tuple(
            Column(name=name, role=role, unit=record.channel(name).unit) for name, role in (roles | others).items()
        )
        # A name of other bytes than UTF-8 cannot be written into a record as it is.
        port = os.fsencode(path).decode("utf-8", "replace")
        self._info = DeviceInfo(
            kind="replay", port=port, rate_hz=record.rate_hz, columns=columns, real=pace == "real"
        )  # fmt: skip
        self._row = self._base = 0

    def _opened(self) -> None:
        self._row = 0

    def _begin(self, mode: Mode) -> None:
        if mode != "sample":
            self._refuse_playing(f"mode {mode!r}")
        self._row, self._base = 0, self._next

    def _play(self, program: Program | AxesProgram | None) -> None:
        if program is not None:
            self._refuse_playing("an excitation")

    def _tested(self) -> SelfTest:
        bad = int(np.isnan(self._replay.values).any(axis=1).sum())
        failed = (f"{bad} of {len(self._replay.values)} rows have holes",) if bad else ()
        return SelfTest(failed=failed, numbers={"rows": float(len(self._replay.values)), "rows_with_holes": float(bad)})

    def _made(self, room: int) -> Block | None:
        played = self._replay
        start, total = self._row, played.numbers.size
        if start >= total:
            return None
        stop = min(start + room, total)
        # A block ends where the numbers do not follow on each other.
        steps = np.diff(played.numbers[start:stop])
        jumps = np.flatnonzero(steps != 1)
        if jumps.size:
            stop = start + int(jumps[0]) + 1
        self._row = stop
        return Block(
            first=self._base + int(played.numbers[start] - played.numbers[0]),
            time_s=self._base / self._rate + float(played.time_s[start] - played.time_s[0]),
            values=played.values[start:stop],
        )

    def _refuse_playing(self, what: str) -> NoReturn:
        raise DeviceError(
            f"{self._where} refuses {what}; a record can be listened to, not acted on. Use mode 'sample', or a"
            " simulated device"
        )


def _check_units(record: Record, rig: Rig, where: str) -> None:
    """Refuse a column whose unit is not the one that the rig's calibration begins with; one without unit may pass."""
    wanted = role_units(rig.plant)
    for c in rig.channels:
        channel, calibration = record.channel(c.column), c.calibration
        if c.unit is not None or channel.unit == UNKNOWN:
            continue
        counts = "1" if rig.daq is not None else channel.unit  # a gain of a controller's rig is for counts
        unit = wanted.get(c.role, channel.unit) if calibration is None else calibration.unit_in or counts
        if unit not in (channel.unit, "?"):  # any unit
            raise DeviceError(
                f"{where}: column {c.column!r} is in [{channel.source_unit or channel.unit}]; channels.{c.role} of the"
                f" rig takes [{unit}]{', counts' if unit == '1' else ''}. Replay it with the rig that it was taken"
                " with, or correct the calibration"
            )
