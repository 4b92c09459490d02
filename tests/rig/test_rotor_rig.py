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
        ('"ax.k_i"', '"ax.k_j"', "Did you mean 'ax.k_i'"),
        ('{ value = 72.0, unit = "mm" }', '{ value = 72.0, unit = "kg" }', "measured in"),
    ],
)
def test_a_slip_is_named(old: str, new: str, says: str) -> None:
    with pytest.raises(RigError, match=says):
        rig_from_text(TEXT.replace(old, new), "bench.toml")
