"""The port: a serial line that is ours alone, opened with a remedy in each refusal; the link knows no more of it."""

from __future__ import annotations

import errno
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

from ambid.acquisition.protocol import table
from ambid.acquisition.protocol.codec import FrameDecoder, Message, encode, message, unpack
from ambid.errors import DeviceError, nearest

if TYPE_CHECKING:
    import serial


_WAIT_S = 0.005  # a read ends after this with what is there: bytes are taken in bundles, not one by one
_WRITE_S = 2.0  # a line that takes no bytes for so long is lost
_LARGEST = 65536  # bytes of one read
_PSEUDO = ("/dev/pts/", "/dev/ttys0", "/dev/pty")  # terminals without a board behind them


class PortEnded(OSError):
    """What stood behind a port has ended, and no cable brings it back; its text says all."""


class Port(Protocol):
    """A line of bytes in both directions. All methods but `read` and `write` may be called from any thread."""

    @property
    def name(self) -> str:
        """Where it is."""
        ...

    def read(self) -> bytes:
        """Return the bytes that have come; none if none came within some milliseconds. `OSError`: the line is lost."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes; one thread at a time. `OSError`: the line is lost."""
        ...

    def close(self) -> None:
        """Let go; again is harmless."""
        ...


class SerialPort:
    """A serial port or pseudo-terminal through pyserial; `line` is open."""

    def __init__(self, line: serial.Serial, name: str) -> None:
        self._line, self._name = line, name

    @property
    def name(self) -> str:
        """Where it is."""
        return self._name

    def read(self) -> bytes:
        """Return the bytes that have come, none after some milliseconds."""
        try:
            return bytes(self._line.read(_LARGEST))
        except (TypeError, ValueError) as failure:  # pyserial's answer to a descriptor that was closed meanwhile
            raise OSError(errno.EBADF, f"closed while reading: {failure}") from None

    def write(self, data: bytes) -> None:
        """Send bytes."""
        try:
            self._line.write(data)
        except (TypeError, ValueError) as failure:
            raise OSError(errno.EBADF, f"closed while writing: {failure}") from None

    def close(self) -> None:
        """Let go; again is harmless."""
        with suppress(OSError):  # the line is gone: there is nothing left to let go
            self._line.close()


def open_port(name: str, *, baud: int, boot_s: float | None = None) -> SerialPort:
    """Open a serial port (``/dev/ttyACM0``, ``COM3``) for this program alone, ready; earlier bytes are discarded."""
    try:
        import serial
    except ImportError:
        raise DeviceError(
            f"port {name}: the package pyserial is not installed, and serial ports need it."
            " Install it with: pip install 'ambid[daq]'"
        ) from None
    line = serial.Serial()
    try:
        line.port, line.baudrate = name, baud
        line.timeout, line.write_timeout, line.exclusive = _WAIT_S, _WRITE_S, True
        line.open()
    except _lost(ValueError) as failure:  # SerialException is an OSError
        line.close()
        raise DeviceError(_refusal(name, baud, failure)) from None
    try:
        _hurry(line)
        wait = (0.0 if name.startswith(_PSEUDO) else 2.0) if boot_s is None else boot_s
        _sit_out(line, wait)
    except _lost() as failure:
        line.close()
        raise DeviceError(f"port {name} was lost while its board started ({failure}). Plug it in again") from None
    except BaseException:
        line.close()
        raise
    return SerialPort(line, name)


def candidate_ports() -> Sequence[str]:
    """Return names and descriptions of serial ports with a device behind them, USB first; empty without pyserial."""
    try:
        from serial.tools import list_ports
    except ImportError:
        return ()
    ports = sorted(list_ports.comports(), key=lambda p: (p.vid is None, p.device))
    # A PC announces serial ports that have no connector: they have no hardware id.
    return tuple(f"{p.device} ({p.description})" for p in ports if p.vid is not None or p.hwid not in (None, "n/a"))


