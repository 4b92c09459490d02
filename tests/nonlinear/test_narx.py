"""Neural NARX: sizes, early stopping, simulation errors, spread of what it predicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.nonlinear.lagged_problem import problem_at, solve_linear
from ambid.nonlinear.narx import NarxFunction, narx


def data(u: np.ndarray, y: np.ndarray) -> IOData:
    u, y = u.reshape(len(u), -1), y.reshape(len(y), -1)
    names = tuple(f"u{k}" for k in range(u.shape[1])), tuple(f"y{k}" for k in range(y.shape[1]))
    units = dict.fromkeys((*names[0], *names[1]), "V")
    return IOData(u=u, y=y, dt=0.01, inputs=names[0], outputs=names[1], units=units, open_loop=True)


def bent(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return 0.6 * x + 0.5 * np.tanh(1.5 * u) + 0.2 * np.tanh(x - 0.5 * u)


def lagged(n: int, seed: int, noise: float) -> tuple[IOData, np.ndarray]:
    """A first-order system with white equation errors, and its noise-free one-step values."""
    rng = np.random.default_rng(seed)
    u, y, clean = rng.standard_normal(n), np.zeros(n), np.zeros(n)
    for t in range(1, n):
        clean[t] = bent(y[t - 1], u[t - 1])
        y[t] = clean[t] + noise * rng.standard_normal()
    return data(u, y), clean


def test_the_linear_numbers_are_at_their_best_for_the_units() -> None:
    function = NarxFunction(p=2, m=1, ny=2, nu=1, nk=1, neurons=3)
    rng = np.random.default_rng(2)
    parts = tuple((rng.standard_normal((n, 2)), rng.standard_normal((n, 1))) for n in (50, 5000))
    theta = rng.standard_normal(function.n_theta)
    problem = replace(problem_at(function, parts, theta, function.precision(0.2)), weight=np.diag([1.5, 0.3]))
    n = function.n_linear
    best = solve_linear(problem, n, theta)
    np.testing.assert_array_equal(best[n:], theta[n:])
    R = problem.triangle(best)
    slope = R[:, :-1].T @ R[:, -1]
    assert np.max(np.abs(slope[:n])) < 1e-9 * np.max(np.abs(slope[n:]))


def test_training_does_not_creep_along_valleys() -> None:
    # with the linear part among the numbers that are searched for: 60 iterations, and still stalled
    ended = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u, y, e = np.zeros(2000), np.zeros(2000), rng.standard_normal(2000)
        for t in range(2, 2000):
            u[t] = 0.9 * u[t - 1] + 0.4 * e[t]
            y[t] = 1.6 * y[t - 1] - 0.7 * y[t - 2] + 0.1 * u[t - 1] - 0.03 * y[t - 1] ** 3
        fit = narx([data(u, y + 1e-3 * rng.standard_normal(2000))], {"ny": 2, "nu": 2, "neurons": 6}, seed=seed)
        assert fit.curves[0].training.size < 30
        assert np.sqrt(fit.noise_covariance[0, 0]) < 2.1e-3
        ended.append(fit.status)
    assert ended.count("converged") >= 2


def test_sizes_are_found_and_noise_as_well() -> None:
    record, clean = lagged(3000, 1, 0.05)
    fit = narx([record], {})
    assert fit.model is not None
    assert 1 <= fit.settings["ny"] <= 3
    assert float(np.sqrt(fit.noise_covariance[0, 0])) == pytest.approx(0.05, rel=0.06)
    left = (fit.model.predict(record.u, record.y)[:, 0] - clean)[fit.model.lag :]
    assert np.std(left) < 0.012
    assert fit.curves[0].held_out.size == fit.curves[0].training.size
    other, other_clean = lagged(1000, 77, 0.05)
    assert np.std((fit.model.predict(other.u, other.y)[:, 0] - other_clean)[fit.model.lag :]) < 0.015


def test_intervals_of_the_function_cover_the_truth() -> None:
    inside, total = 0, 0
    for seed in range(30):
        record, clean = lagged(500, 100 + seed, 0.1)
        fit = narx([record], {"ny": 1, "nu": 1, "neurons": 3, "starts": 1, "held_out": 0.0}, seed=seed)
        assert fit.model is not None
        assert fit.covariance is not None
        J = fit.model.jacobian(record.u, record.y)[1::25, 0]
        sd = np.sqrt(np.einsum("tp,pq,tq->t", J, fit.covariance, J))
        off = (fit.model.predict(record.u, record.y)[:, 0] - clean)[1::25]
        inside, total = inside + np.count_nonzero(np.abs(off) < 1.96 * sd), total + off.size
    assert total == 600
    assert 0.90 <= inside / total <= 0.985  # neighbours hang together: about 30 times 3 independent draws


def test_training_stops_before_it_learns_the_noise() -> None:
    record, _ = lagged(130, 3, 0.4)
    told = {"ny": 2, "nu": 2, "neurons": 14, "starts": 1, "prior": 1e3}
    fit = narx([record], told)
    assert fit.details["stopped_early"]
    assert any("held-out" in w for w in fit.warnings)
    held = fit.curves[0].held_out
    assert fit.details["held_out_rms"] == pytest.approx(held.min(), rel=1e-6)
    assert held[-1] > held.min()
    assert fit.curves[0].training[-1] < fit.curves[0].training[0]


def test_simulation_errors_fall_where_the_noise_is_on_the_sensor() -> None:
    rng = np.random.default_rng(6)
    u, x = rng.standard_normal(1500), np.zeros(1500)
    for t in range(2, 1500):
        x[t] = 1.5 * x[t - 1] - 0.7 * x[t - 2] + 0.3 * np.tanh(u[t - 1])
    record = data(u, x + 0.1 * rng.standard_normal(1500))
    errors = []
    for focus in ("prediction", "simulation"):
        fit = narx([record], {"ny": 2, "nu": 2, "neurons": 3, "focus": focus})
        assert fit.model is not None
        errors.append(float(np.std(fit.model.simulate(record.u, record.y)[20:, 0] - x[20:])))
    assert errors[1] < 0.35 * errors[0]
    assert fit.covariance_from == "sandwich"
    told = {"ny": 2, "nu": 2, "neurons": 3, "focus": "simulation", "uncertainty": "laplace"}
    white = narx([record], told)  # which the errors of a free run are not taken for
    assert white.covariance is None
    assert any("standard deviations" in w for w in white.warnings)


def test_two_outputs_and_two_inputs() -> None:
    rng = np.random.default_rng(8)
    u, y = rng.standard_normal((1200, 2)), np.zeros((1200, 2))
    for t in range(1, 1200):
        y[t, 0] = 0.5 * y[t - 1, 0] + np.tanh(u[t - 1, 0]) + 0.2 * y[t - 1, 1]
        y[t, 1] = 0.7 * y[t - 1, 1] - 0.4 * np.tanh(u[t - 1, 1] + y[t - 1, 0])
    y += 0.001 * rng.standard_normal(y.shape)
    fit = narx([data(u, y)], {"ny": 1, "nu": 1, "neurons": 8})
    assert fit.model is not None
    left = (y - fit.model.predict(u, y))[1:]
    assert np.all(left.std(axis=0) < 0.03 * y.std(axis=0))
    assert fit.noise_covariance.shape == (2, 2)


def test_nothing_to_predict_from_is_refused() -> None:
    record, _ = lagged(100, 1, 0.1)
    with pytest.raises(EstimationError, match="nothing is left"):
        narx([record], {"ny": 0, "nu": 0})
    with pytest.raises(EstimationError, match="neurons"):
        narx([record], {"neurons": "many"})  # type: ignore[dict-item]
