"""The driver of hardware when things go wrong on the line: all is told, counted, and what came can still be read."""

import threading
import time
from pathlib import Path

import pytest

from ambid.acquisition.devices.line_device import SerialDevice
from ambid.errors import DeviceError, RigError
from ambid.rig import default_rig, load_rig
from tests.acquisition.fake import FakeController, PtyBoard

PROTOTYPE = load_rig(Path(__file__).parents[3] / "src" / "ambid" / "data" / "prototype.toml")
HANG_S = 60.0


@pytest.fixture
def board():
    with PtyBoard(FakeController()) as made:
        yield made


def device_on(board, **options):
    options.setdefault("answer_s", 5.0)
    return SerialDevice(board.port, PROTOTYPE, **options)


def read(device, n):
    found, end = [], time.monotonic() + HANG_S
    while sum(len(f.block.values) for f in found) < n:
        frame = device.read(1.0)
        found += [] if frame is None else [frame]
        assert time.monotonic() < end, (device.state, device.events(), device.counters())
    return found


def until(true):
    end = time.monotonic() + HANG_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.002)


def test_what_it_is_told_is_what_the_rig_says(board):
    with device_on(board):
        told = board.controller.settings
        assert (told["period"], told["duty_off"], told["host_ms"], told["lift_ms"]) == (10, 400, 250, 300)
        assert told["kp"] < 0 or told["kp"] > 0
        order = [c for c in board.controller.commands if c not in ("ping", "ask_status")]
        assert order == ["identify", "stop", "configure", "limits", "gains"]


def test_gaps_and_damage_are_counted_and_told(board):
    board.controller.skip = {100, 101, 102, 700}
    board.controller.damage = {300}
    with device_on(board) as device:
        device.start("levitate")
        found = read(device, 1500)
        events = device.events()
        c = device.counters()
        assert (c.lost, c.damaged) == (5, 1)
        assert c.discarded_bytes > 10
        lost = [(e.sample, e.count) for e in events if e.kind == "lost"]
        assert lost == [(100, 3), (300, 1), (700, 1)]
        assert sum(e.count for e in events if e.kind == "damaged") == 1
        numbers = [k for f in found for k in range(f.block.first, f.block.first + len(f.block.values))]
        assert [k for k in range(numbers[-1]) if k not in set(numbers)] == [100, 101, 102, 300, 700]
        device.stop()
        assert c.controller["supply_mv"] == 5000.0


def test_samples_that_are_missing_at_the_end_are_counted_too(board):
    with device_on(board) as device:
        device.start("sample")
        read(device, 200)
        with board.lock:
            board.controller.skip = set(range(board.controller.ticks, 10**6))
            since = board.controller.ticks
        until(lambda: board.controller.ticks > since + 50)
        device.stop()
        while not device.ended:
            device.read(1.0)
        assert device.counters().lost == board.controller.ticks - since
        assert device.counters().samples == since


def test_a_pulled_cable_is_told_at_once_and_what_came_is_still_there(board):
    device = device_on(board)
    with pytest.raises(DeviceError, match="was lost"), device:  # noqa: PT012 - it is a later read that raises
        device.start("levitate")
        read(device, 200)
        time.sleep(0.05)  # some more come, and wait
        board.pull()
        until(lambda: [e for e in device.events() if e.kind == "link"])
        frames = 0
        while device.read(HANG_S) is not None:
            frames += 1
    assert device.state == "levitating"  # as last heard
    assert device.counters().samples > 200
    assert not any(board.port in t.name for t in threading.enumerate())


def test_a_loss_that_nobody_heard_of_is_told_when_the_device_is_closed(board):
    device = device_on(board)
    with pytest.raises(DeviceError, match="by itself"), device:  # noqa: PT012 - it is the closing that raises
        device.start("levitate")
        board.pull()
        until(lambda: device.ended or device.read(0.1) is None)
        until(lambda: device._controller.failure is not None)
    with pytest.raises(ZeroDivisionError), device_on_lost():
        raise ZeroDivisionError


def device_on_lost():
    """A device whose cable is pulled while another exception is on its way."""
    lost = PtyBoard(FakeController()).__enter__()

    class Pulled(SerialDevice):
        def __exit__(self, *error):
            lost.pull()
            super().__exit__(*error)

    return Pulled(lost.port, PROTOTYPE, answer_s=5.0)


def test_a_controller_that_was_reset_on_the_way_is_found_out(board):
    with device_on(board) as device:
        device.start("levitate")
        read(device, 200)
        with board.lock:
            board.controller.reset()
        with pytest.raises(DeviceError, match="was reset"):  # noqa: PT012 - what came before is read first
            while True:
                device.read(HANG_S)
        assert [e for e in device.events() if e.kind == "link"]
        assert device.state == "idle"


def test_a_fault_whose_message_is_lost_is_seen_in_the_samples(board):
    with device_on(board) as device:
        device.start("levitate")
        read(device, 300)
        with board.lock:
            board.controller.fail("over_current", tell=False)
            tick = board.controller.ticks
        until(lambda: device.state == "fault")
        faults = [e for e in device.events() if e.kind == "fault"]
        assert [(e.what, e.sample) for e in faults] == [("over_current", tick)]


def test_a_fault_of_an_earlier_session_is_cleared_and_told_but_is_no_fault_of_this_one(board):
    board.controller.fail("host_silent")
    board.controller.sampling = True
    board.controller.settings |= {"stream": 15, "duty_off": 400, "setpoint": 512}
    with device_on(board) as device:
        assert device.state == "idle"
        events = device.events()
        assert [e.kind for e in events] == ["link"]
        assert "host_silent" in events[0].what
        device.start("levitate")
        assert read(device, 100)[0].block.first == 0
        assert device.counters().damaged == 0


def test_a_fault_whose_cause_is_still_there_keeps_the_device_from_opening(board):
    board.controller.fail("interlock")
    board.controller.clear_refused = True
    with pytest.raises(DeviceError, match="refuses 'clear'"), device_on(board):
        pass
    with board.lock:
        board.controller.clear_refused = False
    with device_on(board) as device:  # nothing was left open
        assert device.state == "idle"


def test_a_start_that_is_refused_leaves_it_idle(board):
    with device_on(board) as device:
        board.controller.interlock_open = True
        with pytest.raises(DeviceError, match="interlock"):
            device.start("levitate")
        assert device.state == "idle"
        assert device.ended
        board.controller.interlock_open = False
        device.start("levitate")
        assert read(device, 10)[0].block.first == 0


def test_a_reader_who_is_too_slow_loses_counted_blocks(board):
    with device_on(board) as device:
        device._stream.frames.room = 500
        device.start("sample")
        until(lambda: device.counters().overruns >= 3)
        found = read(device, 400)
        assert found[0].block.first == 0
        device.stop()
        while (frame := device.read(0.0)) is not None:
            found.append(frame)
        c = device.counters()
        assert c.samples == sum(len(f.block.values) for f in found)
        assert c.samples + c.lost == board.controller.ticks
        told = [e.count for e in device.events() if e.kind == "lost"]
        assert sum(told) == c.lost


def test_a_rig_without_calibrations_is_refused_with_a_remedy():
    with pytest.raises(RigError, match="daq"):
        SerialDevice("/dev/ttyACM0", default_rig())