def _lost(*others: type[Exception]) -> tuple[type[Exception], ...]:
    """What a line that is gone raises: on POSIX also termios.error, which is no OSError."""
    try:
        import termios
    except ImportError:
        return (OSError, *others)
    return (OSError, termios.error, *others)


def _hurry(line: Any) -> None:
    """Ask the driver not to collect bytes for 16 ms; many have no such setting, and go well without."""
    with suppress(OSError, ValueError, AttributeError, NotImplementedError):
        line.set_low_latency_mode(True)


def _sit_out(line: Any, boot_s: float) -> None:
    """Wait in silence: a boot loader that hears bytes stays longer."""
    end = time.monotonic() + boot_s
    while (left := end - time.monotonic()) > 0.0:
        time.sleep(min(left, 0.1))
    line.reset_input_buffer()


def _refusal(name: str, baud: int, failure: Exception) -> str:
    """Turn the operating system's refusal into what, rule and remedy."""
    code, text = getattr(failure, "errno", None), str(failure)
    if code == errno.EACCES or "PermissionError" in text or "Permission denied" in text or "Access is denied" in text:
        return (
            f"port {name} may not be opened by this user, or another program has it; a serial port belongs to the group"
            " that owns it. On Linux: sudo usermod -a -G dialout $USER, then log in again; elsewhere close the other"
            " program"
        )
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text or "busy" in text.lower():
        return (
            f"port {name} is busy: another program has it open, and a controller obeys one host alone. Close the other"
            " program, e.g. a serial monitor"
        )
    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "FileNotFoundError" in text:
        ports = candidate_ports()
        meant = "" if "/" in name else nearest(name.lower(), ("emulated", "simulated", "replay:FILE"))
        if not ports:
            return f"port {name} does not exist; no serial port with a device is there.{meant} Plug the board in"
        return (
            f"port {name} does not exist; there are {'; '.join(ports)}.{meant} Plug the board in, or give one of these"
        )
    if isinstance(failure, ValueError) or "baud" in text.lower():
        return f"port {name} cannot go at {baud} baud ({text}). Give the daq.baud of the firmware, or another adapter"
    return f"port {name} cannot be opened ({text}). Check the name and the cable"


_ROOM = 1 << 24  # bytes: almost three minutes at 1 Mbaud
_ANSWERS = {"identify": "identity", "ask_status": "status", "self_test": "self_test_result"}
_SLOW = {"self_test": 10.0}  # times as long as another command's answer: the program memory is summed up
_LOOK_S = 0.2
_PATIENCE_S = 10.0  # for a thread to end
_TRIES = 5  # how often a command is sent
_PING_S = 0.05  # of the host's clock, or
_PING_SAMPLES_S = 0.025  # of samples received, whichever comes first
_SILENT_S = 0.5  # without a sample: it is asked for its status
_LAST_ID, _PING_ID = 254, 255  # of a command, of every ping
_NONE: Mapping[str, int] = MappingProxyType({})
_LOST = "the controller goes to its safe state by itself"


@dataclass(frozen=True, slots=True, kw_only=True)
class Chunk:
    """Bytes that came together."""

    data: bytes
    arrived_s: float  # when they were there, by `time.perf_counter`, s


