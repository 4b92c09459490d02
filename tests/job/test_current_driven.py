"""One axis driven by a current: measured, which goes on between samples, or commanded, which is held."""

from pathlib import Path

import numpy as np
import pytest

import ambid
from ambid.errors import RecordError, RigError
from ambid.physics.presets import preset
from ambid.rig import read_bench, rig_from_text, rig_text

RIG = """schema = "ambid.rig/1"
model = "rotor"
[channels.{key}]
column = "current"
[channels.position]
[parameters]
m = {{ value = {m!r}, unit = "kg", role = "fixed" }}
c = {{ value = 0.0, unit = "N s/m" }}
k_x = {{ value = {k_x!r}, unit = "N/m" }}
k_i = {{ value = {k_i!r}, unit = "N/A" }}
"""
LOOP = """[loop]
kp = 20000.0
kd = 20.0
delay = 1.0
[noise]
position = 1e-7
force = 0.003
"""
UNITS = {"current": "A", "position": "m"}


def of_coil(name, seed):
    """Current and position of a bench whose coil a held voltage drives."""
    record = ambid.simulate(name, duration=2.0, seed=seed, closed=True)
    return {role: record[role].values for role in UNITS}, record.rate_hz, dict(preset(name).parameters)


def rig(key, theta):
    return RIG.format(key=key, **{name: theta[name] for name in ("m", "k_x", "k_i")})


@pytest.mark.parametrize(("name", "seed"), [("rmit-axis", 1), ("unstable-bearing", 2), ("levitated-ball", 3)])
def test_a_measured_current_leaves_the_damping_where_it_is(name, seed):
    columns, rate_hz, theta = of_coil(name, seed)
    found = ambid.identify(columns, rig("current", theta), rate_hz=rate_hz, units=UNITS)
    assert found.verdict.word == "usable"
    assert found.delay["current"].samples == 0
    for parameter, true in (("k_x", theta["k_x"]), ("k_i", theta["k_i"]), ("c", 0.0)):
        assert abs(found[parameter].value - true) < 4.0 * found[parameter].sd
    assert "mean_to_next" in " ".join(found.record["history"])
    again = ambid.identify(columns, rig("command", theta), rate_hz=rate_hz, units=UNITS)
    assert abs(again["c"].value) > 2.0 * abs(found["c"].value)


def test_a_current_that_bends_between_samples_is_told_and_held():
    """With k_i²/(L m) of (0.4 samples)⁻² the back-EMF bends the current within a sample."""
    columns, rate_hz, theta = of_coil("thesis", 1)
    found = ambid.identify(columns, rig("current", theta), rate_hz=rate_hz, units=UNITS)
    assert found.verdict.word == "caution"
    check = found.checks["current_between_samples"]
    assert not check.passed
    assert check.cause == "sampling"
    assert abs(found["k_i"].value - theta["k_i"]) < 3.0 * found["k_i"].sd


def test_a_commanded_current_is_held_and_comes_late():
    theta = {"m": 0.1, "k_x": -8.7e4, "k_i": 20.0}
    text = rig("command", theta) + LOOP
    record = ambid.simulate(text, duration=2.0, rate_hz=1e4, amplitude=0.3, band=(2.0, 1500.0), seed=1)
    found = ambid.identify(record, text)
    assert found.delay["current"].samples + found.delay["current"].fraction == pytest.approx(1.0, abs=0.02)
    for parameter, true in (("k_x", theta["k_x"]), ("k_i", theta["k_i"]), ("c", 0.0)):
        assert abs(found[parameter].value - true) < 4.0 * found[parameter].sd
    assert found.checks["residuals_white"].passed
    with pytest.warns(UserWarning, match=r"held over each sample.*\[channels.command\]"):
        ambid.simulate(text.replace(".command", ".current"), duration=0.1, rate_hz=1e4, amplitude=0.1, seed=1)


