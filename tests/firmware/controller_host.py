"""A small host for tests of the firmware on the emulated bench, with the product's codec."""

import itertools
import os
import select
import time
import tty

from ambid.acquisition.protocol.codec import FrameDecoder, encode, message, unpack
from tests.firmware.native.console import GAINS, LIMITS

LIMIT_S = 45.0  # of the wall clock; only ends a hang


class Host:
    """Talks to the controller on a port."""

    def __init__(self, port):
        self.fd = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.fd)
        self.decoder = FrameDecoder()
        self.told, self.samples = [], []
        self._number = 0

    def close(self):
        """Let go of the port."""
        os.close(self.fd)

    def hear(self, seconds=0.05):
        """Take what has come; False if nothing came in time."""
        if not select.select([self.fd], [], [], seconds)[0]:
            return False
        for body in self.decoder.feed(os.read(self.fd, 65536)):
            heard = unpack(body)
            (self.samples if heard.name == "sample" else self.told).append(heard)
        return True

    def send(self, name, **fields):
        """Send a command; returns its number."""
        self._number = self._number % 255 + 1
        os.write(self.fd, encode(message(name, id=self._number, **fields)))
        return self._number

    def ask(self, name, **fields):
        """Send a command and return its answer."""
        self.told = [t for t in self.told if t.name == "fault"]
        number = self.send(name, **fields)
        return self.wait(lambda: next((t for t in self.told if t.fields.get("id") == number), None), pings=False)

    def done(self, name, **fields):
        """Send a command that must be carried out."""
        answer = self.ask(name, **fields)
        assert answer["code"] == 0, (name, answer)

    def wait(self, seen, pings=True):
        """Hear, with pings, until `seen` says what it saw."""
        end = time.monotonic() + LIMIT_S
        mark = len(self.samples)
        while not (result := seen()):
            assert time.monotonic() < end, "the controller did not answer in time"
            # While nothing comes, emulated time waits for the host: a ping lets it go on.
            if (not self.hear() or len(self.samples) - mark >= 40) and pings:
                mark = len(self.samples)
                self.send("ping")
        return result

    def flow(self, n):
        """Take n more samples."""
        until = len(self.samples) + n
        self.wait(lambda: len(self.samples) >= until)

    def fault(self):
        """Wait for the message of a fault."""
        return self.wait(lambda: next((t for t in self.told if t.name == "fault"), None), pings=False)

    def lost(self):
        """Samples that are missing in what was heard."""
        ticks = [s["tick"] for s in self.samples]
        return sum((b - a) % 65536 - 1 for a, b in itertools.pairwise(ticks))

    def make_ready(self, *, period=10, stream=0x0F, limits=None, gains=None):
        """Give all that a start needs."""
        self.done("configure", period=period, stream=stream)
        self.done("limits", **(LIMITS | {"lift_ms": 300} | (limits or {})))
        self.done("gains", **(GAINS | (gains or {})))
