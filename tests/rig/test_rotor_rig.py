"""``[bearings.X]`` of a rig file: what is read, written back, and refused."""

from pathlib import Path

import pytest

from ambid.errors import RigError
from ambid.rig import rig_from_text, rig_text

TEXT = """
schema = "ambid.rig/1"
name = "two radial bearings"
model = "rotor"
speed = { value = 3000, unit = "rpm" }
[bearings.A]
z = { value = 72.0, unit = "mm" }
z_sensor = { value = 45.0, unit = "mm" }
axes = ["ax", "ay"]
[bearings.B]
z = { value = 342.0, unit = "mm" }
z_sensors = [{ value = 371.0, unit = "mm" }, { unit = "mm" }]
axes = ["bx", "by"]
[bearings.T]
axial = true
axes = ["az"]
[modes]
count = 2
[parameters]
m = { value = 6.2, unit = "kg", role = "fixed" }
a = { unit = "rad/s" }
"ax.k_i" = { value = 61.0, unit = "N/A" }
"""


def test_bearings_become_a_rotor_with_planes_in_metres() -> None:
    rig = rig_from_text(TEXT, "bench.toml")
    assert rig.rotor is not None
    assert rig.rotor.axes == ("ax", "ay", "bx", "by", "az")
    assert rig.rotor.speed == pytest.approx(314.159265)
    assert rig.parameter("A.z").value == pytest.approx(0.072)
    assert [rig.parameter(f"B.z_sensor{k}").role for k in ("", "2")] == ["fixed", "free"]
    assert (rig.parameter("Ip").role, rig.parameter("a").role, rig.modes.count) == ("free", "free", 2)
    assert rig.plant.inputs == ("ax_voltage", "ay_voltage", "bx_voltage", "by_voltage", "az_voltage")
    assert rig.plant.outputs[:7] == (
        "ax_position", "ay_position", "bx_position", "by_position", "az_position", "bx_position2", "by_position2",
    )  # fmt: skip


def test_a_rotor_rig_is_written_as_it_was_read() -> None:
    rig = rig_from_text(TEXT, "bench.toml")
    again = rig_from_text(rig_text(rig, Path()), "bench.toml")
    assert (again.rotor, again.parameters, again.channels, again.modes) == (
        rig.rotor, rig.parameters, rig.channels, rig.modes,
    )  # fmt: skip


def test_bearings_in_one_plane_are_refused() -> None:
    with pytest.raises(RigError, match=r"bearings\.A\.z and bearings\.B\.z are both 0\.342 m.*Correct one"):
        rig_from_text(TEXT.replace("72.0", "342.0"), "bench.toml")


TURNING = """
[unbalance.disc]
value = 12.0
unit = "g mm"
phase = 0.7
z = { value = 200.0, unit = "mm" }
[modes.shapes]
"A.z" = [1.0, 2.0]
"A.z_sensor" = [1.5, 2.5]
"B.z" = [-1.0, 2.0]
"B.z_sensor" = [-1.5, 2.5]
"B.z_sensor2" = [-1.6, 2.6]
"unbalance.disc" = [0.1, -0.2]
[modes.gyroscopic]
"01" = 0.01
"12" = 0.2
[magnet]
kind = "pair"
[magnet.parameters]
s = { value = 0.4, unit = "mm", role = "fixed" }
"""
MODES = "[modes]\nfrequency_hz = [150.0, 500.0]\ndamping = [0.01, 0.02]"
BENDING = TEXT.replace("[modes]", MODES).replace('axes = ["ax"', 'runout = { value = 1, unit = "um" }\naxes = ["ax"')


def test_what_a_simulation_needs_is_read_and_written_back() -> None:
    rig = rig_from_text(BENDING + TURNING, "bench.toml")
    numbers = rig.modes.numbers
    assert numbers["mode2.omega"] == pytest.approx(2 * 3.141592653589793 * 500.0)
    assert (numbers["mode2.zeta"], numbers["mode1.B.z_sensor2"], numbers["gyro.12"]) == (0.02, -1.6, 0.2)
    assert numbers["mode2.unbalance.disc"] == -0.2
    (disc,), (runout,) = rig.unbalance, rig.runout
    assert (disc.value, disc.z, disc.phase) == (pytest.approx(12e-6), pytest.approx(0.2), 0.7)
    assert (runout.name, runout.value) == ("A", pytest.approx(1e-6))
    again = rig_from_text(rig_text(rig, Path()), "bench.toml")
    assert dict(again.modes.numbers) == pytest.approx(dict(numbers))
    assert (again.unbalance, again.runout, again.magnet) == (rig.unbalance, rig.runout, rig.magnet)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"B.z" = [-1.0, 2.0]', '"B.zz" = [-1.0, 2.0]', "'B.zz' is no plane of this rotor"),
        ('"B.z" = [-1.0, 2.0]', "", "'B.z' is missing"),
        ('"B.z" = [-1.0, 2.0]', '"B.z" = [-1.0]', "has 1 numbers, modes.frequency_hz 2"),
        ('"12" = 0.2', '"13" = 0.2', "'13' is no pair of modes"),
        ("damping = [0.01, 0.02]", "", "without modes.damping"),
        ('unit = "g mm"', 'unit = "g"', r"measured in \[kg m\]"),
        ('kind = "pair"', 'kind = "single"', "a rotor has pairs"),
        (
            's = { value = 0.4, unit = "mm", role',
            'k = { value = 0.4, unit = "N m^2/A^2", role',
            "a magnet has s, sigma",
        ),
    ],
)
def test_a_slip_in_what_a_simulation_needs_is_named(old: str, new: str, says: str) -> None:
    assert old in BENDING + TURNING
    with pytest.raises(RigError, match=says):
        rig_from_text((BENDING + TURNING).replace(old, new), "bench.toml")


