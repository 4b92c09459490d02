"""Each verb does what contracts.md says, writes what it is asked for, and nothing when it fails."""

import json
import tomllib

import numpy as np
import pytest

from ambid.physics.presets import preset
from ambid.record import read_record
from ambid.rig import load_rig

PARAMETERS = ["m", "k_x", "k_i", "R", "L", "c"]
PNG = b"\x89PNG\r\n\x1a\n"


def test_identify_prints_a_table_that_fits_80_columns_without_colour(bench, ambid):
    found = ambid("identify", "record.csv", "--rig", "rig.toml")
    assert (found.code, found.err) == (0, "")
    lines = found.out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "\x1b" not in found.out
    for name in PARAMETERS[:-1]:
        (line,) = [x for x in lines if x.startswith(f"{name} ")]
        assert " ± " in line
        assert " … " in line
        assert line.endswith("identified")
    assert any(x.startswith("c ") and x.endswith("fixed") for x in lines)
    assert any(x.startswith("delay of voltage: 1 sample") for x in lines)
    assert sum(x.startswith("✓ ") for x in lines) >= 6


def test_identify_writes_the_contract_s_json(bench, ambid):
    found = ambid("identify", "record.csv", "--json", "found.json")  # without a rig: columns named by role
    assert found.code == 0
    estimate = json.loads((bench / "found.json").read_text())
    assert estimate["schema"] == "ambid.estimate/1"
    assert estimate["status"] == "converged"
    assert estimate["record"].keys() >= {"samples", "rate_hz", "sha256"}
    assert list(estimate["parameters"]) == PARAMETERS
    for p in estimate["parameters"].values():
        assert p.keys() >= {"value", "sd", "ci95", "unit", "role", "identifiable"}
    assert estimate["delay"]["voltage"]["samples"] == 1
    assert estimate["continuous"].keys() >= {"states", "A", "B", "C", "poles"}
    for f in estimate["fit"].values():
        assert 0 < f["one_step"] < 1
        assert f["simulation"] is None  # unstable in open loop
    assert estimate["checks"].keys() >= {"residuals_white", "residuals_uncorrelated", "identifiable"}
    assert estimate["validation"] is None
    assert estimate["warnings"] == []
    assert estimate["timing_s"].keys() >= {"read", "fit", "checks"}


def test_json_to_standard_output_is_all_that_is_there(bench, ambid):
    found = ambid("identify", "record.csv", "--json", "-")
    assert json.loads(found.out)["schema"] == "ambid.estimate/1"
    assert found.err == ""


def test_identify_draws_and_reports(bench, ambid):
    found = ambid("identify", "record.csv", "--rig", "rig.toml", "--plot", "a.png", "--report", "a.html")
    assert found.code == 0
    assert (bench / "a.png").read_bytes().startswith(PNG)
    page = (bench / "a.html").read_text()
    assert "identified" in page
    assert sorted(p.name for p in bench.iterdir()) == ["a.html", "a.png", "record.csv", "rig.toml"]


def test_a_report_may_be_a_pdf_and_is_drawn_again(bench, ambid):
    for said in ("", "a.pdf is replaced\n"):
        found = ambid("info", "record.csv", "--report", "a.pdf")
        assert (found.code, found.err) == (0, said)
        assert (bench / "a.pdf").read_bytes().startswith(b"%PDF")
    assert sorted(p.name for p in bench.iterdir()) == ["a.pdf", "record.csv", "rig.toml"]


