"""State-space networks behind a sensor without sign: known plants, exact slopes, the coupled drives."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.nonlinear.fit import model_from_json, model_to_json
from ambid.nonlinear.nn import nn
from ambid.nonlinear.state_network import StateNetwork
from ambid.nonlinear.state_start import grid_starts
from tests.measured import ABSENT, BENCHMARKS

DATA = BENCHMARKS


def io(u: np.ndarray, y: np.ndarray) -> IOData:
    return IOData(
        u=u.reshape(-1, 1),
        y=y.reshape(-1, 1),
        dt=0.02,
        inputs=("u",),
        outputs=("speed",),
        units={"u": "V", "speed": "1"},
        open_loop=True,
        record={"samples": u.size, "rate_hz": 50.0, "sha256": "0" * 64, "file": "made.csv"},
    )


def rubbing(n: int = 400, *, noise: float = 0.0, friction: float = 0.05, seed: int = 0) -> tuple[IOData, np.ndarray]:
    """A drive with dry friction before a resonance, from rest; of the speed only the magnitude is seen."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 12 + 1), 12)[:n]
    speed, drive, y, z = np.zeros(n + 2), 0.0, np.zeros(n), 0.0
    for t in range(n):
        y[t] = z
        drive_next = 0.9 * drive + 0.12 * u[t] - friction * np.tanh(drive / 0.1)
        speed[t + 2] = 1.72 * speed[t + 1] - 0.86 * speed[t] + 0.14 * drive_next
        drive = drive_next
        p, c = speed[t + 1], speed[t + 2]
        mean = 0.5 * (abs(p) + abs(c)) if p * c >= 0 else 0.5 * (p * p + c * c) / (abs(p) + abs(c))
        z = 0.3 * z + 0.7 * mean
    return io(u, np.abs(y + noise * rng.standard_normal(n))), y


def test_starts_are_the_models_of_the_grid() -> None:
    from scipy.signal import lfilter

    rng = np.random.default_rng(1)
    u = rng.standard_normal((100, 1))
    A = np.convolve(np.array([1.0, -1.4, 0.81]), [1.0, -0.7])
    y = np.abs(lfilter([0.0, 0.5], A, u[:, 0]))
    for n in (1, 2, 3, 4):
        layout, theta = grid_starts(((y[:, None], u),), n, 1, 0.02)[0]
        X, _ = layout.matrices(theta).run(y[:, None], np.hstack([u, np.ones_like(u)]), np.zeros(n + 1))
        poles = np.linalg.eigvals(layout.matrices(theta).A)
        filtered = lfilter([0.0, 1.0], np.real(np.poly(poles)), u[:, 0])
        gain = (filtered @ X[:-1, 0]) / (filtered @ filtered)
        np.testing.assert_allclose(X[:-1, 0], gain * filtered, atol=1e-9 * np.max(np.abs(X)))


def test_a_plant_with_friction_is_found_and_goes_on_unseen() -> None:
    data, true = rubbing(noise=0.005)
    settings = {"output": "magnitude", "states": 3, "starts": 4}
    linear = nn([data.part(0, 300)], {**settings, "neurons": 0})
    found = nn([data.part(0, 300)], {**settings, "neurons": 1})
    assert isinstance(linear.model, StateNetwork)
    assert isinstance(found.model, StateNetwork)
    assert found.model.kind == "nn-magnitude"
    off = [float(np.std((m.simulate(data.u, data.y)[:, 0] - true)[300:])) for m in (linear.model, found.model)]
    assert off[1] < 0.006  # the noise is 0.005
    assert off[0] > 4 * off[1]
    assert found.status == "converged"
    assert float(np.sqrt(found.noise_covariance[0, 0])) == pytest.approx(0.005, rel=0.2)


