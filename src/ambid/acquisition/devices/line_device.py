"""A controller at the end of a line, whatever the line is: hardware or its emulation."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Literal, Self

from ambid.acquisition.device import (
    MODES,
    AxesProgram,
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
from ambid.acquisition.devices.controller import Controller, Port, open_port
from ambid.acquisition.devices.played import FrameQueue
from ambid.acquisition.law_words import LawWords
from ambid.acquisition.program import counts_of, of_one_axis
from ambid.acquisition.protocol import table
from ambid.acquisition.protocol.codec import Message
from ambid.acquisition.protocol.samples import SampleCounters, SampleDecoder, Samples
from ambid.acquisition.settings import columns, controller_settings, in_si
from ambid.arrays import Array
from ambid.errors import DeviceError
from ambid.rig.rig import Rig
from ambid.tracking.blocks import Block, Frame

_NONE: Mapping[str, int] = MappingProxyType({})
_TABLE_PART = 48  # elements in one message
_LAW_PART = 24  # words in one message
_TOLD = ("overruns", "dropped", "rx_errors", "rx_lost", "busy_us", "supply_mv")  # of a status
_FLOWING: tuple[State, ...] = ("sampling", "driving", "levitating")
_STATES: tuple[State, ...] = ("idle", "sampling", "driving", "levitating", "fault")


class SampleStream:
    """Turns frames of samples into blocks and events. `heard` and `told` are called from the listener's thread.

    `real`: whether the controller's time runs with the host's; `convert`: counts
    (n_samples, n_columns) to what blocks hold; `live`: whether what is told is of this session; `ending`: it was asked
    to stop.
    """

    def __init__(self, mask: int, rate_hz: float, *, real: bool, convert: Callable[[Array], Array]) -> None:
        self._rate, self._real, self._convert = rate_hz, real, convert
        self._decoder = SampleDecoder(mask, rate_hz=rate_hz if real else None)
        self._lock = threading.RLock()
        self.frames = FrameQueue()
        self._base = self._next = 0  # number of tick 0 of this run, and of the next sample
        self._state: State = "idle"
        self._latched = False  # a fault that was told
        self._running = False
        self.live = self.ending = False
        self._events: list[DeviceEvent] = []

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

    def events(self) -> list[DeviceEvent]:
        """Return what was told since the last call."""
        with self._lock:
            events, self._events = self._events, []
            return events

    def tell(self, event: DeviceEvent) -> None:
        """Add an event."""
        with self._lock:
            self._events.append(event)

    def begin(self) -> None:
        """Expect tick 0; numbers count on."""
        with self._lock:
            self._base = self._next
            self._decoder.restart()
            self._running = True
            self.frames.begin()

    def finish(self, ticks: int | None) -> None:
        """Give out what was held back: the controller has stopped, after `ticks` since start by its status."""
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
        """Note a state that a command brought about; only `clear` leaves a fault."""
        with self._lock:
            if unless_fault and self._state == "fault":
                return
            if state != self._state:
                self._state = state
                self._events.append(DeviceEvent(kind="state", sample=self._next, what=state))
            if state != "fault":
                self._latched = False

    def heard(self, payloads: list[bytes], arrived_s: float) -> None:
        """Take frames of samples that arrived at `arrived_s` by `time.perf_counter`, s."""
        with self._lock:
            if not self._running:
                return  # of an earlier session
            samples = self._decoder.decode(payloads, arrived_s if self._real else None)
            self._pass_on(samples, arrived_s)

    def told(self, what: Message) -> None:
        """Take a fault, or a status."""
        with self._lock:
            if not self.live:
                return
            if what.name == "law_status":
                if what["id"] == 0:
                    about = next(e.about for e in table().enums["back_out"] if e.value == what["cause"])
                    self._events.append(DeviceEvent(kind="law", sample=self._base + what["tick"], what=about))
            elif what.name == "fault":
                self._fault(what["cause"], what["tick"])
            elif _state_of(what["state"]) == "fault":
                self._fault(what["cause"], what["fault_tick"])
            elif _state_of(what["state"]) == "idle" and self._state in _FLOWING and not self.ending:
                self._state = "idle"
                self.fail(
                    DeviceError(
                        "the controller is idle though it was started: it was reset on the way, by its watchdog or a"
                        " dip of its supply. Check the supply, and start again"
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


class LineDevice(ABC):
    """A device behind a port. See `ambid.acquisition.device.Device` for what its methods promise.

    `rig`: with ``[daq]`` and calibrations from counts; `where`: the port's name; `si`: columns in SI, not counts;
    `real`: the controller's time runs with the host's; `answer_s`: wait for an answer before a command is sent again,
    s.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        kind: Literal["serial", "emulated"],
        where: str,
        si: bool = False,
        real: bool = True,
        answer_s: float = 0.3,
    ) -> None:
        self._rig, self._si, self._real, self._answer_s = rig, si, real, answer_s
        self._settings = controller_settings(rig)
        rate = self._settings.rate_hz
        shown = columns(rig, self._settings, si=si)
        self._info = DeviceInfo(kind=kind, port=where, rate_hz=rate, columns=shown, real=real)
        self._stream = self._new_stream()
        self._controller: Controller | None = None
        self._loaded: Program | None = None
        self._status: dict[str, float] = {}
        self._before = (0, 0)
        self._damaged_told = 0
        self._loss_told = False
        self._last = Counters()

    @abstractmethod
    def _open(self) -> Port:
        """Return the open port."""

    def _paused(self) -> bool:
        """Whether the controller's time stands still."""
        return False

    def _let_go(self) -> None:  # noqa: B027 - most lines have nothing behind the port
        """End whatever stands behind the port."""

    @property
    def info(self) -> DeviceInfo:
        """Who is there."""
        return self._info

    @property
    def state(self) -> State:
        """The state as last heard."""
        return self._stream.state

    def __enter__(self) -> Self:
        if self._controller is not None:
            raise DeviceError(f"{self._where} is open already; a device is opened once. Close it first")
        self._stream, self._status, self._damaged_told, self._loss_told = self._new_stream(), {}, 0, False
        try:
            port = self._open()
            self._controller = Controller(
                port,
                samples=self._stream.heard,
                told=self._told,
                lost=self._stream.fail,
                paused=self._paused,
                answer_s=self._answer_s,
            )
            self._prepare(self._controller, port.name)
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._controller is None:
            return
        try:
            if self._controller.failure is None:
                self.stop()
            elif not self._loss_told and kind is None:
                raise DeviceError(str(self._controller.failure))
        except DeviceError:
            if kind is None:  # else there is a greater trouble on its way
                raise
        finally:
            self._end()

    def self_test(self) -> SelfTest:
        """As `Device.self_test`."""
        answer = self._ask("self_test")
        about = {e.name: e.about for e in table().bits["failed"]}
        failed = tuple(about[name] for name in table().names_of_bits("failed", answer["failed"]))
        numbers = {name: float(v) for name, v in answer.fields.items() if name not in ("id", "failed")}
        return SelfTest(failed=failed, numbers=MappingProxyType(numbers))

    def start(self, mode: Mode) -> None:
        """As `Device.start`."""
        check_mode(mode, self._where)
        before = self.state
        if before == "idle":
            self._stream.begin()
        try:
            self._ask("start", {"mode": table().value("mode", mode)})
        except DeviceError:
            if before == "idle":
                self._stream.finish(None)
            raise
        self._stream.enter(MODES[mode], unless_fault=True)  # it may have tripped in its first tick

    def excite(self, program: Program | AxesProgram | None) -> None:
        """As `Device.excite`."""
        on = self.state in ("driving", "levitating")
        if program is not None and not on:
            raise DeviceError(
                f"{self._where} refuses excite in state {self.state}; an excitation is played while driving or"
                " levitating. Start one of these first"
            )
        if on and (program is None or program is not self._loaded):
            self._ask("excite", {"on": 0})
        if program is None:
            return
        if program is not self._loaded:
            self.load(program)
        self._loaded = None  # what was changed meanwhile is not known
        if program.kind != "none":
            self._ask("excite", {"on": 1})

    def load(self, program: Program | AxesProgram) -> None:
        """As `Device.load`."""
        program = of_one_axis(program)
        fields = counts_of(program, self._rig, self._settings)
        for at in range(0, len(program.table), _TABLE_PART):
            self._ask("table", {"offset": at}, values=program.table[at : at + _TABLE_PART])
        self._ask("excitation", fields)
        self._loaded = program

    def arm(self, trial: LawTrial) -> None:
        """As `Device.arm`."""
        bounds = {"position_low": trial.low, "position_high": trial.high, "confirm_ms": trial.confirm_ms}
        self._send_law(self._ready(), trial.law, bounds)

    def confirm(self) -> None:
        """As `Device.confirm`."""
        self._ask("settle", {"keep": 1})

    def read(self, timeout_s: float) -> Frame | None:
        """As `Device.read`."""
        frame = None
        try:
            frame = self._stream.frames.take(timeout_s)
        except DeviceError as failure:
            self._loss_told = True
            raise DeviceError(str(failure)) from None
        if frame is None and self._controller is None:
            self._ready()
        return frame

    @property
    def ended(self) -> bool:
        """Whether nothing more will come."""
        return self._stream.frames.ended

    def events(self) -> Sequence[DeviceEvent]:
        """As `Device.events`."""
        events = self._stream.events()
        damaged = self._last.damaged if self._controller is None else self._damaged(self._controller)
        if damaged > self._damaged_told:
            new, self._damaged_told = damaged - self._damaged_told, damaged
            events.append(DeviceEvent(kind="damaged", sample=None, what="frames with wrong check values", count=new))
        return tuple(events)

    def counters(self) -> Counters:
        """As `Device.counters`."""
        return self._last if self._controller is None else self._counted(self._controller)

    def stop(self) -> None:
        """As `Device.stop`. Where the line is lost, the controller goes to its safe state by itself."""
        self._stream.ending = True
        try:
            self._ask("stop")
            # What was sampled has come before this answer.
            self._stream.finish(self._ask("ask_status")["ticks"])
        finally:
            self._stream.ending = False
        self._stream.enter("idle", unless_fault=True)

    def clear(self) -> None:
        """As `Device.clear`; refused where there is no fault, or its cause is still there."""
        self._ask("clear")
        self._stream.finish(self._ask("ask_status")["ticks"])
        self._stream.enter("idle")

    @property
    def _where(self) -> str:
        return f"the {self._info.kind} device at {self._info.port}"

    def _ready(self) -> Controller:
        if self._controller is None:
            raise DeviceError(f"{self._where} is not open; it answers while it is. Use it in a with statement")
        return self._controller

    def _ask(self, name: str, fields: Mapping[str, int] = _NONE, *, values: tuple[int, ...] = ()) -> Message:
        controller = self._ready()
        try:
            return controller.ask(name, fields, values=values)
        except DeviceError:
            self._loss_told = self._loss_told or controller.failure is not None
            raise

    def _new_stream(self) -> SampleStream:
        return SampleStream(self._settings.stream, self._settings.rate_hz, real=self._real, convert=self._converted)

    def _converted(self, counts: Array) -> Array:
        return in_si(self._rig, self._settings, counts) if self._si else counts

    def _told(self, what: Message) -> None:
        if what.name == "status":
            self._status = {name: float(what[name]) for name in _TOLD}
        self._stream.told(what)

    def _prepare(self, controller: Controller, where: str) -> None:
        """Identify, bring to idle whatever was before, and tell it the settings."""
        who = controller.identify()
        identity = MappingProxyType({k: v for k, v in who.fields.items() if k != "id"})
        self._info = replace(self._info, port=where, identity=identity)
        controller.ask("stop")
        before = controller.ask("ask_status")
        if before["state"] == table().value("state", "fault"):
            controller.ask("clear")  # refused while the cause is there
            cause = table().name("cause", before["cause"])
            text = f"a fault of an earlier session ({cause}) was cleared"
            self._stream.tell(DeviceEvent(kind="link", sample=None, what=text))
        for name in ("configure", "limits", "gains"):
            controller.ask(name, self._settings.fields(name))
        if self._settings.law is not None:
            self._send_law(controller, self._settings.law, {"position_low": 0, "position_high": 0, "confirm_ms": 0})
        controller.pace(self._settings.rate_hz)
        # What came before is not of this session.
        line = controller.counters
        self._before = (line.damaged + controller.odd, line.discarded_bytes)
        self._stream.live = True

    def _send_law(self, controller: Controller, law: LawWords, trial: Mapping[str, int]) -> None:
        """Send the words, and arm them: from the next start on, or on trial."""
        for at in range(0, len(law.words), _LAW_PART):
            controller.ask("law", {"offset": at}, values=law.words[at : at + _LAW_PART])
        self._loaded = None  # words and the table's end share memory
        controller.ask("arm", {"period": self._settings.period, "checksum": law.checksum, **trial})

    def _counted(self, c: Controller) -> Counters:
        line, samples, frames = c.counters, self._stream.counters, self._stream.frames
        return Counters(
            samples=samples.samples - frames.overrun_samples,
            lost=samples.lost + frames.overrun_samples,
            damaged=self._damaged(c),
            discarded_bytes=line.discarded_bytes + c.reader.overrun_bytes - self._before[1],
            overruns=frames.overruns + c.reader.overruns,
            resent=c.resent,
            controller=MappingProxyType(dict(self._status)),
        )

    def _damaged(self, c: Controller) -> int:
        samples = self._stream.counters
        return c.counters.damaged + samples.damaged + samples.misnumbered + samples.repeated + c.odd - self._before[0]

    def _end(self) -> None:
        controller, self._controller = self._controller, None
        try:
            if controller is not None:
                controller.close()
                self._stream.frames.end()
                self._last = self._counted(controller)
        finally:
            self._let_go()


class SerialDevice(LineDevice):
    """The controller behind a serial port or a pseudo-terminal, its `rig` with ``[daq]`` and calibrations from counts.

    Blocks hold counts. ``Block.time_s`` is sample number over rate by the controller's clock; a command is sent again
    after `answer_s`.
    """

    def __init__(self, port: str, rig: Rig, *, answer_s: float = 0.3) -> None:
        super().__init__(rig, kind="serial", where=port, answer_s=answer_s)
        assert rig.daq is not None  # else the settings were refused
        self._port, self._baud = port, rig.daq.baud

    def _open(self) -> Port:
        return open_port(self._port, baud=self._baud)
