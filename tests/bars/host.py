"""A host of one thread on the emulated bench: it keeps what comes in the order of the line, and sends what a test says.

The product's own driver never does what a bar asks for: fall silent, send damage, listen on in the safe state.
"""

import os
import struct
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import ambid
from ambid.acquisition.devices.benches import plant_text
from ambid.acquisition.devices.controller import open_port
from ambid.acquisition.devices.emulated import Emulator
from ambid.acquisition.protocol import table
from ambid.acquisition.protocol.codec import FrameDecoder, encode, message, unpack
from ambid.acquisition.settings import controller_settings
from ambid.rig import load_rig

DATA = Path(ambid.__file__).parent / "data"
PING_SAMPLES = 50  # 25 ms at 2 kHz
PING_S = 0.05  # of the wall clock, where no samples come
HANG_S = 60.0  # only ends a hang
ANSWER_S = 0.6  # of processor time: some 2 s of the controller's, however busy the machine is
STILL_S = 15.0  # where it stands still: without pings its time does
BOOT_S = 0.03  # of processor time: some 0.1 s of the controller's
_SAMPLE = table().messages["sample"].code
_HEAD = struct.Struct("<BHB")
_LEVITATE = table().value("mode", "levitate")


def prototype():
    """Return the rig of the preset."""
    return load_rig(DATA / "prototype.toml")


def _worked_s(pid):
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11]) / os.sysconf("SC_CLK_TCK")


def _let_it_boot(pid):
    """Bytes that come before the firmware listens are lost on hardware: give it its time, measured by its own work."""
    end = time.monotonic() + HANG_S
    while time.monotonic() < end:
        if _worked_s(pid) >= BOOT_S:
            return
        time.sleep(0.005)


class Refused(Exception):
    """The controller does not do what it was told."""


@dataclass
class Heard:
    """What came since ticks count from 0."""

    ticks: list = field(default_factory=list)
    states: list = field(default_factory=list)
    causes: list = field(default_factory=list)
    values: list = field(default_factory=list)
    lost: int = 0


