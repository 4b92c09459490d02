"""A controller in Python that speaks the protocol, for tests of the host: all can go wrong with it, on purpose."""

import os
import pty
import threading
import time
import tty
from contextlib import suppress

from ambid.acquisition.protocol import table
from ambid.acquisition.protocol.codec import FrameDecoder, encode, frame, message, unpack

STATE = {e.name: e.value for e in table().enums["state"]}
CAUSE = {e.name: e.value for e in table().enums["cause"]}
CODE = {e.name: e.value for e in table().enums["code"]}
MODE = {"sample": "sampling", "drive": "driving", "levitate": "levitating"}
IDENTITY = {"major": 1, "minor": 0, "board": 1, "adc_bits": 10, "analog": 3, "pwm_top": 800, "pwm_hz": 20_000}
IDENTITY |= {"table": 1000, "shortest": 4, "digest": 7}


class FakeController:
    """Commands in, frames out. A tick moves nothing: position 512, current 512, pulse width bias plus excitation."""

    def __init__(self, version=None):
        self.version = version or table().version
        self.decoder = FrameDecoder("controller")
        self.out = bytearray()
        self.state, self.cause, self.sampling = "idle", "none", False
        self.ticks = self.fault_tick = self.carried_out = self.pings = 0
        self.last = None
        self.settings, self.commands, self.tables = {}, [], {}
        self.playing = False
        self.deaf = False
        self.mute = 0  # answers that are swallowed
        self.refuse = {}  # name -> (code, detail)
        self.interlock_open = False
        self.skip, self.damage = set(), set()  # ticks whose frame is left out, or damaged
        self.clear_refused = False

    def hear(self, data):
        if self.deaf:
            return
        for payload in self.decoder.feed(data):
            self.command(unpack(payload, "controller"), payload)

    def command(self, asked, payload):
        self.commands.append(asked.name)
        self.pings += asked.name in ("ping", "ask_status")
        answer = self.last[1] if self.last and self.last[0] == payload[:2] else self.answer(asked)
        if asked.name == "identify":
            self.last = None
        elif asked.name not in ("ping", "ask_status"):
            self.last = (payload[:2], answer)
        if self.mute and asked.name != "ping":
            self.mute -= 1
        else:
            self.out += answer

    def answer(self, asked):
        number = asked["id"]
        if asked.name == "identify":
            data = bytearray(encode(message("identity", id=number, protocol=table().version, **IDENTITY)))
            return bytes(data) if self.version == table().version else self.other_identity(number)
        if asked.name == "ask_status":
            return self.status(number)
        if asked.name == "self_test" and self.state == "idle":
            numbers = {"failed": 0, "supply_mv": 5000, "free_bytes": 300, "position": 512, "current": 512}
            return encode(message("self_test_result", id=number, **numbers))
        code, detail = self.refuse.get(asked.name) or self.carry_out(asked)
        return encode(message("ack", id=number, code=CODE[code], detail=detail))

    def other_identity(self, number):
        return frame(bytes((table().messages["identity"].code, number, self.version, 9, 9)))

    def carry_out(self, asked):
        self.carried_out += asked.name not in ("ping",)
        not_now = ("state", STATE[self.state])
        if asked.name in ("configure", "limits", "gains", "self_test"):
            if self.state != "idle":
                return not_now
            self.settings |= {k: v for k, v in asked.fields.items() if k != "id"}
        elif asked.name == "start":
            name = next(e.name for e in table().enums["mode"] if e.value == asked["mode"])
            if self.state not in ("idle", "sampling") or (name == "sample" and self.state != "idle"):
                return not_now
            if self.interlock_open and name != "sample":
                return "interlock", 0
            if self.state == "idle":
                self.ticks = 0
            self.state, self.sampling = MODE[name], True
        elif asked.name == "stop":
            self.sampling = self.playing = False
            self.state = "fault" if self.state == "fault" else "idle"
        elif asked.name == "clear":
            if self.state != "fault":
                return not_now
            if self.clear_refused:
                return "state", STATE["fault"]
            self.state, self.cause, self.sampling = "idle", "none", False
        elif asked.name == "excitation":
            if self.playing:
                return not_now
            self.settings |= {k: v for k, v in asked.fields.items() if k != "id"}
        elif asked.name == "table":
            self.tables |= {asked["offset"] + k: v for k, v in enumerate(asked.values)}
        elif asked.name == "excite":
            if self.state not in ("driving", "levitating"):
                return not_now
            self.playing = bool(asked["on"])
        return "done", 0

    def status(self, number=0):
        rest = {"overruns": 0, "dropped": 0, "rx_errors": 0, "rx_lost": 0, "busy_us": 200, "supply_mv": 5000}
        return encode(
            message(
                "status",
                id=number,
                state=STATE[self.state],
                cause=CAUSE[self.cause],
                ticks=self.ticks,
                fault_tick=self.fault_tick,
                **rest,
            )
        )

    def fail(self, cause, tell=True):
        self.state, self.cause, self.fault_tick, self.playing = "fault", cause, self.ticks, False
        if tell:
            self.out += encode(message("fault", cause=CAUSE[cause], tick=self.ticks, position=512, current=900))

    def reset(self):
        """As if its supply had dipped."""
        self.state, self.sampling, self.ticks, self.last = "idle", False, 0, None

    def tick(self, n=1):
        for _ in range(n if self.sampling else 0):
            on = self.state in ("driving", "levitating")
            excitation = self.settings.get("amplitude", 0) if self.playing else 0
            duty = self.settings["duty_bias"] + excitation if on else self.settings["duty_off"]
            carried = [512, 512, 0, duty, excitation & 0xFFFF, self.settings["setpoint"]]
            values = [v for bit, v in enumerate(carried) if self.settings["stream"] >> bit & 1]
            nibble = CAUSE[self.cause] << 4 if self.state == "fault" else 0
            data = bytearray(
                encode(message("sample", tick=self.ticks % 65536, state=STATE[self.state] | nibble, values=values))
            )
            if self.ticks in self.damage:
                data[3] ^= 0x55 if data[3] not in (0, 0x55) else 0x11
            if self.ticks not in self.skip:
                self.out += data
            self.ticks += 1
            if self.ticks % 256 == 0:
                self.out += self.status()

    def take(self):
        data, self.out = bytes(self.out), bytearray()
        return data


