"""Records played back: with their gaps, at their pace, and refused where they do not fit the rig."""

import time
from pathlib import Path

import numpy as np
import pytest

from ambid.acquisition.devices import open_device
from ambid.acquisition.devices.emulated import EmulatedDevice
from ambid.acquisition.devices.line_device import SerialDevice
from ambid.acquisition.devices.played import ReplayDevice
from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.errors import AmbidError, DeviceError
from ambid.job.acquiring import opened
from ambid.physics.presets import preset
from ambid.rig import load_rig
from ambid.rig.draft import rig_of_preset

PROTOTYPE = load_rig(Path(__file__).parents[3] / "src" / "ambid" / "data" / "prototype.toml")


def written(path, rows, header="time [s],duty [1],current [1],position [1]"):
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def row(k):
    return f"{k / 2000:.6f},{400 + k % 5},{512},{500 + k % 7}"


@pytest.fixture
def record(tmp_path):
    return written(tmp_path / "r.csv", [row(k) for k in range(1000) if not 300 <= k < 340])


def everything(device):
    found = []
    while not device.ended:
        frame = device.read(60.0)
        found += [] if frame is None else [frame]
    return found


def test_gaps_of_the_record_are_gaps_of_the_stream(record):
    with ReplayDevice(record, PROTOTYPE, pace="fastest") as device:
        device.start("sample")
        found = everything(device)
        roles = [c.role for c in device.info.columns]
        assert device.state == "idle"
        assert device.counters().lost == 40
        assert device.counters().samples == 960
        assert [(e.sample, e.count) for e in device.events() if e.kind == "lost"] == [(300, 40)]
        numbers = np.concatenate([f.block.first + np.arange(len(f.block.values)) for f in found])
        np.testing.assert_array_equal(numbers, [k for k in range(1000) if not 300 <= k < 340])
        values = np.concatenate([f.block.values for f in found])
        np.testing.assert_array_equal(values[:, roles.index("position")], 500 + numbers % 7)
        assert found[-1].block.time_s == pytest.approx(found[-1].block.first / 2000)
        device.start("sample")  # from its first row again, numbers counting on
        assert device.read(60.0).block.first == 1000


def test_columns_that_the_rig_does_not_know_come_after_its_own(tmp_path):
    rows = [f"{row(k)},{k % 3},{k}" for k in range(100)]
    header = "time [s],duty [1],current [1],position [1],excitation [1],hall [V]"
    with ReplayDevice(written(tmp_path / "more.csv", rows, header), PROTOTYPE, pace="fastest") as device:
        seen = [(c.name, c.role, c.unit) for c in device.info.columns]
        assert seen[3:] == [("excitation", "excitation", "1"), ("hall", "extra", "V")]
        device.start("sample")
        values = np.concatenate([f.block.values for f in everything(device)])
        np.testing.assert_array_equal(values[:, 4], np.arange(100))


def test_in_real_time_it_takes_its_time(record):
    with ReplayDevice(record, PROTOTYPE, pace="real") as device:
        began = time.perf_counter()
        device.start("sample")
        found = everything(device)
        for frame in found:  # none is there before it is due
            assert frame.arrived_s >= began + (frame.block.first + len(frame.block.values) - 40) / 2000 - 1e-6
        assert time.perf_counter() >= found[-1].arrived_s - 1e-6


def test_records_that_do_not_fit_are_refused(tmp_path):
    rows = [f"{k / 2000:.6f},400,512" for k in range(20)]
    short = written(tmp_path / "short.csv", rows, "time [s],duty [1],current [1]")
    with pytest.raises(DeviceError, match="'position'"):
        ReplayDevice(short, PROTOTYPE)
    with pytest.raises(AmbidError):
        ReplayDevice(tmp_path / "none.csv", PROTOTYPE)


def test_holes_are_named_by_its_self_test(tmp_path):
    rows = [row(k) for k in range(100)]
    rows[10] = "0.005,nan,512,500"
    with ReplayDevice(written(tmp_path / "h.csv", rows), PROTOTYPE, pace="fastest") as device:
        assert device.self_test().failed == ("1 of 100 rows have holes",)
        device.start("sample")
        values = np.concatenate([f.block.values for f in everything(device)])
        assert np.isnan(values).sum() == 1


def test_a_port_s_name_chooses_the_device(record):
    assert isinstance(open_device("simulated", PROTOTYPE), SimulatedDevice)
    assert isinstance(open_device("emulated", PROTOTYPE), EmulatedDevice)
    assert isinstance(open_device(f"replay:{record}", PROTOTYPE), ReplayDevice)
    assert isinstance(open_device("/dev/ttyACM0", PROTOTYPE), SerialDevice)
    with pytest.raises(DeviceError, match="bench"):
        open_device("/dev/ttyACM0", PROTOTYPE, bench=PROTOTYPE)


@pytest.mark.parametrize("port", ["emulated", "/dev/ttyACM0"])
def test_a_rotor_is_told_what_to_do_without_such_a_controller(port):
    notes = []
    rig = rig_of_preset(preset("rmit"))
    with (
        pytest.raises(
            DeviceError, match=r"has 4 axes; this controller drives one. Choose port simulated.*excitation_only=True"
        ),
        opened(port, rig, bench=None, pace="fastest", seed=0, closes=False, note=notes.append),
    ):
        pass
    assert not notes