class Reader:
    """Alone reads a port until it is closed or lost (`failure` says why), with `room` bytes that wait at most.

    `overruns`: reads dropped for want of room; `overrun_bytes`: bytes in them.
    """

    def __init__(self, port: Port, *, room: int = _ROOM) -> None:
        self._port, self._room = port, room
        self._chunks: deque[Chunk] = deque()
        self._held = 0
        self.overruns = self.overrun_bytes = 0
        self.failure: OSError | None = None
        self._stopping = False
        self._over = False
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=f"read {port.name}", daemon=True)
        self._thread.start()

    def take(self, timeout_s: float) -> list[Chunk]:
        """Take all that has come, waiting at most `timeout_s`; empty if nothing came."""
        with self._news:
            self._news.wait_for(lambda: self._chunks or self._over, timeout_s)
            chunks = list(self._chunks)
            self._chunks.clear()
            self._held = 0
        return chunks

    @property
    def over(self) -> bool:
        """True once nothing more will come and all was taken."""
        with self._news:
            return self._over and not self._chunks

    def close(self) -> None:
        """Stop reading; again is harmless. The port stays open."""
        self._stopping = True
        if self._thread is not threading.current_thread():
            self._thread.join(_PATIENCE_S)

    def _run(self) -> None:
        failure: OSError | None = None
        try:
            while not self._stopping:
                data = self._port.read()
                if data:
                    self._put(data, time.perf_counter())
        except OSError as lost:
            failure = lost
        except Exception as defect:  # else nobody would learn that nothing is read any more
            failure = OSError(f"{type(defect).__name__}: {defect}")
        finally:
            with self._news:
                self.failure = None if self._stopping else failure
                self._over = True
                self._news.notify_all()

    def _put(self, data: bytes, arrived_s: float) -> None:
        with self._news:
            if self._held + len(data) > self._room:
                self.overruns += 1
                self.overrun_bytes += len(data)
                return
            self._chunks.append(Chunk(data=data, arrived_s=arrived_s))
            self._held += len(data)
            self._news.notify_all()


@dataclass(slots=True)
class _Waiting:
    """A command under way."""

    name: str
    answer: Message | None = None