class Host:
    """Emulator and line. A context.

    Rig, script, seed and folder as `Emulator` has them; ``third``: third input in V/m, V/A and V.
    """

    def __init__(self, rig, folder, *, script=None, seed=0, trajectory=False, third=(0.0, 0.0, 2.5)):
        self.rig, self.settings = rig, controller_settings(rig)
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        wires = zip(("third_position_gain", "third_current_gain", "third_offset"), third, strict=True)
        plant = [line for line in plant_text(rig).splitlines() if not line.startswith("third")]
        plant += [f"{name} {value!r}" for name, value in wires]
        self.bench = Emulator("\n".join(plant), script=script, seed=seed, folder=folder, trajectory=trajectory)
        self.heard, self.answers, self.told = Heard(), {}, deque()
        self.pings, self.ping_by_clock = True, True
        self.acked_at = None  # samples that had come when the last answer to a ping did
        self.unanswered = set()
        self.resent = self.pinged_at = self.number = 0
        self.clock = time.monotonic()

    def __enter__(self):
        self.bench.start()
        try:
            self.port = open_port(self.bench.port, baud=table().baud, boot_s=0.0)
            _let_it_boot(self.bench.pid)
        except BaseException:
            self.bench.close(keep=True)
            raise
        self.decoder = FrameDecoder("host")
        return self

    def __exit__(self, *_):
        self.port.close()
        self.bench.close(keep=True)

    # ---- what goes -------------------------------------------------------------------------------------------------

    def next_number(self):
        self.number = self.number % 255 + 1
        return self.number

    def ping(self):
        number = self.next_number()
        self.unanswered.add(number)
        self.port.write(encode(message("ping", id=number)))
        self.pinged_at, self.clock = len(self.heard.ticks), time.monotonic()

    def ask(self, name, *, values=(), expect=0, **fields):
        """Send a command, and again where no answer comes; return the answer."""
        number = self.next_number()
        self.answers.pop(number, None)
        self.unanswered.discard(number)  # a ping of long ago that never arrived
        data = encode(message(name, values=values, id=number, **fields))
        end = time.monotonic() + HANG_S
        while time.monotonic() < end:
            self.port.write(data)
            worked = written = _worked_s(self.bench.pid)
            still = time.monotonic() + STILL_S
            while worked < written + ANSWER_S and time.monotonic() < still:
                worked = _worked_s(self.bench.pid)  # before reading: what it has answered by then is read
                self.pump()
                if number in self.answers:
                    answer = self.answers.pop(number)
                    if expect is not None and answer.name == "ack" and answer["code"] != expect:
                        raise Refused(f"{name}: {table().name('code', answer['code'])}, {answer['detail']}")
                    return answer
            self.resent += 1
        raise AssertionError(f"no answer to {name}: {self.bench.said()}")

    def prepare(self, *, stream=None, period=None):
        """Identify, and tell the settings of the rig."""
        self.ask("identify")
        wanted = self.settings.fields("configure") | ({} if stream is None else {"stream": stream})
        self.stream = wanted["stream"]
        self.ask("configure", **(wanted | ({} if period is None else {"period": period})))
        self.ask("limits", **self.settings.fields("limits"))
        self.ask("gains", **self.settings.fields("gains"))
        law = self.settings.law
        if law is not None:
            for at in range(0, len(law.words), 24):
                self.ask("law", offset=at, values=law.words[at : at + 24])
            one = {"period": self.settings.period, "checksum": law.checksum}
            self.ask("arm", **one, position_low=0, position_high=0, confirm_ms=0)

    def start(self, mode=_LEVITATE):
        self.heard = Heard()
        self.acked_at, self.pinged_at = None, 0
        self.ask("start", mode=mode)

    # ---- what comes ------------------------------------------------------------------------------------------------

    def pump(self):
        """Take what has come, and give a sign of life where one is due."""
        for payload in self.decoder.feed(self._read()):
            if payload[0] == _SAMPLE:
                self._keep(payload)
            else:
                self._told(unpack(payload))
        due = len(self.heard.ticks) - self.pinged_at >= PING_SAMPLES
        late = self.ping_by_clock and time.monotonic() - self.clock > PING_S
        if self.pings and (due or late):
            self.ping()

    def _read(self):
        try:
            return self.port.read()
        except OSError as lost:
            process, last = self.bench._process, self.bench.events()[-3:]
            code = process.wait(HANG_S) if process else None
            raise AssertionError(f"the bench ended with {code}: {self.bench.said()!r}, {last}") from lost

    def _keep(self, payload):
        _, tick, state = _HEAD.unpack_from(payload)
        heard = self.heard
        last = heard.ticks[-1] if heard.ticks else -1
        step = (tick - last) % 65536
        heard.lost += step - 1
        heard.ticks.append(last + step)
        heard.states.append(state & 15)
        heard.causes.append(state >> 4)
        heard.values.append(payload[_HEAD.size :])

    def _told(self, what):
        number = what.fields.get("id", 0)
        if number in self.unanswered:
            self.unanswered.discard(number)
            if self.state != "fault":
                self.acked_at = len(self.heard.ticks)
        elif number:
            self.answers[number] = what
        self.told.append(what)

    def until(self, ready):
        """Listen until it is so."""
        end = time.monotonic() + HANG_S
        while not ready():
            assert time.monotonic() < end, (self.state, self.bench.events()[-3:], self.bench.said())
            self.pump()

    def samples(self, n):
        """Listen until there are n samples more."""
        wanted = len(self.heard.ticks) + n
        self.until(lambda: len(self.heard.ticks) >= wanted)

    @property
    def state(self):
        return table().name("state", self.heard.states[-1]) if self.heard.states else "idle"

    def values(self):
        """Return what samples carry, one row each."""
        return np.frombuffer(b"".join(self.heard.values), "<u2").reshape(len(self.heard.ticks), -1).astype(int)

    def column(self, name):
        """Return one of them by its name in the table of messages."""
        carried = [c.name for c in table().stream if self.stream >> c.bit & 1]
        return self.values()[:, carried.index(name)]


def trajectory(folder):
    """Read the bench's true motion: columns t, x, v, i, voltage, duty."""
    return np.loadtxt(Path(folder) / "trajectory.csv", delimiter=",", skiprows=1)


def tick_times(rows, rise_s):
    """Return when each tick's first conversion began, tick 0 first: the last one before ENABLE rises is tick 0."""
    t = rows[:, 0]
    return t[np.flatnonzero(t < rise_s)[-1] :]
