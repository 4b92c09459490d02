"""``ambid fit``: what its own options do."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.signal import lfilter


@pytest.fixture
def step(tmp_path, monkeypatch):
    """A response from rest to a step at its first sample, after 0.5 s of it too."""
    monkeypatch.chdir(tmp_path)
    t = np.arange(400) / 100.0
    u = np.ones(t.size)
    y = lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], u) + 0.05 * np.random.default_rng(1).standard_normal(t.size)
    table = np.column_stack([t, u, y])
    np.savetxt(tmp_path / "step.csv", table, delimiter=",", header="time [s],u [V],y [A]", comments="")
    np.savetxt(tmp_path / "late.csv", table[5:], delimiter=",", header="time [s],u [V],y [A]", comments="")
    return tmp_path


def test_a_step_from_rest(step, ambid):
    words = ("--input", "u", "--output", "y", "--open-loop", "--orders", "nb=2,nf=2,nk=1", "--at-rest")
    found = ambid("fit", "step.csv", "--structure", "oe", *words, "--json", "-")
    assert found.code == 0
    fit = json.loads(found.out)
    assert fit["details"]["at_rest"] is True
    assert fit["offsets"] == {"inputs": {"u": 0.0}, "outputs": {"y": 0.0}}
    np.testing.assert_allclose(fit["polynomials"]["F"], [1.0, -1.5, 0.7], atol=0.05)
    assert not any("rest" in x for x in fit["warnings"])
    late = json.loads(ambid("fit", "late.csv", "--structure", "oe", *words, "--json", "-").out)
    assert any("does not start at rest" in x for x in late["warnings"])
    refused = ambid("fit", "step.csv", "--structure", "iv4", *words)
    assert refused.code != 0
    assert "structure iv4 cannot start at rest; fir, arx, armax" in " ".join(refused.err.split())


@pytest.fixture(scope="module")
def bearing(tmp_path_factory):
    """A levitated bearing and its rig, 1 s."""
    from ambid.cli import run

    folder = tmp_path_factory.mktemp("bearing")
    record = str(folder / "loop.csv")
    assert (
        run(["simulate", "unstable-bearing", "-o", record, "--duration", "1", "--band", "5:2000", "--seed", "3"]) == 0
    )
    assert run(["init", record, "-o", str(folder / "rig.toml")]) == 0
    return folder


def test_with_a_rig_physical_parameters_follow(bearing, ambid, monkeypatch):
    monkeypatch.chdir(bearing)
    words = ("--rig", "rig.toml", "--structure", "pbsid", "--orders", "n=4", "--json", "fit.json", "--strict")
    found = ambid("fit", "loop.csv", *words)
    assert found.code == 0, found.err
    assert "physical parameters of model one-axis, from pbsid" in found.out
    assert max(map(len, found.out.splitlines())) <= 80
    document = json.loads((bearing / "fit.json").read_text())
    assert (document["inputs"], document["outputs"]) == (["voltage"], ["position", "current"])
    physical = document["physical"]
    assert physical["misfit"]["passed"]
    assert physical["delay"]["samples"] == 1
    truth = {"m": 4.0, "k_x": -129.01e3, "k_i": 55.734, "R": 1.6, "L": 26.0769e-3}
    for name, true in truth.items():
        p = physical["parameters"][name]
        assert abs(p["value"] - true) < 4 * p["sd"], name
        assert p["sd"] < 0.05 * abs(true), name
    judged = ambid("validate", "fit.json", "loop.csv")
    assert judged.code == 0


def test_a_fit_that_cannot_carry_the_rig_s_model_is_refused(bearing, ambid, monkeypatch):
    monkeypatch.chdir(bearing)
    words = ("--rig", "rig.toml", "--structure", "pbsid", "--orders", "n=2", "--output", "position")
    refused = ambid("fit", "loop.csv", *words, "--json", "none.json")
    assert refused.code == 2
    assert len(refused.err.splitlines()) == 1
    assert not (bearing / "none.json").exists()
