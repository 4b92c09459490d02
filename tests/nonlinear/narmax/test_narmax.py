"""NARMAX identification: known systems come back, standard deviations are right, feedback does no harm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.nonlinear.lagged import LaggedModel
from ambid.nonlinear.narmax import narmax
from tests.nonlinear.narmax.systems import TRUTH, coefficients, polynomial, record
from tests.tiers import runs


def test_terms_and_coefficients_of_a_narmax_system_come_back() -> None:
    found = narmax([polynomial(2000, 0)], {"ny": 3, "nu": 3, "degree": 3})
    values = coefficients(found)
    assert set(values) == set(TRUTH)
    for name, (value, sd) in values.items():
        assert abs(value - TRUTH[name]) < 4.5 * sd
        assert sd < 0.1
    assert found.noise_covariance[0, 0] == pytest.approx(0.01, rel=0.15)
    assert found.status == "converged"


def test_standard_deviations_are_those_of_repeated_records() -> None:
    settings = {"selection": "frols", "criterion": "ebic"}
    scores = []
    n = runs(60, short=16)
    for seed in range(n):
        values = coefficients(narmax([polynomial(500, 100 + seed)], settings))
        if set(values) == set(TRUTH):
            scores.append([(v - TRUTH[name]) / sd for name, (v, sd) in sorted(values.items())])
    assert len(scores) >= n.limit(0.75, centre=0.9) * n  # the choice is nearly always the true one
    squares = np.array(scores) ** 2
    k = squares.size
    assert abs(squares.mean() - 1) < 4 * np.sqrt(2 / k) + 0.1  # 0.1 for choice of terms and small samples
    inside = np.mean(np.sqrt(squares) < 1.96)
    assert n.limit(0.90) < inside < n.limit(0.985)


def test_innovations_are_the_one_step_errors_and_white() -> None:
    data = polynomial(4000, 3)
    found = narmax([data], {})
    assert found.model is not None
    e = (data.y - found.model.predict(data.u, data.y))[found.model.lag :, 0]
    assert np.var(e) == pytest.approx(found.noise_covariance[0, 0], rel=1e-2)
    r = np.array([np.mean(e[k:] * e[:-k]) for k in range(1, 11)]) / np.var(e)
    assert np.sum(r**2) * e.size < 29.6  # chi2(10), 0.1 %


def loop(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """An unstable plant with a cubic, coloured noise, and a proportional controller around it."""
    rng = np.random.default_rng(seed)
    y, u, e, r = np.zeros(n), np.zeros(n), 0.1 * rng.standard_normal(n), 0.3 * rng.standard_normal(n)
    for t in range(1, n):
        y[t] = 1.2 * y[t - 1] - 0.1 * y[t - 1] ** 3 + 0.5 * u[t - 1] + e[t] + 0.8 * e[t - 1]
        u[t] = -1.0 * y[t] + r[t]
    return u, y


def test_feedback_does_no_harm_where_the_noise_model_is_right() -> None:
    u, y = loop(5000, 0)
    settings = {"ny": 1, "nu": 1, "degree": 3, "criterion": "bic"}
    with_noise = narmax([record(u, y, open_loop=False)], {**settings, "ne": 1})
    values = coefficients(with_noise)
    assert not with_noise.warnings or all("biased" not in w for w in with_noise.warnings)
    for name, truth in {"y(t-1)": 1.2, "u(t-1)": 0.5, "e(t-1)": 0.8, "y(t-1)^3": -0.1}.items():
        assert abs(values[name][0] - truth) < 5 * values[name][1], name
    without = narmax([record(u, y, open_loop=False)], {**settings, "ne": 0})
    value, sd = coefficients(without)["y(t-1)"]
    assert abs(value - 1.2) > 8 * sd  # the bias that the noise model takes away
    assert any("biased" in w for w in without.warnings)


def test_two_outputs_share_their_past() -> None:
    rng = np.random.default_rng(1)
    n = 2000
    u, y, e = rng.uniform(-1, 1, (n, 2)), np.zeros((n, 2)), 0.05 * rng.standard_normal((n, 2))
    for t in range(1, n):
        y[t, 0] = 0.6 * y[t - 1, 0] - 0.2 * y[t - 1, 1] + u[t - 1, 0] + e[t, 0]
        y[t, 1] = 0.4 * y[t - 1, 1] + 0.3 * y[t - 1, 0] * u[t - 1, 1] + u[t - 1, 1] + e[t, 1] + 0.5 * e[t - 1, 1]
    found = narmax([record(u, y)], {"ny": 1, "nu": 1, "ne": 1})
    values = coefficients(found)
    truth = {
        "y1: y1(t-1)": 0.6, "y1: y2(t-1)": -0.2, "y1: u1(t-1)": 1.0, "y2: y2(t-1)": 0.4, "y2: u2(t-1)": 1.0,
        "y2: u2(t-1)*y1(t-1)": 0.3, "y2: e2(t-1)": 0.5,
    }  # fmt: skip
    assert set(values) == set(truth)
    for name, value in truth.items():
        assert abs(values[name][0] - value) < 4.5 * values[name][1]
    np.testing.assert_allclose(found.noise_covariance, 0.0025 * np.eye(2), atol=3e-4)


def output_error(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A nonlinear plant whose output is measured with noise: one-step fits are biased here."""
    rng = np.random.default_rng(seed)
    u, x = rng.uniform(-1, 1, n), np.zeros(n)
    for t in range(2, n):
        x[t] = 1.4 * x[t - 1] - 0.6 * x[t - 2] + 0.3 * u[t - 1] - 0.05 * x[t - 1] ** 3
    return u, x + 0.1 * rng.standard_normal(n)


