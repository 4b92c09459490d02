"""What every device promises, held against all four: hardware's driver, the emulated controller, simulation, replay."""

import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ambid.acquisition.device import Program
from ambid.acquisition.devices.emulated import EmulatedDevice
from ambid.acquisition.devices.line_device import SerialDevice
from ambid.acquisition.devices.played import ReplayDevice
from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.errors import DeviceError
from ambid.record import Channel, Record, write_record
from ambid.rig import load_rig
from tests.acquisition.fake import FakeController, PtyBoard

PROTOTYPE = load_rig(Path(__file__).parents[2] / "src" / "ambid" / "data" / "prototype.toml")
# Without feedback the rotor lies on its stop, at 1 mm; that shall not be out of its gap where driving is tried.
DRIVEN = replace(PROTOTYPE, daq=replace(PROTOTYPE.daq, position_trip=(-1.2e-3, 1.2e-3)))
HANG_S = 60.0  # only ends a hang
SQUARE = Program(kind="step", amplitude=0.6, hold=8, length=2)  # 20 counts
TOO_MUCH = Program(kind="step", amplitude=10.8, hold=2000, length=2)  # no loop holds that


class Serial:
    """The driver of hardware, on a pseudo-terminal with a controller in Python at its other end."""

    modes = ("sample", "drive", "levitate")

    def __init__(self, request, tmp_path):
        self.controller = FakeController()
        self.board = PtyBoard(self.controller)
        self.board.__enter__()
        request.addfinalizer(self.board.pull)

    def make(self, rig=PROTOTYPE):
        return SerialDevice(self.board.port, rig, answer_s=5.0)

    def fault(self, device):
        with self.board.lock:
            self.controller.fail("interlock")
        return "interlock"

    def output_off(self):
        return self.controller.state in ("idle", "fault")


class Emulated:
    """The firmware's binary in the emulator."""

    modes = ("sample", "drive", "levitate")

    def __init__(self, request, tmp_path):
        request.getfixturevalue("bench_program")
        request.getfixturevalue("firmware_elf")
        self.made = []

    def make(self, rig=PROTOTYPE):
        self.made.append(EmulatedDevice(rig))
        return self.made[-1]

    def fault(self, device):
        device.excite(TOO_MUCH)
        return "over_current|out_of_gap"

    def output_off(self):
        assert self.made[-1].emulator is None  # it has ended
        return True


class Simulated:
    """The bench in this process."""

    modes = ("sample", "drive", "levitate")

    def __init__(self, request, tmp_path):
        self.made = None

    def make(self, rig=PROTOTYPE):
        self.made = SimulatedDevice(rig)
        return self.made

    def fault(self, device):
        device.excite(TOO_MUCH)
        return "over_current|out_of_gap"

    def output_off(self):
        return self.made.state in ("idle", "fault")


class Replayed:
    """A record."""

    modes = ("sample",)

    def __init__(self, request, tmp_path):
        self.path = tmp_path / "record.csv"
        n = np.arange(60_000)
        columns = {c.column: n % 700 + k for k, c in enumerate(PROTOTYPE.channels)}
        channels = tuple(Channel(name=k, unit="1", values=v.astype(float)) for k, v in columns.items())
        write_record(Record(rate_hz=2000.0, channels=channels), self.path)

    def make(self, rig=PROTOTYPE):
        return ReplayDevice(self.path, rig, pace="fastest")

    def output_off(self):
        return True


@pytest.fixture(params=[Serial, Emulated, Simulated, Replayed], ids=lambda c: c.__name__.lower())
def bench(request, tmp_path):
    return request.param(request, tmp_path)


def samples(device, n):
    """Read until n samples are there; returns the blocks."""
    found, end = [], time.monotonic() + HANG_S
    while sum(len(f.block.values) for f in found) < n:
        frame = device.read(1.0)
        assert time.monotonic() < end, f"{device.state} {device.counters()} {device.events()}"
        found += [] if frame is None else [frame]
        assert frame is not None or not device.ended, f"{device.state} {device.events()}"
    return found


def drained(device):
    found, end = [], time.monotonic() + HANG_S
    while not device.ended:
        frame = device.read(1.0)
        found += [] if frame is None else [frame]
        assert time.monotonic() < end
    return found


def refused(call, *arguments):
    with pytest.raises(DeviceError) as caught:
        call(*arguments)
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) > 30
    return text


def test_it_says_who_it_is(bench):
    with bench.make() as device:
        info = device.info
        assert info.kind == type(bench).__name__.lower().replace("replayed", "replay")
        assert info.port
        assert info.rate_hz == 2000.0
        roles = [c.role for c in info.columns]
        assert {"voltage", "current", "position"} <= set(roles)
        assert len({c.name for c in info.columns}) == len(roles)
        assert {c.role: c.name for c in info.columns}["voltage"] == "duty"
        assert all(c.unit == "1" for c in info.columns)
        if info.kind in ("serial", "emulated"):
            assert info.identity["protocol"] == 1
        assert device.state == "idle"
        test = device.self_test()
        assert test.failed == ()
        assert test.numbers


