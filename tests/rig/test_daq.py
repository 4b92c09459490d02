"""The section ``[daq]``: every entry arrives, what is not said has its default, what cannot be held is refused."""

import math

import pytest

from ambid.errors import RigError
from ambid.rig import Daq, load_rig, write_rig

BENCH = """schema = "ambid.rig/1"
model = "one-axis"
[channels.voltage]
column = "duty"
[channels.current]
[channels.position]
[channels.speed]
column = "tacho"
[loop]
kp = 1.0
limits = { voltage = 12, current = 1, position = [-1e-3, 2e-3] }
"""

FULL = """[daq]
rate_hz = 1000.0
baud = 500000
duty = [40, 760]
duty_off = 400
host_ms = 100
lift_ms = 0
third = "tacho"
[daq.trip]
position = [-5e-4, 5e-4]
current = 0.8
"""


def test_every_entry_arrives(rig_file):
    rig = load_rig(rig_file(BENCH + FULL))
    assert rig.daq == Daq(
        rate_hz=1000.0,
        baud=500_000,
        duty=(40, 760),
        duty_off=400,
        host_ms=100,
        lift_ms=0,
        third="tacho",
        position_trip=(-5e-4, 5e-4),
        current_trip=(-0.8, 0.8),
    )
    assert rig.trip("position") == (-5e-4, 5e-4)
    assert rig.trip("current") == (-0.8, 0.8)


def test_defaults(rig_file):
    rig = load_rig(rig_file(BENCH + "[daq]\n"))
    assert rig.daq == Daq(rate_hz=2000.0, baud=1_000_000, host_ms=250, lift_ms=300)
    assert rig.trip("position") == pytest.approx((-0.85e-3, 1.85e-3))  # the middle 90 % of 3 mm
    assert rig.trip("current") == (-1.0, 1.0)
    assert load_rig(rig_file(BENCH)).daq is None
    assert load_rig(rig_file(BENCH + "[record]\nrate_hz = 500.0\n[daq]\n")).daq.rate_hz == 500.0


def test_a_bench_without_limits_has_no_trips(rig_file):
    rig = load_rig(rig_file('schema = "ambid.rig/1"\nmodel = "one-axis"\n[daq]\n'))
    assert rig.trip("position") == (-math.inf, math.inf)
    assert rig.trip("current") == (-math.inf, math.inf)


def test_written_and_read_back_it_is_the_same(rig_file, tmp_path):
    for section in (FULL, "[daq]\n", "[daq]\nrate_hz = 4000.0\ntrip = { current = 0.5 }\n"):
        rig = load_rig(rig_file(BENCH + section))
        write_rig(rig, tmp_path / "again.toml")
        assert load_rig(tmp_path / "again.toml").daq == rig.daq


@pytest.mark.parametrize(
    ("sound", "damaged", "words"),
    [
        ("host_ms = 100", "host_mS = 100", "unknown key 'host_mS' in [daq]; known: rate_hz, baud"),
        (
            "position = [-5e-4, 5e-4]",
            "positon = 5e-4",
            "unknown key 'positon' in [daq.trip]; known: position, current.",
        ),
        ("rate_hz = 1000.0", "rate_hz = 0.0", "daq.rate_hz is 0.0; it must be positive"),
        ("rate_hz = 1000.0", 'rate_hz = "fast"', "daq.rate_hz is 'fast'; it must be a number"),
        ("baud = 500000", "baud = 9600.5", "daq.baud is 9600.5; it must be a whole number. Correct it"),
        ("duty = [40, 760]", "duty = 760", "daq.duty is 760; it must be [low, high] in whole counts"),
        ("duty = [40, 760]", "duty = [40, 760.5]", "it must be [low, high] in whole counts"),
        ("duty = [40, 760]", "duty = [-1, 760]", "it must be [low, high] in whole counts"),
        ("duty = [40, 760]", "duty = [760, 40]", "daq.duty is [760, 40]; the lower comes first"),
        ("host_ms = 100", "host_ms = 19", "daq.host_ms is 19; the controller takes 20 to 2000 ms"),
        ("lift_ms = 0", "lift_ms = 2001", "daq.lift_ms is 2001; the controller takes 0 to 2000 ms"),
        ('third = "tacho"', 'third = "duty"', "daq.third is 'duty', the column of channels.voltage"),
        (
            "current = 0.8",
            "current = 1.1",
            "daq.trip.current is [-1.1, 1.1], outside loop.limits.current = [-1.0, 1.0]",
        ),
        ("position = [-5e-4, 5e-4]", "position = [5e-4, -5e-4]", "daq.trip.position is [0.0005, -0.0005]; the lower"),
        ("position = [-5e-4, 5e-4]", "position = -1", "daq.trip.position is -1; it must be a positive number, or [low"),
        ("position = [-5e-4, 5e-4]", "position = 1.5e-3", "outside loop.limits.position = [-0.001, 0.002]"),
    ],
)
def test_damage_is_named_in_one_line(rig_file, sound, damaged, words):
    assert sound in FULL
    with pytest.raises(RigError) as refused:
        load_rig(rig_file(BENCH + FULL.replace(sound, damaged)))
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_coil_alone_has_no_position_to_trip_on(rig_file):
    with pytest.raises(RigError, match=r"daq\.trip\.position is given; model 'coil' has no position\. Remove it"):
        load_rig(rig_file('schema = "ambid.rig/1"\nmodel = "coil"\n[daq.trip]\nposition = 1e-3\n'))