def test_a_fit_to_the_free_run_finds_the_plant_behind_measurement_noise() -> None:
    u, y = output_error(3000, 0)
    settings = {"degree": 3, "ne": 0, "selection": "all", "pruning": "simulation", "focus": "simulation", "constant": 0}
    found = narmax([record(u, y)], settings)
    values = coefficients(found)
    for name, truth in {"y(t-1)": 1.4, "y(t-2)": -0.6, "u(t-1)": 0.3, "y(t-1)^3": -0.05}.items():
        assert abs(values[name][0] - truth) < 5 * values[name][1], name
    assert found.noise_covariance[0, 0] == pytest.approx(0.01, rel=0.1)
    one_step = narmax([record(u, y)], {"degree": 3, "ne": 0, "constant": 0})
    assert abs(coefficients(one_step)["y(t-1)"][0] - 1.4) > 0.2


def test_terms_that_spoil_the_free_run_are_taken_out() -> None:
    u, y = output_error(600, 2)
    data = record(u, y)

    def free_run(pruning: str) -> float:
        settings = {"ny": 3, "nu": 3, "degree": 3, "ne": 0, "criterion": "aic", "pruning": pruning}
        model = narmax([data], settings).model
        assert model is not None
        run = model.simulate(data.u, data.y)
        return float(np.sqrt(np.mean((run - data.y)[model.lag :] ** 2)))

    assert free_run("simulation") <= free_run("none") * (1 + 1e-9)


def test_levels_are_taken_off_only_where_signals_stand_far_from_zero() -> None:
    data = polynomial(800, 5)
    near = narmax([data], {}).model
    far = narmax([replace(data, y=data.y + 50.0)], {}).model
    assert isinstance(near, LaggedModel)
    assert isinstance(far, LaggedModel)
    assert near.y_level[0] == 0.0
    assert far.y_level[0] == pytest.approx(50.0, abs=0.5)
    one, other = near.predict(data.u, data.y), far.predict(data.u, data.y + 50.0) - 50.0
    lag = max(near.lag, far.lag)
    assert np.std((one - other)[lag:]) < 0.05 * np.std(data.y)