@pytest.mark.parametrize(("friction", "units"), [(0.0, 0), (0.05, 1)])
def test_the_number_of_states_and_units_is_chosen(friction: float, units: int) -> None:
    data, _ = rubbing(300, noise=0.005, friction=friction, seed=1)
    found = nn([data], {"output": "magnitude", "starts": 4}, seed=1)
    assert (found.settings["states"], found.settings["neurons"]) == (3, units)
    assert [x["neurons"] for x in found.details["held_out"]] == [0, 1, 2, 3]  # type: ignore[attr-defined]


def test_a_linear_plant_needs_no_units_and_has_honest_deviations() -> None:
    inside, total = 0, 0
    true_sensor = 0.3
    for seed in range(12):
        data, _ = rubbing(300, noise=0.01, friction=0.0, seed=seed)
        # noise is added before the magnitude is taken: with speeds far from zero that changes nothing
        found = nn([data], {"output": "magnitude", "states": 3, "neurons": 0}, seed=seed)
        assert found.model is not None
        assert found.covariance is not None
        k = found.model.names.index("sensor pole")
        sd = float(np.sqrt(found.covariance[k, k]))
        inside += abs(float(found.model.theta[k]) - true_sensor) < 2.0 * sd
        total += 1
    assert inside >= total - 3  # 95 % each: more than three misses of twelve have a chance of 2e-3


def test_the_model_file_holds_all() -> None:
    data, _ = rubbing(200)
    model = nn([data], {"output": "magnitude", "states": 3, "neurons": 1, "starts": 1, "iterations": 10}).model
    assert model is not None
    again = model_from_json(model_to_json(model))
    np.testing.assert_array_equal(again.simulate(data.u, data.y), model.simulate(data.u, data.y))
    np.testing.assert_array_equal(again.novelty(data.u, data.y), model.novelty(data.u, data.y))
    assert again.names == model.names


def test_the_slope_of_the_model_carries_the_first_state() -> None:
    data, _ = rubbing(120)
    model = nn([data], {"output": "magnitude", "states": 3, "neurons": 1, "starts": 2}).model
    assert model is not None
    exact = model.jacobian(data.u, data.y)[model.lag :, 0]
    for k in (0, 3, 6, 9):
        step = 1e-5 * max(abs(model.theta[k]), 0.1)
        ends = [
            model.with_theta(model.theta + d * np.eye(model.theta.size)[k]).predict(data.u, data.y)
            for d in (step, -step)
        ]
        slope = (ends[0] - ends[1])[model.lag :, 0] / (2 * step)
        np.testing.assert_allclose(slope, exact[:, k], atol=0.02 * np.max(np.abs(exact[:, k])))


def test_what_makes_no_sense_is_refused() -> None:
    data, _ = rubbing(100)
    for settings, word in (
        ({"noise": "innovations"}, "noise"),
        ({"evaluations": 10}, "evaluations"),
        ({"states": 5}, "states"),
    ):
        with pytest.raises(EstimationError, match=word):
            nn([data], {"output": "magnitude", **settings})
    with pytest.raises(EstimationError, match="negative"):
        nn([io(data.u, data.y - 1.0)], {"output": "magnitude"})


@pytest.mark.parametrize(("k", "limit"), [(1, 0.10), (3, 0.10)])
def test_coupled_drives(k: int, limit: float) -> None:
    """Second half of the record, the run going on from the first: at or below 0.10 (linear: 0.17 and 0.10)."""
    path = DATA / f"coupled_drives_{k}.csv"
    if not path.exists():
        pytest.skip(ABSENT)
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    whole = io(table[:, 1], table[:, 2])
    # number of units as the method itself chooses it (two and one; bench/nonlinear.py lets it), which takes longer
    found = nn([whole.part(0, 250)], {"output": "magnitude", "states": 3, "neurons": {1: 2, 3: 1}[k]})
    assert found.model is not None
    off = found.model.simulate(whole.u, whole.y) - whole.y
    assert float(np.sqrt(np.mean(off[250:] ** 2))) < limit
