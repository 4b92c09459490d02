"""``ambid init --preset``: the rig of a bench with a controller, ready to be changed."""

import numpy as np
import pytest

from ambid import simulate as ambid_simulate
from ambid.acquisition.settings import controller_settings
from ambid.physics.presets import preset
from ambid.rig import load_rig, rig_of_preset
from ambid.rig.load import bench_record, read_bench


def test_the_prototypes_rig_is_written_and_its_controller_takes_it(bench, ambid):
    made = ambid("init", "--preset", "prototype", "-o", "bench.toml")
    assert (made.code, made.err) == (0, "")
    assert "ambid commission --rig bench.toml --port PORT" in made.out
    assert controller_settings(load_rig(bench / "bench.toml")).closed
    assert ambid("init", "--preset", "prototype").out == (bench / "bench.toml").read_text(encoding="utf-8")
    again = ambid("init", "--preset", "prototype", "-o", "bench.toml")
    assert again.code == 2
    assert "--force" in again.err


@pytest.mark.parametrize("options", [(), ("--nonlinear",), ("--scenario", "change:-0.05@0.5")])
def test_the_prototypes_rig_reads_what_a_simulation_of_it_writes(bench, ambid, options):
    ambid("init", "--preset", "prototype", "-o", "bench.toml")
    made = ambid("simulate", "prototype", "-o", "p.csv", "--duration", "1", "--seed", "1", *options)
    assert made.code == 0, made.err
    assert "duty [1]" in (bench / "p.csv").read_text(encoding="utf-8")
    rig = load_rig(bench / "bench.toml")
    read = read_bench(bench / "p.csv", rig)
    assert [read[role].unit for role in ("voltage", "current", "position")] == ["V", "A", "m"]
    assert 0.1 < read["voltage"].values.std() < 11.4  # in volts, not in counts
    assert np.abs(read["position"].values).max() < 1e-3
    by_python = ambid_simulate("prototype", duration=1.0, seed=1)
    if not options:
        by_role = ambid_simulate(rig_of_preset(preset("prototype")), duration=1.0, seed=1)
        for role in ("voltage", "current", "position"):
            np.testing.assert_array_equal(bench_record(by_python, rig)[role].values, read[role].values)
            np.testing.assert_allclose(by_role[role].values, read[role].values, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "neither a record nor --preset was given"),
        (("record.csv", "--preset", "prototype"), "both a record and --preset were given"),
        (
            ("--preset", "prototyp"),
            "--preset 'prototyp' is unknown; known: thesis, unstable-bearing,",
        ),
        (("--preset", "prototyp"), "Did you mean 'prototype'?"),
        (("--preset", "prototype", "--rate", "100"), "--rate, --gaps and --layout are for reading a record"),
    ],
)
def test_what_makes_no_rig_is_refused_in_one_line(bench, ambid, words, said):
    refused = ambid("init", *words, "-o", "bench.toml")
    assert refused.code == 2
    assert said in refused.err
    assert refused.err.count("\n") == 1
    assert not (bench / "bench.toml").exists()