class Controller:
    """Commands, answers and the sign of life. Its methods may be called from any thread, except from `heard`.

    It owns an open `port` and closes it. The listener's thread gives `samples` frames and their time of arrival, and
    `told` statuses and what nobody asked for; `lost` gets the error once, from the thread that sees it. No ping while
    `paused`; a command is sent again after `answer_s`, counted in `resent`. `odd`: sound frames that are no message.
    """

    def __init__(
        self,
        port: Port,
        *,
        samples: Callable[[list[bytes], float], None],
        told: Callable[[Message], None],
        lost: Callable[[DeviceError], None],
        paused: Callable[[], bool] = lambda: False,
        answer_s: float = 0.3,
    ) -> None:
        self._port, self._samples, self._told, self._lost = port, samples, told, lost
        self._answer_s, self._paused = answer_s, paused
        self._id = 0
        self.resent = self.odd = 0
        self.failure: DeviceError | None = None
        self._other: DeviceError | None = None
        self._waiting: dict[int, _Waiting] = {}
        self._news = threading.Condition()
        self._asking = threading.Lock()
        self._writing = threading.Lock()
        self._due = threading.Condition()
        self._unpinged, self._per_ping = 0, 0
        self._closing = False
        self._heard_s = time.monotonic()
        self._decoder, self.reader = FrameDecoder(), Reader(port)
        self.counters = self._decoder.counters
        self._sample = table().messages["sample"].code
        self._listener = threading.Thread(target=self._listen, name=f"listen {port.name}", daemon=True)
        self._listener.start()
        self._pinger = threading.Thread(target=self._keep_alive, name=f"ping {port.name}", daemon=True)
        self._pinger.start()

    @property
    def asking(self) -> bool:
        """Whether an answer is waited for."""
        return bool(self._waiting)

    def identify(self) -> Message:
        """Ask who is there; return ``identity``."""
        try:
            return self.ask("identify")
        except DeviceError:
            if self._other is not None:
                raise self._other from None
            if self.failure is not None:
                raise
            raise DeviceError(self._nobody()) from None

    def ask(self, name: str, fields: Mapping[str, int] = _NONE, *, values: tuple[int, ...] = ()) -> Message:
        """Send a command, its fields but ``id``, and return its answer: ``ack``, or the command's own. `values`:
        elements of a last field that is an array.
        """
        with self._asking:
            number = self._next_id()
            command = message(name, values=values, id=number, **fields)
            data, waiting = encode(command), _Waiting(name)
            self._waiting[number] = waiting
            try:
                answer = self._answered(data, waiting)
            finally:
                del self._waiting[number]
        if answer is None:
            if self.failure is not None:
                raise DeviceError(str(self.failure))
            raise DeviceError(
                f"{self._port.name}: the controller did not answer {name!r}, sent {_TRIES} times; each command is"
                f" answered. Look at cable and supply, and open the port again; {_LOST}"
            )
        if answer.name == "ack" and answer["code"]:
            raise DeviceError(f"{self._port.name}: {refusal(command, answer)}")
        return answer

    def pace(self, rate_hz: float) -> None:
        """Begin with pings, and count samples of `rate_hz` as the time between them."""
        with self._due:
            self._per_ping = max(1, int(_PING_SAMPLES_S * rate_hz))
            self._due.notify_all()

    def close(self) -> None:
        """End all threads and let the port go; again is harmless."""
        with self._due:
            self._closing = True
            self._due.notify_all()
        if self._pinger is not threading.current_thread():
            self._pinger.join(_PATIENCE_S)
        self.reader.close()
        if self._listener is not threading.current_thread():
            self._listener.join(_PATIENCE_S)
        self._port.close()

    def _next_id(self) -> int:
        self._id = self._id % _LAST_ID + 1
        return self._id

    def _answered(self, data: bytes, waiting: _Waiting) -> Message | None:
        limit = self._answer_s * _SLOW.get(waiting.name, 1.0)
        for attempt in range(_TRIES):
            if attempt:
                self.resent += 1
            self._send(data)
            with self._news:
                self._news.wait_for(lambda: waiting.answer or self._over(waiting), limit)
                if waiting.answer or self._over(waiting):
                    return waiting.answer
        return None

    def _over(self, waiting: _Waiting) -> bool:
        """Whether no answer will come: the line is lost, or what was to be identified is something else."""
        return self.failure is not None or (waiting.name == "identify" and self._other is not None)

    def _send(self, data: bytes) -> None:
        if self.failure is not None:
            return
        try:
            with self._writing:
                self._port.write(data)
        except OSError as failure:
            self._line_lost(failure)

    def _keep_alive(self) -> None:
        with self._due:  # whoever is not known yet is not talked at
            self._due.wait_for(lambda: self._per_ping or self._closing or self.failure is not None)
        due = time.monotonic() + _PING_S
        while True:
            with self._due:
                self._due.wait_for(self._ping_is_due, max(0.0, due - time.monotonic()))
                if self._closing or self.failure is not None:
                    return
                self._unpinged = 0
                silent = time.monotonic() - self._heard_s > _SILENT_S
            # A controller that was reset still answers pings: only its status tells.
            if not self._paused():
                self._send(encode(message("ask_status" if silent else "ping", id=_PING_ID)))
            due = time.monotonic() + _PING_S

    def _ping_is_due(self) -> bool:
        enough = 0 < self._per_ping <= self._unpinged
        return enough or self._closing or self.failure is not None

    def _listen(self) -> None:
        try:
            while not self.reader.over:
                for chunk in self.reader.take(_LOOK_S):
                    self._take(self._decoder.feed(chunk.data), chunk.arrived_s)
            failure = self.reader.failure
        except Exception as defect:  # nobody hears the controller any more: it must not be pinged on
            failure = OSError(f"a defect of ambid, {type(defect).__name__}: {defect}")
        if failure is not None:
            self._line_lost(failure)

    def _take(self, payloads: list[bytes], arrived_s: float) -> None:
        for sampled, together in groupby(payloads, lambda payload: payload[0] == self._sample):
            if sampled:
                self._heard_samples(list(together), arrived_s)
                continue
            for payload in together:
                try:
                    what = unpack(payload)
                except DeviceError as failure:
                    self._odd(failure)
                else:
                    self._heard(what)

    def _heard_samples(self, payloads: list[bytes], arrived_s: float) -> None:
        with self._due:
            self._heard_s = time.monotonic()
            self._unpinged += len(payloads)
            if self._per_ping and self._unpinged >= self._per_ping:
                self._due.notify_all()
        self._samples(payloads, arrived_s)

    def _heard(self, what: Message) -> None:
        waiting = self._waiting.get(what.fields.get("id", 0))
        if what.name in ("status", "fault", "law_status"):
            self._told(what)
        if waiting is not None and what.name in ("ack", _ANSWERS.get(waiting.name, "ack")):
            with self._news:
                waiting.answer = what
                self._news.notify_all()

    def _odd(self, failure: DeviceError) -> None:
        """A sound frame that is no message of this protocol: the identity of another version."""
        with self._news:
            self.odd += 1
            self._other = self._other or DeviceError(f"{self._port.name}: {failure}")
            self._news.notify_all()

    def _line_lost(self, failure: OSError) -> None:
        with self._news:
            if self.failure is not None or self._closing:
                return
            self.failure = DeviceError(
                str(failure)
                if isinstance(failure, PortEnded)
                else f"port {self._port.name} was lost ({failure}); {_LOST}. Plug the cable in again and open the port"
                " again"
            )
            self._news.notify_all()
        with self._due:
            self._due.notify_all()
        self._lost(self.failure)

    def _nobody(self) -> str:
        """Say what may stand behind a port that gives no identity."""
        counters, name = self.counters, self._port.name
        if counters.frames:
            return (
                f"port {name}: sound frames come, but no answer to 'identify'; the controller does not hear the host."
                " Check its receive line, and reset the board"
            )
        if counters.discarded_bytes or counters.empty or counters.damaged:
            total = counters.discarded_bytes + counters.empty
            return (
                f"port {name}: {total} bytes came, and no sound frame among them; this is another speed or another"
                " program. Give the firmware's baud (daq.baud), or put the firmware amb_daq on the board"
            )
        return (
            f"port {name}: no answer to 'identify'. Check cable and supply, reset the board, or load the firmware"
            " amb_daq"
        )


