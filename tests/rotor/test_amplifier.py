"""Axes of which the command of the amplifier alone is logged (thesis eq. 1.5): what shows, and what does not."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.errors import RigError
from ambid.rig import bench_record, rig_from_text
from ambid.rotor.spectra import experiments_of

AXES = ("ax", "ay")
RIG = """
schema = "ambid.rig/1"
name = "amplifiers"
model = "rotor"
[bearings.A]
z = { value = 70.0, unit = "mm" }
z_sensors = [{ value = 40.0, unit = "mm" }, { value = 90.0, unit = "mm" }]
axes = ["ax"]
[bearings.B]
z = { value = 330.0, unit = "mm" }
z_sensor = { value = 360.0, unit = "mm" }
axes = ["bx"]
[channels.ax_command]
[channels.bx_command]
[channels.ax_position]
[channels.ax_position2]
[channels.bx_position]
[parameters]
m = { value = 4.0, unit = "kg", role = "fixed" }
Id = { value = 36.5, unit = "g m^2" }
z_cg = { value = 200.0, unit = "mm" }
"ax.k_i" = { value = 61.0, unit = "N/A" }
"ax.k_x" = { value = -150.0, unit = "kN/m" }
"ax.amplifier_gain" = { value = 0.2, unit = "A/V", role = "fixed" }
"ax.amplifier_pole" = { value = 3000.0, unit = "rad/s" }
"bx.k_i" = { value = 58.0, unit = "N/A" }
"bx.k_x" = { value = -140.0, unit = "kN/m" }
"bx.amplifier_gain" = { value = 0.2, unit = "A/V", role = "fixed" }
"bx.amplifier_pole" = { value = 4000.0, unit = "rad/s" }
[loop]
kp = 3.0e4
ki = 3.0e5
kd = 65.0
derivative_cutoff_hz = 2000.0
delay = 1.0
limits = { voltage = 50.0, current = 2.0, position = 2e-4 }
[noise]
position = 1e-7
force = 1e-3
[record]
rate_hz = 10000.0
"""


def test_commands_and_positions_show_poles_and_the_product_of_gain_and_force_factor() -> None:
    rig = rig_from_text(RIG, "amplifiers.toml")
    record = ambid.simulate(rig, duration=1.0, periods=4, seed=1)
    assert record.names[:2] == ("ax_command", "bx_command")
    found = ambid.identify(record, replace(rig, modes=replace(rig.modes, count=0)))
    for name, truth in {"ax.k_i": 61.0, "bx.k_x": -140e3, "Id": 0.0365, "ax.amplifier_pole": 3000.0}.items():
        p = found[name]
        assert p.identifiable
        assert abs(p.value - truth) < 3.5 * p.sd < 0.2 * abs(truth), name
    parameters = tuple(replace(p, role="free") if p.name.endswith("amplifier_gain") else p for p in rig.parameters)
    found = ambid.identify(record, replace(rig, parameters=parameters, modes=replace(rig.modes, count=0)))
    assert not found["ax.k_i"].identifiable
    assert not found["ax.amplifier_gain"].identifiable
    assert found["ax.amplifier_pole"].identifiable
    assert "as a product only: give one of them as fixed" in str(found.checks["identifiable"].detail)


def test_experiments_of_an_orthogonal_excitation_are_taken_as_records_of_one_rotor() -> None:
    rig = rig_from_text(RIG, "amplifiers.toml")
    record = ambid.simulate(rig, duration=2.0, periods=4, seed=2, excitation="orthogonal")
    assert rig.rotor is not None
    parts = experiments_of(record, rig.rotor)
    assert [(round(p.start_s, 3), p.n_samples) for p in parts] == [(0.0, 10_000), (1.0, 10_000)]
    found = ambid.identify(record, replace(rig, modes=replace(rig.modes, count=0)))
    assert len(found.records) == 2
    assert found.verdict.word == "usable"
    for name, truth in {"ax.k_i": 61.0, "bx.k_i": 58.0, "bx.amplifier_pole": 4000.0}.items():
        assert abs(found[name].value - truth) < 3.5 * found[name].sd < 0.1 * truth, name
    short = ambid.simulate(rig, duration=1.0, periods=2, seed=2, excitation="orthogonal")
    assert experiments_of(short, rig.rotor) == (short,)  # two periods leave none after a transient
    assert len(experiments_of(ambid.simulate(rig, duration=1.0, excitation="gaussian"), rig.rotor)) == 1


def test_an_axis_that_nothing_drives_is_refused() -> None:
    with pytest.raises(RigError, match=r"axis 'bx' has none of \[channels.bx_voltage\]"):
        rig_from_text(RIG.replace("[channels.bx_command]\n", ""), "amplifiers.toml")


def test_a_command_in_ampere_is_taken_as_the_volts_of_an_amplifier_of_one_ampere_a_volt() -> None:
    rig = rig_from_text(RIG, "amplifiers.toml")
    record = ambid.simulate(rig, duration=0.5, periods=4, seed=1)
    units = {name: "A" if name.endswith("_command") else "m" for name in record.names if "reference" not in name}
    in_ampere = ambid.read_record({name: record[name].values for name in units}, rate_hz=1e4, units=units)
    seen = bench_record(in_ampere, rig)
    assert seen["ax_command"].unit == "V"
    np.testing.assert_array_equal(seen["ax_command"].values, record["ax_command"].values)
    assert any("ax_command" in str(step) for step in seen.history)
