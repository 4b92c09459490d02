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
    assert any("does not begin at rest" in x for x in late["warnings"])
    refused = ambid("fit", "step.csv", "--structure", "iv4", *words)
    assert refused.code != 0
    assert "iv4 cannot be told that a record begins at rest; fir, arx, armax" in " ".join(refused.err.split())
