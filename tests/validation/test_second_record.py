"""An estimate on other data of the same bench, of another bench, and on data it cannot judge."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing.linear import Signals
from ambid.errors import EstimationError
from ambid.job import identify, signals_of
from ambid.physics.linear_model import model
from ambid.physics.loop import Noise
from ambid.physics.presets import preset
from ambid.signals import multisine
from ambid.simulation import simulate_preset
from ambid.validation.second_record import replay, validation
from tests.tiers import runs

BEARING = preset("unstable-bearing")


def record(seed, n=4000, name="unstable-bearing", **changes):
    bench = replace(preset(name), **changes)
    u = multisine(n, bench.rate_hz, amplitude=5.0, band=(5.0, 2000.0), seed=seed, amplitude_is="rms")
    return simulate_preset(bench, u, seed=seed).record


@pytest.fixture(scope="module")
def estimate():
    return identify(record(1))


def signals(rec):
    return signals_of(rec, model("one-axis"))


def test_the_same_bench_passes(estimate):
    found = validation(estimate, signals(record(2)))
    assert found["passed"]
    assert all(c["passed"] for c in found["checks"].values())
    assert set(found["fit"]) == {"position", "current"}
    for role, fit in found["fit"].items():
        assert fit["one_step"] == pytest.approx(estimate.fit[role].one_step, abs=0.03)
        assert fit["simulation"] is None  # unstable in open loop
        assert fit["k_step"]["1"] == pytest.approx(fit["one_step"], abs=1e-9)
        assert fit["k_step"]["1"] >= fit["k_step"]["10"] >= fit["k_step"]["100"]
        assert fit["innovation_rms"] == pytest.approx(estimate.fit[role].innovation_sd, rel=0.1)


def test_false_alarms_are_rare(estimate):
    # of a bench that has not changed: the tests' threshold is 0.001; what the gain does not know adds a little
    n = runs(30, short=10)
    found = [validation(estimate, signals(record(100 + s, n=3000))) for s in range(n)]
    p = np.array([[v["checks"][c]["p"] for c in ("residuals_white", "residuals_uncorrelated")] for v in found])
    assert np.sum(p < 1e-3) <= 2
    assert n.limit(0.25, centre=0.5) < np.median(p) < n.limit(0.75, centre=0.5)


@pytest.mark.parametrize(
    ("name", "factor"), [("m", 1.3), ("k_x", 1.3), ("k_i", 0.85), ("R", 2.0), ("L", 1.1)], ids=lambda x: str(x)
)
def test_another_bench_does_not(estimate, name, factor):
    changed = {**BEARING.parameters, name: factor * BEARING.parameters[name]}
    found = validation(estimate, signals(record(3, n=8000, parameters=changed)))
    assert not found["passed"]
    assert not found["checks"]["residuals_uncorrelated"]["passed"] or not found["checks"]["residuals_white"]["passed"]


def test_a_noisier_sensor_is_named(estimate):
    noisy = replace(BEARING.noise, position=4 * BEARING.noise.position)
    found = validation(estimate, signals(record(4, noise=noisy)))
    check = found["checks"]["innovations_consistent"]
    assert not check["passed"]
    assert "position" in check["detail"]
    assert check["position_ratio"] > 1.5


def test_offsets_of_the_other_record_do_not_count(estimate):
    s = signals(record(5))
    moved = replace(s, u=s.u + 2.0, y=s.y + np.array([1e-4, 0.3]))
    one, other = validation(estimate, s), validation(estimate, moved)
    for role in ("position", "current"):
        assert other["fit"][role]["one_step"] == pytest.approx(one["fit"][role]["one_step"], abs=1e-6)


def test_replay_keeps_the_records_units_and_places(estimate):
    rec = record(6, n=1500)
    s = replace(signals(rec), y=signals(rec).y + np.array([1e-3, 0.5]))
    run = replay(estimate, s)
    assert run.first + run.measured.shape[0] == 1500
    np.testing.assert_allclose(run.measured, s.y[run.first :], rtol=1e-12)
    np.testing.assert_allclose(run.predicted + run.innovations, run.measured, rtol=1e-12)
    assert run.simulated is None


def test_a_stable_plant_is_simulated_too():
    found = identify(record(1, n=6000, name="thesis", noise=Noise(position=5e-7, current=1e-4)))
    run = replay(found, signals(record(2, n=3000, name="thesis", noise=Noise(position=5e-7, current=1e-4))))
    error = run.measured - run.simulated
    np.testing.assert_allclose(error.std(axis=0), [5e-7, 1e-4], rtol=0.15)


def test_what_cannot_be_judged_is_refused(estimate):
    s = signals(record(7, n=1000))
    with pytest.raises(EstimationError, match="10000 Hz"):
        validation(estimate, replace(s, rate_hz=10_000.0))
    with pytest.raises(EstimationError, match="too few"):
        validation(estimate, Signals(u=s.u[:30], y=s.y[:30], rate_hz=s.rate_hz))
    with pytest.raises(EstimationError, match="'voltage' is constant"):
        validation(estimate, replace(s, u=0 * s.u + 1.0))
