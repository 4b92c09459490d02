"""The checks that tell whether a delay can hide in a parameter, and whether fixed values hold."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.job import identify
from ambid.physics.linear_model import model
from ambid.physics.loop import Loop, Noise
from ambid.rig import default_rig
from ambid.simulation import LinearPlant, simulate

RATE = 1000.0


def judged(rt, fraction, seed, given=None, noise=0.02):
    """The estimate of a coil with R T / L = `rt` from steps of the voltage, and how many sd its L is off."""
    truth = {"R": 2.0, "L": 2.0 / rt / RATE}
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], 500), rng.integers(1, 20, 500))[:4000]
    done = simulate(
        LinearPlant(model=model("coil"), parameters=truth), u, rate_hz=RATE, seed=rng, loop=Loop(delay=fraction),
        noise=Noise.held(rate_hz=RATE, current=noise),
    )  # fmt: skip
    rig = default_rig("coil")
    if given is not None:
        rig = replace(rig, channels=tuple(replace(c, delay=given) if c.role == "voltage" else c for c in rig.channels))
    estimate = identify(done.record, rig)
    L = next(p for p in estimate.parameters if p.name == "L")
    return estimate, (L.value - truth["L"]) / L.sd


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.03, 0.3, 0.97])
def test_a_coil_that_the_rate_resolves_passes_and_is_right(fraction):
    for seed in range(3):
        estimate, off = judged(0.2, fraction, seed)
        assert estimate.checks["delay_shown"].passed
        assert abs(off) < 3.3


def test_a_delay_that_hides_in_the_inductance_is_named():
    wrong = 0
    for seed in range(10):
        estimate, off = judged(3.0, 0.15, seed)
        check = estimate.checks["delay_shown"]
        failed = {k for k, c in estimate.checks.items() if not c.passed} - {"signals_sound"}
        assert not check.passed or abs(off) < 3.3
        if abs(off) > 3.3:
            wrong += 1
            assert failed == {"delay_shown", "sampling"}  # no test of the innovations sees it
            assert 0.15 < check.values["unseen_samples"] <= 1.0
            assert abs(off) < check.values["shift_sd"]
            assert "could bias L" in check.detail
    assert wrong >= 5


def test_a_delay_that_is_given_leaves_nothing_unseen():
    for seed in range(5):
        estimate, off = judged(3.0, 0.15, seed, given=0.15)
        assert estimate.checks["delay_shown"].passed
        assert abs(off) < 3.3


def test_a_fixed_value_of_which_nothing_can_be_told_does_not_pass(monkeypatch):
    monkeypatch.setattr("ambid.estimation.likelihood.free_one", lambda fit, name: (np.nan, np.full(1, np.nan)))
    u = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 100), 10)
    plant = LinearPlant(model=model("coil"), parameters={"R": 2.0, "L": 0.01})
    record = simulate(plant, u, rate_hz=RATE, seed=1, noise=Noise.held(rate_hz=RATE, current=0.02)).record
    rig = default_rig("coil")
    known = (replace(p, role="fixed", value=2.0) if p.name == "R" else p for p in rig.parameters)
    check = identify(record, replace(rig, parameters=tuple(known))).checks["fixed_agree"]
    assert not check.passed
    assert "cannot be told" in check.detail