def test_a_second_record_and_a_track_see_the_current_as_the_estimate_does(tmp_path):
    columns, rate_hz, theta = of_coil("rmit-axis", 1)
    other, _, _ = of_coil("rmit-axis", 2)
    found = ambid.identify(columns, rig("current", theta), rate_hz=rate_hz, units=UNITS)
    found.save(tmp_path / "e.json")
    read = ambid.load(tmp_path / "e.json").validate(ambid.simulate("rmit-axis", duration=2.0, seed=2, closed=True))
    assert read.verdict.word == "usable"
    given = rig("current", theta).replace('unit = "N s/m"', 'unit = "N s/m", role = "fixed"')
    track = ambid.track(other, given, rate_hz=rate_hz, units=UNITS)
    last = track.lines[-1].parameters
    assert track.verdict.word == "usable"
    assert all(abs(last[name].value - theta[name]) < 4.0 * last[name].sd for name in ("k_x", "k_i"))


def test_what_the_model_leaves_out_is_named_or_taken_in():
    columns, rate_hz, theta = of_coil("rmit-axis", 1)
    text = rig("current", theta).replace('unit = "N s/m"', 'unit = "N s/m", role = "fixed"')
    other = of_coil("rmit-axis", 2)[0]["position"]
    x, i = columns["position"], columns["current"]
    hum = 0.1 * x.std() * np.sin(2.0 * np.pi * 53.7 * np.arange(x.size) / rate_hz)

    def found(current, position):
        return ambid.identify({"current": current, "position": position}, text, rate_hz=rate_hz, units=UNITS)

    with_line, late, apart = found(i, x + hum), found(0.5 * (i + np.roll(i, 1)), x), found(i, other)
    assert with_line.verdict.word == "usable"
    assert with_line.extended == ("line (53.7 Hz)",)
    assert all(abs(with_line[name].value - theta[name]) < 4.0 * with_line[name].sd for name in ("k_x", "k_i"))
    assert late.checks["causes"].cause == "current_lag"
    assert late.checks["causes"].size == pytest.approx(0.5 / rate_hz, rel=0.3)
    assert apart.verdict.word == "unusable"
    assert apart.checks["belonging"].cause == "belonging"
    assert not {"ohm", "sampling", "in_time", "loop_agrees"} & with_line.checks.keys()


def test_a_lag_of_a_sample_is_named_and_not_taken_in_by_its_first_order():
    columns, rate_hz, theta = of_coil("rmit-axis", 1)
    columns["position"] = np.append(columns["position"][0], columns["position"][:-1])
    found = ambid.identify(columns, rig("current", theta), rate_hz=rate_hz, units=UNITS)
    assert found.verdict.word == "caution"
    assert not found.extended
    named = found.checks["causes"]
    assert {"sensor_lag", "eddy_pole"} <= {named.cause, *named.alternatives}
    assert named.size * rate_hz > 0.5
    assert all(abs(found[name].value - theta[name]) < 4.0 * found[name].sd for name in ("k_x", "k_i"))


def test_a_rig_keeps_what_drives_it():
    theta = {"m": 0.1, "k_x": -8.7e4, "k_i": 20.0}
    told = rig_from_text(rig("command", theta), "rig.toml")
    assert told.channel("current").commanded
    assert told.channel("current").delay == "auto"
    measured, squares = rig_from_text(rig("current", theta), "rig.toml"), np.arange(10.0) ** 2
    record = read_bench({"current": squares, "position": np.zeros(10)}, measured, rate_hz=1e3, units=UNITS)
    assert read_bench(record, measured)["current"].values[4] == pytest.approx(20.0 + 1.0 / 3.0)
    with pytest.raises(RecordError, match="read with a measured current"):
        read_bench(record, told)
    assert rig_from_text(rig_text(told, Path()), "rig.toml").channels == told.channels
    assert rig_from_text(rig("current", theta), "rig.toml").channel("current").delay == 0
    both = rig("command", theta).replace("[channels.position]", '[channels.current]\ncolumn = "i"\n[channels.position]')
    with pytest.raises(RigError, match=r"\[channels.current\] is measured and \[channels.command\] commanded"):
        rig_from_text(both, "rig.toml")
