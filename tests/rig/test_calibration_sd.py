"""How well channels, rate and planes are known: what is read, written back, and refused."""

from pathlib import Path

import pytest

from ambid.errors import RigError
from ambid.rig import load_rig, rig_from_text, rig_text
from ambid.rig.draft import draft_rig
from tests.report import rotor_record
from tests.rig.test_rotor_rig import TEXT

AXIS = """
schema = "ambid.rig/1"
model = "one-axis"
[channels.voltage]
gain_sd = 0.01
[channels.current]
offset_sd = { value = 5.0, unit = "mA" }
gain_sd = 0
[channels.position]
offset_sd = 1e-6
[record]
rate_sd = 1e-4
"""
ROTOR = (
    TEXT.replace('axes = ["ax"', 'z_sd = { value = 0.5, unit = "mm" }\naxes = ["ax"')
    .replace('axes = ["bx"', 'z_magnet_sd = { value = 300, unit = "um" }\naxes = ["bx"')
)  # fmt: skip


def known(rig):
    return {c.role: (c.gain_sd, c.offset_sd) for c in rig.channels}, rig.record.rate_sd, dict(rig.plane_sd)


def test_they_are_read_in_si_and_written_back():
    rig = rig_from_text(AXIS, "bench.toml")
    said = {"voltage": (0.01, None), "current": (0.0, 0.005), "position": (None, 1e-6)}
    assert known(rig) == (said, 1e-4, {})
    assert known(rig_from_text(rig_text(rig, Path()), "bench.toml")) == known(rig)


def test_planes_are_read_in_metres_and_written_back():
    rig = rig_from_text(ROTOR, "bench.toml")
    assert known(rig)[2] == pytest.approx({"A.z_sd": 5e-4, "B.z_magnet_sd": 3e-4})
    assert known(rig_from_text(rig_text(rig, Path()), "bench.toml")) == known(rig)


@pytest.mark.parametrize(
    ("text", "sound", "damaged", "said"),
    [
        (AXIS, "gain_sd = 0.01", "gain_sd = -0.01", r"channels\.voltage\.gain_sd is -0\.01; it must not be negative"),
        (AXIS, "gain_sd = 0.01", "gain_sd = inf", r"channels\.voltage\.gain_sd is inf; it must be finite"),
        (AXIS, "gain_sd = 0.01", "gains_sd = 1", r"unknown key 'gains_sd' in \[channels\.voltage\].*'gain_sd'"),
        (AXIS, "offset_sd = 1e-6", "offset_sd = -1", r"channels\.position\.offset_sd is -1.*negative"),
        (AXIS, "offset_sd = 1e-6", "offset_sd = nan", r"channels\.position\.offset_sd is nan; it must be finite"),
        (AXIS, "offset_sd = 1e-6", 'offset_sd = "1 um"', r"channels\.position\.offset_sd is '1 um'.*number"),
        (AXIS, "value = 5.0", "value = -5.0", r"channels\.current\.offset_sd\.value is -5\.0.*negative"),
        (AXIS, '"mA"', '"mV"', r"channels\.current\.offset_sd is in \[mV\]; it is measured in \[A\]"),
        (AXIS, "value = 5.0,", "valu = 5.0,", r"unknown key 'valu' in \[channels\.current\.offset_sd\].*'value'"),
        (AXIS, "rate_sd = 1e-4", "rate_sd = -1e-4", r"record\.rate_sd is -0\.0001; it must not be negative"),
        (AXIS, "[record]", "[channels.reference]\ngain_sd = 0.1\n[record]", r"channels\.reference\.gain_sd .*Omit"),
        (
            AXIS, "[channels.position]\noffset_sd = 1e-6",
            '[[channels.position.sensors]]\ncolumn = "a"\ngain_sd = 0.1\n[[channels.position.sensors]]\ncolumn = "b"',
            r"channels\.position: sensors of one position are not joined\. Give one column",
        ),
        (ROTOR, "value = 0.5", "value = -0.5", r"bearings\.A\.z_sd\.value is -0\.5; it must not be negative"),
        (ROTOR, '{ value = 300, unit = "um" }', "3e-4", r"bearings\.B\.z_magnet_sd is 0\.0003; it must be a \[table\]"),
        (ROTOR, '"um"', '"mN"', r"bearings\.B\.z_magnet_sd is in \[mN\]; it is measured in \[m\]"),
        (ROTOR, "z_magnet_sd", "z_sensor_sd", r"bearings\.B\.z_sensor_sd is of planes that are measured and fixed"),
        (ROTOR, "axial = true", 'axial = true\nz_sd = { value = 1, unit = "mm" }', r"bearings\.T\.z_sd is of planes"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(text, sound, damaged, said):
    with pytest.raises(RigError, match=said) as failure:
        rig_from_text(text.replace(sound, damaged, 1), "bench.toml")
    assert "\n" not in str(failure.value)


def test_a_first_rig_asks_for_them(tmp_path):
    text = draft_rig(rotor_record.record())
    assert text.count("# gain_sd") == 12  # not of references
    assert text.count("# z_sd") == 2
    assert text.count("# rate_sd") == 1
    (path := tmp_path / "rig.toml").write_text(
        text.replace("# gain_sd", "gain_sd").replace("# z", "z").replace("# [record]", "[record]")
        .replace("# rate_sd", "rate_sd").replace("value = 0.0", "value = 1.0").replace("1.0", "2.0", 2)
    )  # fmt: skip
    rig = load_rig(path)
    assert {c.gain_sd for c in rig.channels if not c.role.endswith("reference")} == {0.01}
    assert rig.record.rate_sd == 1e-4