def test_a_second_record_is_judged_and_counts_under_strict(bench, ambid, record_text):
    lines = record_text.splitlines()
    (bench / "first.csv").write_text("\n".join(lines[:2402]) + "\n")
    (bench / "second.csv").write_text("\n".join(lines[:2] + lines[2402:]) + "\n")
    good = ambid("identify", "first.csv", "--validate", "second.csv", "--json", "found.json", "--strict")
    assert good.code == 0
    assert "on the second record (600 samples)" in good.out
    own = ambid("identify", "first.csv", "--validate", "first.csv", "--json", "none.json")
    assert (own.code, own.err.count("\n")) == (2, 1)
    assert "holds samples that the estimate is fitted to" in own.err
    judged = ambid("validate", "found.json", "second.csv", "--json", "-", "--strict")
    assert judged.code == 0
    document = json.loads(judged.out)
    assert document["schema"] == "ambid.validation/1"
    assert document["passed"] is True
    stored = json.loads((bench / "found.json").read_text())["validation"]
    for role, fit in document["fit"].items():
        assert fit["one_step"] == pytest.approx(stored["fit"][role]["one_step"], abs=1e-9)
    # a bench whose position sensor reads half: the estimate must not pass on it
    values = np.loadtxt(lines[2402:], delimiter=",")
    values[:, 3] *= 0.5
    rows = [",".join(f"{x:.6g}" for x in row) for row in values]
    (bench / "other.csv").write_text("\n".join([lines[1], *rows]) + "\n")
    assert ambid("validate", "found.json", "other.csv").code == 0
    bad = ambid("validate", "found.json", "other.csv", "--strict")
    assert bad.code == 3
    assert "✗ innovations_consistent" in bad.out


def test_from_and_to_choose_the_part(bench, ambid):
    found = ambid("identify", "record.csv", "--from", "0.05", "--to", "0.125", "--json", "-")
    estimate = json.loads(found.out)
    assert estimate["record"]["samples"] == 1500
    assert any(step.startswith("cut(") for step in estimate["record"]["history"])


def test_strict_ends_with_3_where_a_check_failed(bench, ambid, rig_text):
    # a mass fixed at twice its value contradicts the record
    (bench / "rig.toml").write_text(
        rig_text.replace('m   = { unit = "kg" }', 'm = { value = 8.0, unit = "kg", role = "fixed" }')
    )
    words = ("identify", "record.csv", "--rig", "rig.toml")
    assert ambid(*words).code == 0
    strict = ambid(*words, "--strict", "--json", "found.json")
    assert strict.code == 3
    assert "✗ " in strict.out
    assert (bench / "found.json").exists()


def test_init_writes_a_rig_that_is_read_and_never_writes_over_one(bench, ambid):
    made = ambid("init", "record.csv", "-o", "new.toml")
    assert made.code == 0
    assert "ambid identify record.csv --rig new.toml" in made.out
    assert load_rig(bench / "new.toml").channel("current").column == "current"
    again = ambid("init", "record.csv", "-o", "new.toml")
    assert again.code == 2
    assert "--force" in again.err
    assert ambid("init", "record.csv", "-o", "new.toml", "--force").code == 0
    printed = ambid("init", "record.csv")
    assert tomllib.loads(printed.out) == tomllib.loads((bench / "new.toml").read_text())


def test_simulate_gives_equal_records_for_equal_seeds_and_says_the_truth(bench, ambid):
    words = ("simulate", "rmit-axis", "--duration", "0.05", "--amplitude", "5", "--band", "10:1000")
    one = ambid(*words, "--seed", "7", "-o", "one.csv")
    assert (one.code, one.err) == (0, "")
    assert "k_i 61" in one.out
    assert ambid(*words, "--seed", "7", "-o", "two.csv").code == 0
    assert ambid(*words, "--seed", "8", "-o", "three.csv").code == 0
    assert (bench / "one.csv").read_bytes() == (bench / "two.csv").read_bytes()
    assert (bench / "one.csv").read_bytes() != (bench / "three.csv").read_bytes()
    record = read_record(bench / "one.csv")
    assert record.n_samples == 1000
    assert record.rate_hz == preset("rmit-axis").rate_hz
    assert "seed 7" in record.provenance["comment"]


