"""Simulated bench and emulated firmware obey the same law, count by count, and play the same excitation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ambid.acquisition.device import Program
from ambid.acquisition.devices.emulated import EmulatedDevice
from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.acquisition.program import expected, program
from ambid.acquisition.settings import controller_settings
from ambid.rig import load_rig
from tests.acquisition.devices.law import pulse_widths

PROTOTYPE = load_rig(Path(__file__).parents[3] / "src" / "ambid" / "data" / "prototype.toml")
# Set point off the middle, so that every term of the law has work.
RIG = replace(PROTOTYPE, operating_point={"position": 2e-4, "current": 0.0})
STEP = 30  # counts of 0.9 V


@pytest.fixture(params=["simulated", "emulated"])
def device(request):
    if request.param == "simulated":
        return SimulatedDevice(RIG, seed=3)
    request.getfixturevalue("bench_program")
    request.getfixturevalue("firmware_elf")
    return EmulatedDevice(RIG, seed=3)


def read(device, n):
    found = []
    while sum(map(len, found)) < n:
        frame = device.read(60.0)
        assert frame is not None, (device.state, device.events())
        found.append(frame.block.values)
    return np.concatenate(found).astype(int)


def test_the_pulse_width_is_what_the_law_makes_of_the_samples(device):
    with device:
        device.start("levitate")
        first = read(device, 2000)
        device.excite(program("prbs", amplitude_v=0.9, rate_hz=2000.0, seconds=2.0))
        values = np.concatenate([first, read(device, 2000)])
    assert device.counters().lost == 0
    position, current, duty, excitation = values.T
    assert set(np.abs(excitation[-1000:])) == {STEP}
    np.testing.assert_array_equal(duty, pulse_widths(position, current, excitation, controller_settings(RIG)))
    assert len(set(duty[:100])) > 1  # it was limited while it lifted off, and then it was not
    # The integral holds it: means of half a second scatter by 1 count, and the set point is 82 off the middle.
    assert abs(position[1000:2000].mean() - controller_settings(RIG).setpoint) < 5.0


@pytest.mark.parametrize(
    "played",
    [
        Program(kind="step", amplitude=0.9, hold=7, length=2, cycles=3),
        Program(kind="prbs", amplitude=0.9, hold=3, length=6, seed=33),
        Program(kind="table", amplitude=0.9, hold=2, length=100, table=tuple(range(-50, 50)), cycles=2),
    ],
    ids=lambda p: p.kind,
)
def test_excitations_are_played_as_the_table_of_messages_says(device, played):
    with device:
        device.start("levitate")
        read(device, 400)
        device.excite(played)
        seen = read(device, 1000)[:, 3]
    assert seen.any()
    begin = int(np.flatnonzero(seen)[0])
    n = seen.size - begin
    np.testing.assert_array_equal(seen[begin:], expected(played, n, counts=STEP))
