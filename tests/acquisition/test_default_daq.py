"""Instruments that are made up fit the rig's limits, leave what is there alone, and are told."""

from dataclasses import replace

import pytest

from ambid.acquisition.scales import scale_of
from ambid.acquisition.settings import controller_settings, default_daq_notes, with_default_daq
from ambid.errors import RigError
from ambid.physics.loop import Limits
from ambid.physics.presets import preset
from ambid.rig import Rig, default_rig
from tests.acquisition.rigs import bench

BARE = """schema = "ambid.rig/1"
model = "one-axis"
[loop]
kp = 1.94e4
limits = { voltage = [0, 12], current = [0.0, 2.0], position = [2e-3, 12e-3] }
[operating_point]
position = { value = 7.0, unit = "mm" }
current = { value = 1.0, unit = "A" }
voltage = { value = 6.0, unit = "V" }
"""


def of_preset(name: str) -> Rig:
    known = preset(name)
    rig = default_rig(known.model)
    return replace(
        rig,
        parameters=tuple(replace(p, value=known.parameters[p.name]) for p in rig.parameters),
        loop=known.loop,
        limits=known.limits,
        operating_point=known.operating_point._asdict(),
        record=replace(rig.record, rate_hz=known.rate_hz),
    )


def test_a_complete_rig_stays_as_it_is():
    rig = bench()
    assert with_default_daq(rig) == rig
    assert default_daq_notes(rig) == ()


def test_full_scales_are_a_quarter_wider_than_the_limits():
    rig = with_default_daq(bench(text=BARE))
    assert scale_of(rig, "position").to_si([0.0, 1023.0]) == pytest.approx([0.75e-3, 13.25e-3])
    assert scale_of(rig, "current").to_si([0.0, 1023.0]) == pytest.approx([-0.25, 2.25])
    assert scale_of(rig, "voltage").to_si([0.0, 800.0]) == pytest.approx([0.0, 12.0])
    assert rig.daq.rate_hz == 2000.0
    s = controller_settings(rig)
    assert (s.duty_off, s.duty_bias, s.setpoint) == (0, 400, 512)
    assert default_daq_notes(bench(text=BARE)) == (
        "voltage: 0 to 800 counts assumed to be 0 to 12 V",
        "position: 0 to 1023 counts assumed to be 0.00075 to 0.01325 m",
        "current: 0 to 1023 counts assumed to be -0.25 to 2.25 A",
    )


def test_what_the_rig_has_is_kept():
    rig = with_default_daq(bench(("gain = 2.44140625e-6\noffset = -1.25e-3\n", "")))
    assert scale_of(rig, "current").slope(512) == 2.44140625e-3
    assert scale_of(rig, "position").to_si([0.0, 1023.0]) == pytest.approx([-1.25e-3, 1.25e-3])


@pytest.mark.parametrize("name", ["prototype", "unstable-bearing", "rmit-axis", "thesis"])
def test_every_preset_gets_settings(name):
    rig = of_preset(name)
    settings = controller_settings(with_default_daq(rig))
    assert settings.closed
    assert settings.rate_hz == min(preset(name).rate_hz, 2500.0)
    told = [line for line in default_daq_notes(rig) if line.startswith("rate")]
    assert bool(told) == (preset(name).rate_hz > 2500.0)
    assert all("rate: 2500 Hz, the nearest to" in line for line in told)


def test_a_loop_that_is_too_steep_for_ten_bits_is_refused():
    """Of 22 mm a count is 22 um: the ball's derivative would turn one count into a fifth of the pulse width."""
    with pytest.raises(RigError, match=r"loop\.kd is -6\.332e\+05 steps of the controller, whose limit is 524288:"):
        controller_settings(with_default_daq(of_preset("levitated-ball")))


def test_without_limits_there_is_nothing_to_make_a_sensor_from():
    rig = bench(text=BARE)
    with pytest.raises(
        RigError, match=r"channels\.position has no calibration, and there is no loop\.limits\.position"
    ):
        with_default_daq(replace(rig, limits=Limits(voltage=(0.0, 12.0), current=(0.0, 2.0))))
    with pytest.raises(RigError, match=r"there is no loop\.limits\.voltage"):
        default_daq_notes(replace(rig, limits=None))