def test_blocks_follow_on_each_other_and_are_counted(bench):
    with bench.make() as device:
        device.start(bench.modes[-1])
        assert device.state == {"sample": "sampling", "levitate": "levitating"}[bench.modes[-1]]
        found = samples(device, 3000)
        device.stop()
        found += drained(device)
        assert found[0].block.first == 0
        for a, b in pairwise(found):
            assert b.block.first == a.block.first + len(a.block.values)
            assert b.arrived_s >= a.arrived_s - 1e-9
        for f in found:
            assert f.block.values.shape[1] == len(device.info.columns)
            assert f.block.values.dtype == np.float64
            assert f.block.time_s == pytest.approx(f.block.first / 2000.0, abs=1e-9)
        c = device.counters()
        assert c.samples == sum(len(f.block.values) for f in found)
        assert (c.lost, c.damaged, c.discarded_bytes, c.overruns) == (0, 0, 0, 0)
        assert device.state == "idle"
        assert device.ended
        assert device.read(0.0) is None
        assert [e.what for e in device.events() if e.kind != "state"] == []


def test_started_again_it_counts_on(bench):
    with bench.make() as device:
        after = 0
        for _ in range(3):
            device.start("sample")
            found = samples(device, 200)
            device.stop()
            found += drained(device)
            assert found[0].block.first == after
            after = found[-1].block.first + len(found[-1].block.values)
        assert device.counters().lost == 0
        assert device.counters().samples == after


def test_modes_that_it_cannot_have_are_refused(bench):
    with bench.make() as device:
        refused(device.start, "fly")
        refused(device.excite, SQUARE)  # idle
        refused(device.clear)
        if "levitate" not in bench.modes:
            assert "record" in refused(device.start, "levitate")
            assert "record" in refused(device.start, "drive")
        device.start("sample")
        refused(device.start, "sample")
        refused(device.self_test)
        refused(device.excite, SQUARE)
        assert samples(device, 100)  # a refusal changes nothing
        device.stop()
        device.excite(None)  # nothing is ended


def test_from_sampling_to_driving_ticks_count_on(bench):
    if "drive" not in bench.modes:
        return  # that it is refused there is tested above
    with bench.make(DRIVEN) as device:
        device.start("sample")
        found = samples(device, 100)
        device.start("drive")
        assert device.state == "driving"
        found += samples(device, 100)
        for a, b in pairwise(found):
            assert b.block.first == a.block.first + len(a.block.values)


def test_an_excitation_shows_in_its_column_and_in_the_duty(bench):
    if "drive" not in bench.modes:
        return  # that it is refused there is tested above
    with bench.make(DRIVEN) as device:
        names = [c.role for c in device.info.columns]
        device.start("drive")
        samples(device, 100)
        device.excite(SQUARE)
        seen = np.concatenate([f.block.values for f in samples(device, 400)])
        excitation, duty = seen[:, names.index("excitation")], seen[:, names.index("voltage")]
        played = np.abs(excitation) > 0
        assert played.any()
        assert set(np.abs(excitation[played])) == {20.0}
        bias = 400.0
        np.testing.assert_array_equal(duty[played], bias + excitation[played])
        device.excite(SQUARE)  # another one takes its place
        device.excite(None)
        while True:
            last = samples(device, 1)[-1].block.values
            if (last[:, names.index("excitation")] == 0).all():
                break
        assert (last[:, names.index("voltage")] == bias).all()


def test_a_fault_is_told_stays_and_is_cleared(bench):
    if "drive" not in bench.modes:
        return  # that it is refused there is tested above
    with bench.make() as device:
        device.start("levitate")
        samples(device, 1000)
        device.events()
        cause, end, faults = bench.fault(device), time.monotonic() + HANG_S, []
        while not faults:
            device.read(0.2)
            faults = [e for e in device.events() if e.kind == "fault"]
            assert time.monotonic() < end
        assert len(faults) == 1
        assert faults[0].what in cause.split("|")
        assert faults[0].sample >= 1000
        assert device.state == "fault"
        assert samples(device, 100)  # frames flow on
        refused(device.start, "levitate")
        refused(device.excite, SQUARE)
        device.stop()
        drained(device)
        assert device.state == "fault"  # only clear leaves it
        device.clear()
        assert device.state == "idle"
        device.start("sample")
        assert samples(device, 100)
        assert [e for e in device.events() if e.kind == "fault"] == []


def test_stop_from_another_thread_ends_a_read(bench):
    with bench.make() as device:
        device.start("sample")
        stopper = threading.Timer(0.2, device.stop)
        stopper.start()
        drained(device)
        stopper.join(HANG_S)
        assert device.ended
        assert device.read(0.0) is None
        assert device.state == "idle"


def test_an_exception_inside_leaves_the_safe_state_and_nothing_behind(bench):
    before = set(threading.enumerate())
    device = bench.make()
    with pytest.raises(ZeroDivisionError), device:  # noqa: PT012 - what happens inside is the matter
        device.start(bench.modes[-1])
        samples(device, 50)
        raise ZeroDivisionError
    assert bench.output_off()
    assert set(threading.enumerate()) <= before | {getattr(getattr(bench, "board", None), "thread", None)}
    refused(device.start, "sample")
    refused(device.self_test)


def test_closing_twice_and_stopping_when_idle_are_harmless(bench):
    device = bench.make()
    with device:
        device.stop()
        device.stop()
        refused(device.__enter__)
    device.__exit__(None, None, None)
    assert device.counters().lost == 0
    with device:  # and it can be opened again
        device.start("sample")
        assert samples(device, 10)


def test_before_it_is_open_it_answers_with_an_error(bench):
    device = bench.make()
    for call, arguments in ((device.start, ("sample",)), (device.read, (0.0,)), (device.self_test, ())):
        assert "open" in refused(call, *arguments)
