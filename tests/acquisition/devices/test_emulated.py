"""The firmware's binary through the ordinary driver: what happens at the bench is told to the host."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from ambid.acquisition.device import Program
from ambid.acquisition.devices.emulated import EmulatedDevice
from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.acquisition.program import program
from ambid.errors import DeviceError
from ambid.rig import load_rig
from tests.acquisition.devices.bare import bare_rig

PROTOTYPE = load_rig(Path(__file__).parents[3] / "src" / "ambid" / "data" / "prototype.toml")

pytestmark = pytest.mark.usefixtures("bench_program", "firmware_elf")


def read_until_fault(device):
    blocks = []
    while True:
        frame = device.read(60.0)
        assert frame is not None, (device.state, device.events())
        blocks.append(frame.block)
        faults = [e for e in device.events() if e.kind == "fault"]
        if faults:
            return blocks, faults


@pytest.mark.parametrize(
    ("script", "cause"),
    [
        ("+0.6 interlock open", "interlock"),
        ("+0.6 override current 4.9", "over_current"),
        ("+0.6 override position 0.1", "out_of_gap"),
    ],
)
def test_what_happens_at_the_bench_is_told_with_its_sample(script, cause):
    with EmulatedDevice(PROTOTYPE, script=script) as device:
        device.start("levitate")
        blocks, faults = read_until_fault(device)
        assert [f.what for f in faults] == [cause]
        assert faults[0].sample == pytest.approx(0.6 * 2000, abs=40)
        seen = np.concatenate([b.values for b in blocks])
        duty = seen[:, 2]
        assert (duty[faults[0].sample + 1 :] == 400).all()  # the interlock may open after the tick's own work
        assert device.read(60.0) is not None  # frames flow on
        assert device.state == "fault"
        off = device.emulator.events("enable")
        assert off[-1]["t"] - off[0]["t"] == pytest.approx(0.6, abs=0.003)  # within 2 ms, and a tick


def test_a_line_that_damages_frames_is_counted_and_survived():
    with EmulatedDevice(PROTOTYPE, script="0.5 line damage 0.0005") as device:
        device.start("levitate")
        n = 0
        while n < 6000:
            frame = device.read(60.0)
            assert frame is not None
            n += len(frame.block.values)
        device.stop()
        while not device.ended:
            device.read(60.0)
        c = device.counters()
        assert c.damaged > 5
        assert 5 < c.lost <= 2 * c.damaged + 1  # a zero that is damaged joins two frames
        assert c.samples + c.lost >= 6000
        assert device.state == "idle"


def test_the_simulated_bench_moves_as_the_emulated_one():
    spread = []
    for device in (EmulatedDevice(PROTOTYPE, seed=2), SimulatedDevice(PROTOTYPE, seed=2)):
        with device:
            device.start("levitate")
            device.read(60.0)
            device.excite(program("prbs", amplitude_v=1.5, rate_hz=2000.0, seconds=4.0))
            blocks = []
            while sum(map(len, blocks)) < 10_000:
                blocks.append(device.read(60.0).block.values)
        spread.append(np.concatenate(blocks)[2000:].std(axis=0))
    # Position, current, pulse width, excitation; much of what moves the rotor is noise, other noise in each.
    assert (np.abs(spread[0] / spread[1] - 1.0) < [0.25, 0.12, 0.03, 0.001]).all()


def test_emulated_time_waits_for_its_reader():
    with EmulatedDevice(PROTOTYPE) as device:
        device.start("levitate")
        frame = device.read(60.0)
        last = -1
        while device.counters().samples != last:  # until nothing more comes: nobody reads
            last = device.counters().samples
            time.sleep(0.5)
        assert 500 < last < 2000
        device.excite(Program(kind="step", amplitude=0.9, hold=10, length=2))  # commands get through all the same
        n = len(frame.block.values)
        while n < 6000:
            frame = device.read(60.0)
            assert frame is not None, (device.state, device.events())
            n += len(frame.block.values)
        assert device.state == "levitating"
        assert np.abs(frame.block.values[:, 3]).max() == 30
        device.stop()
        assert device.counters().lost == device.counters().overruns == 0


def test_an_emulator_that_dies_is_told_as_such():
    device = EmulatedDevice(PROTOTYPE)
    ended = r"the emulated bench ended by signal 9 \(SIGKILL\)"
    with pytest.raises(DeviceError, match=ended), device:  # noqa: PT012 - what came before is read first
        device.start("levitate")
        assert device.read(60.0) is not None
        os.kill(device.emulator.pid, signal.SIGKILL)
        while True:
            device.read(60.0)
    assert device.emulator is None


def test_a_rig_without_instruments_gets_si_columns():
    with EmulatedDevice(bare_rig()) as device:
        units = {c.role: c.unit for c in device.info.columns}
        assert units == {"position": "m", "current": "A", "voltage": "V", "excitation": "V"}
        device.start("levitate")
        n = 0
        while n < 2000:
            frame = device.read(60.0)
            n += len(frame.block.values)
        assert np.abs(frame.block.values[:, 0]).max() < 2e-4  # m: it floats


def test_a_pace_that_there_is_not_is_refused():
    with pytest.raises(DeviceError, match="pace"):
        EmulatedDevice(PROTOTYPE, pace="quick")


def test_a_bench_that_cannot_start_leaves_nothing_behind():
    before = set(Path("/tmp").glob("ambid-emulated-*"))
    device = EmulatedDevice(PROTOTYPE, script="never interlock open")
    with pytest.raises(DeviceError), device:
        raise AssertionError
    assert device.emulator is None
    assert not set(Path("/tmp").glob("ambid-emulated-*")) - before