class PipePort:
    """A port without a system behind it: each read lets some ticks pass."""

    def __init__(self, controller, ticks=20):
        self.controller, self.ticks, self.name = controller, ticks, "a pipe"
        self.lock = threading.Lock()
        self.lost = self.closed = False
        self.before = b""  # what the line says first

    def read(self):
        time.sleep(0.001)
        with self.lock:
            if self.lost:
                raise OSError(5, "Input/output error")
            self.controller.tick(self.ticks)
            data, self.before = self.before + self.controller.take(), b""
            return data

    def write(self, data):
        with self.lock:
            if self.lost:
                raise OSError(5, "Input/output error")
            self.controller.hear(data)

    def close(self):
        self.closed = True


class PtyBoard:
    """The controller behind a pseudo-terminal, as an ordinary serial port."""

    def __init__(self, controller, ticks=20):
        self.controller, self.ticks = controller, ticks
        self.lock = threading.Lock()
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.port = os.ttyname(self.slave)
        self.stopping = False
        self.thread = threading.Thread(target=self.run, daemon=True)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.pull()

    def pull(self):
        """Pull the cable."""
        if not self.stopping:
            self.stopping = True
            self.thread.join(30)
            os.close(self.slave)
            os.close(self.master)

    def run(self):
        waiting = b""
        while not self.stopping:
            time.sleep(0.002)
            try:
                heard = os.read(self.master, 4096)
            except OSError:
                heard = b""
            with self.lock:
                self.controller.hear(heard)
                if len(waiting) < 4096:
                    self.controller.tick(self.ticks)
                waiting += self.controller.take()
            with suppress(OSError):
                waiting = waiting[os.write(self.master, waiting) :] if waiting else b""
