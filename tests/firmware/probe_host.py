"""The host's end of the probe: bytes on the pseudo-terminal, with limits that only end a hang."""

import os
import select
import time

LIMIT_S = 60.0


class Line:
    """An open port."""

    def __init__(self, port):
        self._file = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

    def __enter__(self):
        return self

    def __exit__(self, *what):
        self.close()

    def close(self):
        if self._file is not None:
            os.close(self._file)
        self._file = None

    def write(self, data):
        last = time.monotonic() + LIMIT_S
        while data:
            assert time.monotonic() < last, "the bench takes no more bytes"
            if select.select([], [self._file], [], 1.0)[1]:
                data = data[os.write(self._file, data) :]

    def read(self, n):
        """Exactly n bytes."""
        found, last = b"", time.monotonic() + LIMIT_S
        while len(found) < n:
            assert time.monotonic() < last, f"only {len(found)} of {n} bytes came: {found[-20:]!r}"
            if select.select([self._file], [], [], 1.0)[0]:
                found += os.read(self._file, n - len(found))
        return found

    def read_until_quiet(self, quiet_s=1.0):
        found = b""
        while select.select([self._file], [], [], quiet_s)[0]:
            found += os.read(self._file, 65536)
        return found

    def ask(self, data, n):
        self.write(data)
        return self.read(n)

    def greet(self):
        """Wait until the probe answers; its boot letter comes only if the port was open by then."""
        if self.ask(b"xQ", 1) != b"Q":
            assert self.read(1) == b"Q"

    @staticmethod
    def wait_for(what):
        """Wait without a word until `what()` holds."""
        limit = time.monotonic() + LIMIT_S
        while not what():
            assert time.monotonic() < limit, "it does not come to pass"
            time.sleep(0.01)

    def ticks(self):
        return int.from_bytes(self.ask(b"t", 4), "little")

    def compare(self, value):
        """Set OCR1A."""
        assert self.ask(b"b" + value.to_bytes(2, "little"), 1) == b"b"

    def connect(self, mode, level=0):
        """Set COM1A and the port bit."""
        assert self.ask(bytes([ord("c"), mode | level << 2]), 1) == b"c"

    def enable(self, on):
        assert self.ask(bytes([ord("e"), on]), 1) == b"e"

    def wait_ticks(self, n):
        last, limit = self.ticks() + n, time.monotonic() + LIMIT_S
        while self.ticks() < last:
            assert time.monotonic() < limit, "emulated time stands still"