def test_a_run_that_diverges_is_not_a_number_from_there_on() -> None:
    found = narmax([polynomial(500, 0)], {"ne": 0}).model
    assert isinstance(found, LaggedModel)
    names = list(found.names)
    theta = found.theta.copy()
    theta[names.index("y(t-1)")] = 1.5
    u, y = np.ones((400, 1)), np.ones((400, 1))
    run = found.with_theta(theta).simulate(u, y)
    bad = np.flatnonzero(~np.isfinite(run[:, 0]))
    assert 5 < bad[0] < 200
    assert np.all(np.isnan(run[bad[0] :]))


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"ny": -1}, "whole number"),
        ({"degree": 2.0}, "whole number"),
        ({"criterion": "bix"}, "bic"),
        ({"ny": 0, "nu": 0}, "predict from"),
        ({"ny": 90, "nu": 90, "degree": 5}, "candidate"),
        ({"ny": 100, "nu": 2, "degree": 1}, None),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, object], says: str | None) -> None:
    if says is None:
        with pytest.raises(EstimationError, match="longer record"):
            narmax([polynomial(60, 0)], settings)
        return
    with pytest.raises(EstimationError, match=says):
        narmax([polynomial(200, 0)], settings)


def swinging(n: int, seed: int, noise: float, cubic: float) -> tuple[IOData, np.ndarray]:
    """A damped oscillator sampled at 300 times its frequency, with white noise on the output: fast against its size."""
    rng = np.random.default_rng(seed)
    u, x, y = np.repeat(rng.standard_normal(n // 20 + 1), 20)[:n], np.zeros(2), np.zeros(n)
    for t in range(n):
        y[t] = x[0]
        x = x + 0.02 * np.array([x[1], -x[0] - 0.4 * x[1] - cubic * x[0] ** 3 + u[t]])
    return record(u, y + noise * y.std() * rng.standard_normal(n)), y


def test_noise_on_an_output_that_is_sampled_fast_does_not_bias_the_model() -> None:
    # without innovations from a long model no noise term pays, and the free run is off by most of the output
    for degree, cubic in ((1, 0.0), (3, 0.3)):
        found = narmax([swinging(3000, 1, 0.01, cubic)[0]], {"degree": degree})
        assert found.model is not None
        assert {"e(t-1)", "e(t-2)"} <= set(found.model.names)
        fresh, true = swinging(3000, 7, 0.01, cubic)
        off = (found.model.simulate(fresh.u, fresh.y)[:, 0] - true)[50:]
        assert np.std(off) < 0.05 * np.std(true)
        assert float(np.sqrt(found.noise_covariance[0, 0])) < 1.2 * 0.01 * np.std(swinging(3000, 1, 0.01, cubic)[1])


def test_where_the_last_output_hides_the_rest_all_candidates_are_looked_at() -> None:
    # position and current of a magnet: an increment of the position is hidden by its noise, its ratio by the position
    rng = np.random.default_rng(5)
    n = 3000
    u, x, i = np.repeat(rng.standard_normal(n // 10), 10), np.zeros(2), np.zeros(n)
    z = np.zeros((n, 2))
    for t in range(n - 1):
        z[t] = x[0], i[t]
        i[t + 1] = 0.95 * i[t] + 0.05 * u[t]
        x = x + np.array([0.01 * x[1], 0.01 * (-x[0] - 0.3 * x[1] + 3.0 * i[t])])
    z[-1] = x[0], i[-1]
    data = record(u, z + 0.003 * z.std(axis=0) * rng.standard_normal(z.shape))
    plain = narmax([data], {"degree": 1, "selection": "frols"})
    found = narmax([data], {"degree": 1})
    assert found.model is not None
    assert found.settings["selection"] == "auto"
    assert found.criteria == plain.criteria  # made elsewhere
    assert np.linalg.det(found.noise_covariance) <= np.linalg.det(plain.noise_covariance) * (1.0 + 1e-9)