def test_simulate_warns_of_limits_and_an_unstable_loop(bench, ambid):
    found = ambid("simulate", "rmit-axis", "-o", "x.h5", "--duration", "0.05", "--amplitude", "200", "--loop", "open")
    assert found.code == 0
    assert "ambid: warning: the loop is unstable" in found.err
    assert "the rotor touched a stop" in found.err
    assert read_record(bench / "x.h5").n_samples == 1000


def test_simulate_finds_an_amplitude_within_the_limits(bench, ambid):
    found = ambid("simulate", "unstable-bearing", "-o", "x.csv", "--duration", "0.05", "--seed", "1")
    assert (found.code, found.err) == (0, "")
    limits, record = preset("unstable-bearing").limits, read_record(bench / "x.csv")
    for role in ("voltage", "position"):
        reach = float(np.abs(record[role]).max()) / getattr(limits, role)[1]
        assert reach < 0.51
    assert "of " in found.out


def test_simulate_runs_a_rig_and_its_record_fits_the_rig(bench, ambid):
    (bench / "coil.toml").write_text(
        'schema = "ambid.rig/1"\nname = "coil"\nmodel = "coil"\n'
        '[channels.voltage]\ncolumn = "u"\n[channels.current]\ncolumn = "i"\ngain = 0.1\n'
        '[parameters]\nR = { value = 1.564, unit = "ohm" }\nL = { value = 1.818, unit = "mH" }\n'
        "[noise]\ncurrent = 1e-3\n[record]\nrate_hz = 20000.0\n"
    )
    words = ("simulate", "coil.toml", "-o", "coil.csv", "--duration", "0.1", "--excitation", "prbs")
    refused = ambid(*words)
    assert refused.code == 2
    assert "--amplitude" in refused.err
    assert ambid(*words, "--amplitude", "5").code == 0
    found = json.loads(ambid("identify", "coil.csv", "--rig", "coil.toml", "--json", "-").out)
    for name, true in (("R", 1.564), ("L", 1.818e-3)):
        p = found["parameters"][name]
        assert abs(p["value"] - true) < 3.3 * p["sd"]
        assert p["sd"] < 0.01 * true


def test_info_shows_levels_noise_and_excitation(bench, ambid):
    plain = ambid("info", "record.csv")
    assert plain.code == 0
    assert "3000 samples at 20000 Hz, 0.15 s from 0 s" in plain.out
    assert max(map(len, plain.out.splitlines())) <= 80
    for name in ("voltage", "current", "position"):
        assert any(line.startswith(f"{name} ") for line in plain.out.splitlines())
    assert "✓ no saturation, drop-outs or outliers" in plain.out
    by_role = ambid("info", "record.csv", "--rig", "rig.toml")
    assert "noise is the part that 20 lags of the channel and of voltage do not predict" in by_role.out
    assert "voltage: persistently exciting of order at least" in by_role.out


def test_info_reports_faults(bench, ambid, record_text):
    lines = record_text.splitlines()
    values = np.loadtxt(lines[2:], delimiter=",")
    values[:, 3] = np.clip(values[:, 3], -10, 10)
    values[:, 2] = 4.0
    rows = [",".join(f"{x:.6g}" for x in row) for row in values]
    (bench / "bad.csv").write_text("\n".join([lines[1], *rows]) + "\n")
    found = ambid("info", "bad.csv")
    assert found.code == 0
    assert found.out.startswith("verdict: use with caution\n")
    assert "✗ saturation: position: " in found.out
    assert "✗ drop-outs: current: never changes" in found.out
    assert ambid("info", "bad.csv", "--strict").code == 3


def test_models_lists_everything_with_units(ambid):
    found = ambid("models")
    assert found.code == 0
    for word in ("one-axis", "coil", "rotor", "k_x  [N/m]", "multisine", "unstable-bearing", "rmit", "thesis"):
        assert word in found.out
    assert max(map(len, found.out.splitlines())) <= 80
