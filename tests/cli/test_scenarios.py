"""``ambid simulate --scenario``: the record, its truth, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.physics.presets import preset
from ambid.record import read_record
from ambid.rig import default_rig, write_rig
from ambid.simulation import simulate_scenario, truth_columns
from ambid.simulation.scenarios import scenario_names

SHORT = ("--duration", "0.1", "--seed", "3", "--amplitude", "8")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def simulated(ambid, name, *words, out="r.csv"):
    return ambid("simulate", "unstable-bearing", "--scenario", name, "-o", out, *words)


def test_models_lists_the_scenarios(ambid):
    found = ambid("models")
    assert found.code == 0
    lines = found.out.splitlines()
    for name in scenario_names():
        assert any(line.startswith(f"  {name} ") for line in lines)
    assert max(map(len, lines)) <= 80


def test_a_change_is_written_with_its_truth_and_told(here, ambid):
    found = simulated(ambid, "change:-0.3@0.04", *SHORT)
    assert (found.code, found.err) == (0, "")
    assert "r.csv: 2000 samples at 20000 Hz, excitation of 8 V, seed 3" in found.out
    assert "truth: m 4, " in found.out
    assert "scenario change: k_i 55.7335 to 39.0135 N/A, from 0.04 s" in found.out
    record = read_record(here / "r.csv")
    k_i = truth_columns(record)["k_i"]
    assert k_i.unit == "N/A"
    assert k_i.values[[799, 800]] == pytest.approx([55.73352, 0.7 * 55.73352], rel=1e-6)
    wanted = simulate_scenario(
        "change", preset("unstable-bearing"), duration_s=0.1, seed=3, amplitude=8.0, at_s=0.04, size=-0.3
    )
    for name in wanted.record.names:
        assert np.array_equal(record[name], wanted.record[name])
    comments = read_record(here / "r.csv").provenance["comment"].splitlines()
    assert any("scenario change of -0.3 (relative change of k_i)" in line for line in comments)
    assert any("k_i 55.7335 to 39.0135" in line for line in comments)


def test_the_scenario_has_its_own_duration(here, ambid):
    assert simulated(ambid, "offset", "--amplitude", "1", out="r.h5").code == 0
    record = read_record(here / "r.h5")
    assert record.duration_s == pytest.approx(4.0)
    assert [s.settings["name"] for s in record.history if s.name == "scenario"] == ["offset"]


def test_a_spin_up_logs_speed_and_angle_and_the_excitation_on_request(here, ambid):
    assert simulated(ambid, "spin-up", *SHORT, "--log-excitation").code == 0
    record = read_record(here / "r.csv")
    assert record.names == (
        "voltage", "current", "position", "speed", "angle", "true_unbalance", "true_unbalance_phase", "excitation",
    )  # fmt: skip
    assert record.channel("true_unbalance").unit == "kg m"


def test_limits_that_are_met_are_told(here, ambid):
    found = simulated(ambid, "steady", "--duration", "0.1", "--amplitude", "100")
    assert found.code == 0
    assert "the command was limited" in found.err


def test_a_rig_takes_part(here, ambid):
    known, p = default_rig(), preset("unstable-bearing")
    parameters = tuple(replace(x, value=p.parameters[x.name]) for x in known.parameters)
    rig = replace(known, parameters=parameters, loop=p.loop, limits=p.limits, noise=p.noise,
                  record=replace(known.record, rate_hz=p.rate_hz))  # fmt: skip
    write_rig(rig, here / "rig.toml")
    found = ambid("simulate", "rig.toml", "--scenario", "added-mass", *SHORT, "-o", "new.csv")
    assert found.code == 0
    assert "scenario added-mass: m 4 to 4.4 kg" in found.out
    wanted = simulate_scenario("added-mass", p, duration_s=0.1, seed=3, amplitude=8.0).record
    read = read_record(here / "new.csv")
    for name in wanted.names:
        assert read[name] == pytest.approx(wanted[name], rel=1e-9, abs=1e-12)
    assert ambid("identify", "new.csv", "--rig", "rig.toml", "--to", "0.05").code == 0


REFUSED = {
    "a name of nothing": (("chnge",), "Did you mean 'change'"),
    "an excitation": (("change", "--excitation", "prbs"), "--excitation"),
    "a band": (("change", "--band", "1:50"), "--band"),
    "periods": (("change", "--periods", "2"), "--periods"),
    "a nonlinear plant": (("change", "--nonlinear"), "--nonlinear"),
    "a time outside": (("change@9",), "from 0 to 4 s"),
    "a size of nothing": (("steady:1",), "no size"),
    "too much": (("added-mass:-2",), "must stay positive"),
    "a size that is no number": (("change:x",), "it must be NAME[:SIZE][@SECONDS]"),
    "no finite size": (("change:inf",), "must be finite"),
    "no finite time": (("change@nan",), "from 0 to 4 s"),
    "the former size": (("change", "--size", "1"), "is now --scenario NAME:SIZE. Give that"),
    "no time at all": (("steady", "--duration", "0"), "must be a positive number"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_refused_on_one_line(here, ambid, case):
    words, said = REFUSED[case]
    found = simulated(ambid, *words)
    assert found.code == 2
    assert said in found.err
    assert len(found.err.splitlines()) == 1
    assert not list(here.iterdir())
