"""The engine delivers everything, and ends cleanly however it ends."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.record import Channel, Record
from ambid.tracking.blocks import Block, blocks_of
from ambid.tracking.engine import run
from ambid.tracking.guard import StreamGuard
from tests.tracking.damage import RATE, blocks
from tests.tracking.damage import signal as noise

ROOT = Path(__file__).parents[3]
X = noise(3000)


def replay(values=X, size=100):
    channels = tuple(Channel(name=f"c{k}", unit="1", values=values[:, k].copy()) for k in range(values.shape[1]))
    return blocks_of(Record(rate_hz=RATE, channels=channels), size)


class Sink:
    """Keeps what it gets."""

    def __init__(self, at=None, do=lambda: None):
        self.stretches, self.rejections = [], []
        self.at, self.do = at, do

    def consume(self, stretch):
        if self.at is not None and stretch.first >= self.at:
            self.at = None
            self.do()
        self.stretches.append(stretch)

    def values(self):
        return np.vstack([s.values for s in self.stretches])


def engine(source, sink, **settings):
    settings = {"guard": StreamGuard(RATE, 3)} | settings
    return run(source, sink.consume, sink.rejections.append, **settings)


def raising(error):
    def do():
        raise error

    return do


def failing(n):
    yield from blocks(X)[:n]
    raise RecordError("the disk is gone")


def test_a_record_is_delivered_whole():
    sink = Sink()
    report = engine(replay(), sink)
    np.testing.assert_array_equal(sink.values(), X)
    assert (
        report.blocks,
        report.guard.n_received,
        report.guard.n_given,
        report.guard.n_rejected,
        report.guard.n_missing,
    ) == (30, 3000, 3000, 0, 0)
    assert (report.interrupted, dict(report.guard.events)) == (False, {})
    assert 0 < report.latency.median <= report.latency.p99 <= report.latency.largest <= report.seconds
    assert 0 < report.working_s < report.seconds


def test_damage_is_reported_whichever_way_it_comes():
    stream = blocks(X)
    stream[7] = Block(first=700, time_s=0.035, values=X[700:800].astype(np.float32))
    stream[9] = Block(first=900, time_s=0.045, values=X[900:1000, :2])
    del stream[20]
    sink = Sink()
    report = engine(stream, sink)
    assert dict(report.guard.samples) == {"type": 100, "shape": 100, "gap": 100}
    assert [(r.kind, r.samples) for r in sink.rejections] == [("type", 100), ("shape", 100), ("gap", 100)]
    assert (report.guard.n_given, report.guard.n_rejected, report.guard.n_missing) == (2700, 200, 100)
    np.testing.assert_array_equal(sink.values(), np.delete(X, np.r_[700:800, 900:1000, 2000:2100], axis=0))


def test_real_time_takes_its_time():
    sink = Sink()
    report = engine(replay(), sink, pace="real-time")
    assert report.seconds >= 3000 / RATE
    assert report.guard.n_given == 3000


def test_a_slow_consumer_is_late_and_loses_nothing():
    sink = Sink(at=0, do=lambda: time.sleep(0.2))
    report = engine(replay(), sink, pace="real-time")
    assert report.latency.largest > 0.1
    assert report.latency.late > 0
    assert report.latency.start is None  # it never caught up
    np.testing.assert_array_equal(sink.values(), X)


def test_an_exception_of_the_consumer_is_raised_and_nothing_is_left():
    with pytest.raises(ZeroDivisionError, match="on purpose"):
        engine(replay(), Sink(at=500, do=raising(ZeroDivisionError("on purpose"))))
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_exception_of_the_source_is_raised_as_it_is():
    sink = Sink()
    with pytest.raises(RecordError, match="the disk is gone"):
        engine(failing(5), sink)
    assert len(sink.stretches) == 5


def test_an_interrupt_ends_with_everything_up_to_then_delivered():
    def long():
        for k in range(0, 400_000, 100):
            yield Block(first=k, time_s=k / RATE, values=X[:100] + k)

    sink = Sink(at=5000, do=lambda: signal.raise_signal(signal.SIGINT))
    report = engine(long(), sink)
    assert report.interrupted
    assert report.guard.n_given == report.guard.n_received == len(sink.values()) >= 5100
    assert report.guard.n_given < 400_000
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_reaches_a_source_that_keeps_waiting():
    waited = []

    def stuck():
        yield from blocks(X)[:5]
        threading.Timer(0.05, signal.pthread_kill, [threading.main_thread().ident, signal.SIGINT]).start()
        time.sleep(20)
        waited.append(True)

    report = engine(stuck(), Sink())
    assert report.interrupted
    assert report.guard.n_given == 500
    assert not waited


def test_a_second_interrupt_reaches_the_consumer():
    def twice():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        engine(replay(), Sink(at=500, do=twice))
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_whoever_calls_may_end_it():
    sink = Sink()
    report = engine(replay(), sink, stopped=lambda: len(sink.stretches) >= 10)
    assert report.guard.n_given == 1000
    assert not report.interrupted


SCRIPT = """
import sys
import numpy as np
from ambid.record import Channel, Record
from ambid.tracking.engine import run
from ambid.tracking.guard import StreamGuard
from ambid.tracking.blocks import blocks_of

def consume(stretch):
    if stretch.first == 2000:
        print("ready", flush=True)

if __name__ == "__main__":
    x = np.random.default_rng(0).standard_normal(600_000)
    source = blocks_of(Record(rate_hz=20e3, channels=(Channel(name="a", unit="1", values=x),)), 100)
    report = run(source, consume, guard=StreamGuard(20e3, 1), pace="real-time")
    print(report.interrupted, report.guard.n_given == report.guard.n_received, report.guard.n_given, flush=True)
"""


def test_an_interrupt_from_the_terminal_ends_it_and_leaves_no_word(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, start_new_session=True,
    )  # fmt: skip
    assert process.stdout.readline().strip() == "ready"
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does it
    out, err = process.communicate(timeout=30)
    interrupted, whole, given = out.split()
    assert (interrupted, whole, err, process.returncode) == ("True", "True", "", 0)
    assert 2000 <= int(given) < 600_000
