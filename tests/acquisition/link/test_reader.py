"""The reader never waits for whoever takes its bytes, and counts what it has no room for."""

import threading
import time

from ambid.acquisition.devices.controller import Reader

HANG_S = 60.0


class Flood:
    """A port that always has bytes, until it is told to fail."""

    name = "flood"

    def __init__(self, most):
        self.given, self.most, self.lost = 0, most, False

    def read(self):
        if self.lost:
            raise OSError(5, "gone")
        if self.given >= self.most:
            time.sleep(0.001)
            return b""
        self.given += 100
        return bytes(100)

    def write(self, data):
        raise AssertionError

    def close(self):
        pass


def until(true):
    end = time.monotonic() + HANG_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.001)


def test_nobody_takes_and_the_port_is_read_all_the_same():
    port = Flood(100_000)
    reader = Reader(port, room=5000)
    until(lambda: port.given == 100_000)
    until(lambda: reader.overrun_bytes == 95_000)
    assert reader.overruns == 950
    chunks = reader.take(HANG_S)
    assert sum(len(c.data) for c in chunks) == 5000
    port.most += 100
    later = reader.take(HANG_S)
    assert len(later[0].data) == 100
    assert reader.overrun_bytes == 95_000  # with room again nothing more is lost
    assert later[0].arrived_s >= chunks[-1].arrived_s
    reader.close()
    reader.close()
    assert not any(t.name == "read flood" for t in threading.enumerate())


def test_a_port_that_fails_in_its_own_way_is_lost_too():
    class Odd(Flood):
        def read(self):
            raise RuntimeError("odd")

    reader = Reader(Odd(0))
    until(lambda: reader.over)
    assert "RuntimeError: odd" in str(reader.failure)
    reader.close()


def test_what_came_before_the_loss_is_still_there():
    port = Flood(1000)
    reader = Reader(port)
    until(lambda: port.given == 1000)
    port.lost = True
    until(lambda: reader.failure is not None)
    assert not reader.over
    assert sum(len(c.data) for c in reader.take(HANG_S)) == 1000
    assert reader.over
    assert reader.take(0.0) == []
