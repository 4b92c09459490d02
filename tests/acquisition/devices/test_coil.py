"""A coil alone, without rotor or position: driven, recorded and identified, and with it the controller's own delay."""

import dataclasses

import numpy as np
import pytest

from ambid.acquisition.device import Program
from ambid.acquisition.devices.emulated import EmulatedDevice
from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.acquisition.scales import LAG_S
from ambid.job import identify
from ambid.rig import rig_from_text

COIL = """schema = "ambid.rig/1"
name = "a coil alone"
model = "coil"
[channels.voltage]
column = "duty"
gain = 0.03
offset = -12.0
[channels.current]
column = "current"
gain = 2.44140625e-3
offset = -1.248779296875
[parameters]
R = { value = 6.0, unit = "ohm" }
L = { value = 30.0, unit = "mH" }
[loop]
limits = { voltage = 11.4, current = 1.0 }
[noise]
current = 2e-3
[daq]
rate_hz = RATE
"""
FREE = (
    ('R = { value = 6.0, unit = "ohm" }', 'R = { unit = "ohm" }'),
    ('{ value = 30.0, unit = "mH" }', '{ unit = "mH" }'),
)
AUTO = ("offset = -12.0\n", 'offset = -12.0\ndelay = "auto"\n')
SAMPLES = 16000


@pytest.fixture(params=["emulated", "simulated"])
def device_of(request):
    """The way to a device of a rig."""
    if request.param == "emulated":
        request.getfixturevalue("bench_program")
        request.getfixturevalue("firmware_elf")
        return EmulatedDevice
    return SimulatedDevice


@pytest.mark.parametrize("rate", [2000, 1000])
def test_resistance_inductance_and_delay_of_a_coil_are_found(device_of, tmp_path, rate):
    text = COIL.replace("RATE", str(rate))
    truth = rig_from_text(text, tmp_path / "rig.toml")
    with device_of(truth) as device:
        assert [c.name for c in device.info.columns] == ["current", "duty", "excitation"]
        assert device.self_test().failed == ()
        device.start("drive")
        device.excite(Program(kind="prbs", amplitude=3.0, hold=2, length=10, seed=1))
        blocks, n = [], 0
        while n < SAMPLES:
            frame = device.read(60.0)
            assert frame is not None
            blocks.append(frame.block.values)
            n += len(blocks[-1])
        assert device.state == "driving"
        assert not [e for e in device.events() if e.kind == "fault"]
        device.stop()
    values = np.concatenate(blocks)[200:]
    path = tmp_path / "coil.csv"
    rows = np.column_stack([np.arange(len(values)) / rate, values[:, :2]])
    np.savetxt(path, rows, delimiter=",", header="time [s],current [1],duty [1]", comments="", fmt="%.9g")
    for sound, unknown in (*FREE, AUTO):
        assert sound in text
        text = text.replace(sound, unknown, 1)
    found = identify(path, rig_from_text(text, tmp_path / "rig.toml"))
    values = {p.name: p.value for p in found.parameters}
    assert values["R"] == pytest.approx(6.0, rel=5e-3)
    assert values["L"] == pytest.approx(30e-3, rel=5e-3)
    delay = found.delay["voltage"]
    assert (delay.samples + delay.fraction) / rate == pytest.approx(LAG_S, abs=3e-6)


def test_a_rig_without_position_has_no_trip_there(tmp_path):
    from ambid.acquisition.settings import controller_settings

    settings = controller_settings(rig_from_text(COIL.replace("RATE", "2000"), tmp_path / "rig.toml"))
    assert (settings.position_low, settings.position_high) == (0, 1023)
    assert not settings.closed
    assert dataclasses.asdict(settings)["stream"] & 1 == 0
