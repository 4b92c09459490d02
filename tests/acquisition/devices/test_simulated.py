"""The simulated bench: repeatable, in real time where asked, nonlinear and linear, with the controller's protection."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ambid.acquisition.device import Program
from ambid.acquisition.devices import _kernels, played
from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.acquisition.protocol import table
from ambid.errors import AmbidError, DeviceError
from ambid.rig import load_rig
from tests.acquisition.devices.bare import bare_rig

PROTOTYPE = load_rig(Path(__file__).parents[3] / "src" / "ambid" / "data" / "prototype.toml")


def read(device, n):
    found = []
    while sum(map(len, found)) < n:
        frame = device.read(60.0)
        assert frame is not None, (device.state, device.events())
        found.append(frame.block.values)
    return np.concatenate(found)


def lifted(**options):
    with SimulatedDevice(PROTOTYPE, **options) as device:
        device.start("levitate")
        return read(device, 1000)


def test_states_and_causes_are_those_of_the_protocol():
    for name in ("idle", "sampling", "driving", "levitating", "fault"):
        assert getattr(_kernels, name.upper()) == table().value("state", name)
    for name in ("over_current", "out_of_gap"):
        assert getattr(_kernels, name.upper()) == table().value("cause", name)
    for name in ("none", "step", "prbs", "table"):
        assert getattr(_kernels, name.upper()) == table().value("kind", name)


def test_equal_seeds_give_equal_samples_whatever_the_blocks():
    np.testing.assert_array_equal(lifted(seed=1), lifted(seed=1, block_samples=20))
    assert (lifted(seed=1) != lifted(seed=2)).any()


def test_it_lifts_the_rotor_off_its_stop_and_trips_when_it_cannot():
    values = lifted()
    position = values[:, 0]
    assert abs(position[0] - 511.5) > 380  # on a stop, 1 mm away
    assert abs(position[-200:].mean() - 511.5) < 5
    heavy = replace(PROTOTYPE, daq=replace(PROTOTYPE.daq, lift_ms=1))
    with SimulatedDevice(heavy) as device:
        device.start("levitate")
        read(device, 100)
        faults = [e for e in device.events() if e.kind == "fault"]
        assert [e.what for e in faults] == ["out_of_gap"]
        assert faults[0].sample == 2  # 1 ms after the start
        seen = read(device, 100)
        assert (seen[:, 2] == 400).all()


def test_over_current_holds_until_the_current_is_gone():
    tight = replace(PROTOTYPE, daq=replace(PROTOTYPE.daq, current_trip=(-0.2, 0.2), position_trip=(-1.2e-3, 1.2e-3)))
    with SimulatedDevice(tight, block_samples=1) as device:
        device.start("drive")
        device.excite(Program(kind="step", amplitude=9.0, hold=400, length=2))
        while device.state != "fault":
            read(device, 1)
        assert [e.what for e in device.events() if e.kind == "fault"] == ["over_current"]
        with pytest.raises(DeviceError, match="current is still outside"):
            device.clear()
        read(device, 400)
        device.clear()
        assert device.state == "idle"


def test_in_real_time_samples_are_there_when_they_are_due():
    with SimulatedDevice(PROTOTYPE, pace="real") as device:
        device.start("levitate")
        read(device, 200)
        device.excite(Program(kind="step", amplitude=0.9, hold=10, length=2))
        values = read(device, 200)
        assert np.abs(values[:, 3]).max() == 30
        device.stop()
        while not device.ended:
            assert device.read(60.0) is not None
        c = device.counters()
        assert c.lost == c.overruns == 0


def test_in_real_time_blocks_are_whole_but_for_a_command_and_the_end(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(played.time, "perf_counter", lambda: now[0])

    def look(device, steps):
        """Ask every 0.7 ms what happened, as a run does after every read; return the sizes of what came."""
        found = []
        for _ in range(steps):
            now[0] += 7e-4
            device.events()
            assert device.state == "levitating"
            frame = device.read(0.0)
            found += [] if frame is None else [len(frame.block.values)]
        return found

    with SimulatedDevice(PROTOTYPE, pace="real") as device:
        device.start("levitate")
        assert look(device, 105) == [20] * 7  # 147 samples are due
        device.excite(None)
        assert look(device, 35) == [7, 20, 20]
        device.stop()
        assert len(device.read(0.0).block.values) == 9
        assert device.ended
        assert device.counters().samples == 196


def test_a_rig_without_instruments_has_si_columns():
    with SimulatedDevice(bare_rig()) as device:
        units = {c.role: c.unit for c in device.info.columns}
        assert units == {"position": "m", "current": "A", "voltage": "V", "excitation": "V"}
        device.start("levitate")
        values = read(device, 2000)
        assert np.abs(values[-500:, 0]).max() < 2e-4  # m: it floats
        device.excite(Program(kind="step", amplitude=0.9, hold=10, length=2))
        played = read(device, 200)[:, 3]
        assert np.abs(played).max() == pytest.approx(0.9, abs=0.03)


def test_a_bench_that_there_is_not_is_refused():
    with pytest.raises(DeviceError, match=r"prototype.*rig file"):
        SimulatedDevice(replace(PROTOTYPE, daq=replace(PROTOTYPE.daq, bench="prototip")))
    with pytest.raises(AmbidError):
        SimulatedDevice(replace(PROTOTYPE, daq=replace(PROTOTYPE.daq, bench=None)))  # its own numbers: there are none