def test_an_axis_without_a_voltage_is_driven_by_its_current() -> None:
    channels = "".join(f"[channels.{a}_{q}]\n" for a in ("ax", "ay", "bx", "by", "az") for q in ("current", "position"))
    channels += "[channels.bx_position2]\n[channels.by_position2]\n"
    rig = rig_from_text(TEXT + channels, "bench.toml")
    assert rig.plant.inputs[0] == "ax_current"
    assert not any(p.name.endswith((".R", ".L")) for p in rig.parameters)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('model = "rotor"', 'model = "one-axis"', 'Set model = "rotor"'),
        ('unit = "rpm"', 'unit = "V"', r"speed is in \[V\]"),
        ('axes = ["bx", "by"]', 'axes = ["ax", "by"]', "'ax' is named twice"),
        ("axial = true", "axiel = true", "Did you mean 'axial'"),
        ('z = { value = 72.0, unit = "mm" }', "", "bearings.A.z is missing"),
        ('"ax.k_i"', '"ax.k_ii"', "Did you mean 'ax.k_i'"),
        ('{ value = 72.0, unit = "mm" }', '{ value = 72.0, unit = "kg" }', "measured in"),
    ],
)
def test_a_slip_is_named(old: str, new: str, says: str) -> None:
    with pytest.raises(RigError, match=says):
        rig_from_text(TEXT.replace(old, new), "bench.toml")


SHAFT = """
[shaft]
z = { value = -10.0, unit = "mm" }
material = { E = { value = 211, unit = "GPa" }, rho = { value = 7810, unit = "kg/m^3" }, nu = 0.3 }
damping = 0.004
[[shaft.steps]]
length = { value = 200, unit = "mm" }
diameter = { value = 30, unit = "mm" }
[[shaft.steps]]
length = { value = 0.22, unit = "m" }
diameter = { value = 36, unit = "mm" }
bore = { value = 10, unit = "mm" }
material = { E = { value = 70, unit = "GPa" }, rho = { value = 2.7, unit = "g/cm^3" } }
[[shaft.discs]]
z = { value = 100, unit = "mm" }
m = { value = 0.9, unit = "kg" }
Id = { value = 6.0, unit = "kg cm^2" }
Ip = { value = 9.0, unit = "kg cm^2" }
[[shaft.discs]]
z = { value = 300, unit = "mm" }
outer = { value = 140, unit = "mm" }
inner = { value = 36, unit = "mm" }
width = { value = 20, unit = "mm" }
"""


def test_a_drawing_is_read_in_si_and_written_back() -> None:
    rig = rig_from_text(TEXT + SHAFT, "bench.toml")
    shaft = rig.shaft
    assert shaft is not None
    assert (shaft.z, shaft.length, shaft.material.E, *shaft.zeta) == pytest.approx((-0.01, 0.42, 2.11e11, 0.004))
    assert shaft.steps[1].bore == pytest.approx(0.01)
    assert shaft.steps[1].material is not None
    assert shaft.steps[1].material.rho == pytest.approx(2700.0)
    assert shaft.discs[0].Id == pytest.approx(6e-4)
    assert shaft.discs[1].m == pytest.approx(7810 * 3.14159265 * (0.14**2 - 0.036**2) / 4 * 0.02)
    again = rig_from_text(rig_text(rig, Path()), "bench.toml")
    assert (again.shaft, again.rotor) == (shaft, rig.rotor)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"GPa"', '"N"', r"shaft.material.E is in \[N\]; it is measured in \[Pa\]"),
        ('"GPa"', '"GPx"', "shaft.material.E.unit: unit 'GPx' is unknown; nearest: GPa"),
        ('diameter = { value = 36, unit = "mm" }', "", "shaft.steps.2.diameter is missing"),
        ("bore", "boer", r"unknown key 'boer' in \[shaft.steps.2\]; known: length.* Did you mean 'bore'"),
        ("value = 10,", "value = 40,", "shaft.steps.2: a step of the shaft has a bore of 0.04 m"),
        ('Ip = { value = 9.0, unit = "kg cm^2" }', "", "shaft.discs.1 has m, Id; a disc has m, or m, Id and Ip"),
        ("value = 300", "value = 500", "shaft: a disc lies at 0.5 m, outside the shaft"),
        ("value = -10.0", "value = 80.0", "shaft goes from 0.08 to 0.5 m, but A.z is at 0.072 m"),
        ("damping = 0.004", "damping = [0.01, 1.5]", "damping ratios of the shaft"),
        ("value = 211", 'value = "211"', "shaft.material.E.value is '211'; it must be a number"),
    ],
)  # fmt: skip
def test_a_slip_in_the_drawing_is_named(old: str, new: str, says: str) -> None:
    with pytest.raises(RigError, match=says):
        rig_from_text(TEXT + SHAFT.replace(old, new, 1), "bench.toml")


def test_a_drawing_without_bearings_is_refused() -> None:
    with pytest.raises(RigError, match="shaft is given, but no"):
        rig_from_text('schema = "ambid.rig/1"\nmodel = "one-axis"\n' + SHAFT, "bench.toml")


@pytest.mark.parametrize("speed", ["1e308", "-1e9"])
def test_a_speed_that_no_rotor_has_is_refused(speed: str) -> None:
    with pytest.raises(RigError, match="no rotor is faster than"):
        rig_from_text(TEXT.replace("value = 3000,", f"value = {speed},"), "bench.toml")