_REMEDY = {
    "unknown": "Put the firmware of this ambid on the board",
    "length": "Put the firmware of this ambid on the board",
    "range": "Correct the rig",
    "state": "Stop it first, or clear its fault",
    "unready": "Give the rig a loop with gains, and open the device again",
    "interlock": "Close the interlock loop (emergency stop, cable), then try again",
}


def refusal(command: Message, answer: Message) -> str:
    """Return in one line what was refused, why, and what to do; `answer`: an ``ack`` with a code that is not 0."""
    protocol = table()
    code = protocol.name("code", answer["code"])
    about = next((e.about for e in protocol.enums["code"] if e.value == answer["code"]), "an unknown code")
    return (
        f"the controller refuses {command.name!r}: {_why(command, code, answer['detail'], about)}."
        f" {_REMEDY.get(code, 'Put the firmware of this ambid on the board')}"
    )


def _why(command: Message, code: str, detail: int, about: str) -> str:
    protocol = table()
    if code == "range" and command.name == "start":
        return (
            f"mode {protocol.name('mode', command['mode'])!r} does not go with what it was told: with the output on, a"
            " tick is neither very short nor very long (daq.rate_hz), and set point and bias are within the limits"
        )
    if code == "range":
        fields = protocol.messages[command.name].fields
        if 1 <= detail <= len(fields):
            field = fields[detail - 1]
            value = command.fields.get(field.name, command.values)
            return f"{field.name} = {value} is outside what it allows ({field.about})"
        return f"a value is outside what it allows (field {detail})"
    if code == "state":
        return f"not in state {protocol.name('state', detail)}"
    if code == "unready":
        there = protocol.names_of_bits("ready", detail)
        missing = [e.name for e in protocol.bits["ready"] if e.name not in there]
        return f"it has not been given {', '.join(missing)} yet"
    return about
