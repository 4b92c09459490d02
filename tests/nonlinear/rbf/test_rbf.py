"""Radial basis networks from records: a known network, what is chosen, what the intervals of the function cover."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.search import search
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.lagged import LaggedModel
from ambid.nonlinear.lagged_problem import laplace
from ambid.nonlinear.narx import narx
from ambid.nonlinear.rbf import RbfFunction, rbf, rbf_problem
from tests.nonlinear.rbf.systems import CENTRES, WEIGHTS, WIDTHS, bumpy, data, network
from tests.tiers import runs


def model_of(fit: NonlinearFit) -> LaggedModel:
    assert isinstance(fit.model, LaggedModel)
    return fit.model


def units_of(fit: NonlinearFit) -> RbfFunction:
    function = model_of(fit).function
    assert isinstance(function, RbfFunction)
    return function


def test_a_known_network_is_found_with_its_centres_and_widths() -> None:
    truth = np.concatenate([[0.5, 0.3, 0.2], WEIGHTS, CENTRES.ravel(), np.log(WIDTHS)])
    f, away, inside = network(neurons=3), [], 0
    for seed in range(40):
        record, _ = bumpy(600, 100 + seed, 0.1)
        start = truth + 0.15 * np.random.default_rng(seed).standard_normal(truth.size)
        parts = ((record.y, record.u),)
        problem = rbf_problem(f, parts, start, np.array([1e3]), start, all_numbers=True)
        found = search(replace(problem, weight=np.array([[10.0]])), start, stage="", most=100)
        about = laplace(problem, found.theta)
        P = about.covariance
        assert found.converged
        assert P is not None
        assert np.sqrt(about.noise[0, 0]) == pytest.approx(0.1, rel=0.15)
        score = (found.theta - truth) / np.sqrt(np.diag(P))
        inside += np.count_nonzero(np.abs(score) < 1.96)
        away.append(score)
    assert 0.90 <= inside / (40 * truth.size) <= 0.98  # numbers of one record hang together
    assert np.all(np.abs(np.median(away, axis=0)) < 0.6)


@pytest.mark.parametrize(
    ("told", "limit"),
    [
        ({}, 0.045),
        ({"linear": 0}, 0.045),
        ({"trained": "all", "neurons": 6}, 0.055),
    ],
    ids=lambda x: ",".join(f"{k}={v}" for k, v in x.items()) if isinstance(x, dict) else "",
)
def test_every_way_of_placing_units_finds_the_function(told: dict[str, object], limit: float) -> None:
    record, _ = bumpy(1500, 2, 0.1)
    other, clean = bumpy(800, 3, 0.1)
    fit = rbf([record], {"ny": 1, "nu": 1, **told})  # type: ignore[dict-item]
    model = model_of(fit)
    assert np.std(clean) > 0.25
    assert np.std((model.predict(other.u, other.y)[:, 0] - clean)[model.lag :]) < limit
    assert float(np.sqrt(fit.noise_covariance[0, 0])) == pytest.approx(0.1, rel=0.12)
    assert fit.details["effective_parameters"] <= model.theta.size + 1e-6


def test_the_size_is_chosen_and_told() -> None:
    record, _ = bumpy(1500, 4, 0.1)
    fit = rbf([record], {})
    assert fit.settings["ny"] == fit.settings["nu"] == 1
    assert fit.details["seen"] == "all"
    assert 8 <= fit.settings["neurons"] == units_of(fit).neurons <= 48
    tried = fit.details["tried"]
    best = min(t["held_out_rms"] for t in tried)
    told = {**fit.settings, "seen": fit.details["seen"]}
    mine = [t["held_out_rms"] for t in tried if all(t[k] == told[k] for k in ("ny", "nu", "neurons", "width", "seen"))]
    assert best <= min(mine) <= 1.01 * best
    assert not rbf([record], {"neurons": 0}).settings["neurons"]


def test_units_see_what_matters() -> None:
    rng = np.random.default_rng(5)
    u, y = rng.standard_normal(1200), np.zeros(1200)
    for t in range(2, 1200):
        y[t] = 0.9 * y[t - 1] - 0.3 * y[t - 2] + u[t - 1] - 0.3 * np.tanh(2 * y[t - 1]) + 0.05 * rng.standard_normal()
    fit = rbf([data(u, y)], {"ny": 2, "nu": 2})
    assert fit.details["seen"] == "outputs"
    assert units_of(fit).units.n_seen == 2


def test_training_everything_stops_before_it_learns_the_noise() -> None:
    record, _ = bumpy(150, 3, 0.5)
    told = {"ny": 2, "nu": 2, "neurons": 25, "width": 0.5, "trained": "all", "prior": 1e3}
    fit = rbf([record], told)
    assert fit.details["stopped_early"]
    assert any("held-out" in w for w in fit.warnings)
    held = fit.curves[1].held_out
    assert fit.details["held_out_rms"] == pytest.approx(held.min(), rel=1e-6)
    assert held[-1] > held.min()


def on_the_sensor(seed: int, n: int = 1500) -> tuple[IOData, np.ndarray]:
    rng = np.random.default_rng(seed)
    u, x = rng.uniform(-2, 2, n), np.zeros(n)
    for t in range(2, n):
        x[t] = 1.5 * x[t - 1] - 0.7 * x[t - 2] + 0.4 * np.exp(-((u[t - 1] - 0.5) ** 2) / 0.5)
    return data(u, x + 0.1 * rng.standard_normal(n)), x


BUMP = {"ny": 2, "nu": 1, "neurons": 8, "width": 0.7}


def test_simulation_errors_fall_where_the_noise_is_on_the_sensor() -> None:
    record, x = on_the_sensor(6)
    errors = []
    for focus in ("prediction", "simulation"):
        fit = rbf([record], {**BUMP, "focus": focus})
        errors.append(float(np.std(model_of(fit).simulate(record.u, record.y)[20:, 0] - x[20:])))
        assert fit.covariance is None  # the choice of units would be missing
        assert any("choice of the units" in w for w in fit.warnings)
    assert errors[1] < 0.5 * errors[0]
    assert float(np.sqrt(fit.noise_covariance[0, 0])) == pytest.approx(0.1, rel=0.1)


def test_intervals_of_the_linear_part_cover_the_truth_for_simulation_errors() -> None:
    inside, seeds = 0, runs(20, short=6)
    told = {**BUMP, "neurons": 2, "trained": "all", "focus": "simulation"}
    for seed in range(seeds):
        fit = rbf([on_the_sensor(200 + seed, 700)[0]], told, seed=seed)
        assert fit.covariance_from == "sandwich"
        assert fit.sd is not None
        away = (model_of(fit).theta[:2] - [1.5, -0.7]) / fit.sd[:2]
        inside += np.count_nonzero(np.abs(away) < 1.96)
    assert seeds.limit(0.86) <= inside / (2 * seeds) <= 1.0  # 0.95 with a deviation of some 0.03
    white = rbf([on_the_sensor(200, 700)[0]], {**told, "uncertainty": "laplace"})
    assert white.covariance is None
    assert any("coloured" in w for w in white.warnings)


def test_two_outputs_and_two_inputs_over_two_records() -> None:
    rng = np.random.default_rng(8)
    records = []
    for _ in range(2):
        u, y = rng.standard_normal((700, 2)), np.zeros((700, 2))
        for t in range(1, 700):
            y[t, 0] = 0.5 * y[t - 1, 0] + np.tanh(u[t - 1, 0]) + 0.2 * y[t - 1, 1]
            y[t, 1] = 0.7 * y[t - 1, 1] - 0.4 * np.tanh(u[t - 1, 1] + y[t - 1, 0])
        records.append(data(u, y + [0.001, 0.05] * rng.standard_normal(y.shape)))
    fit = rbf(records, {"ny": 1, "nu": 1, "neurons": 40})
    left = (records[0].y - model_of(fit).predict(records[0].u, records[0].y))[1:]
    assert np.all(left.std(axis=0) < [0.08 * 0.74, 1.5 * 0.05])
    assert np.sqrt(fit.noise_covariance[0, 0]) < np.sqrt(fit.noise_covariance[1, 1])
    assert len(fit.details["prior_by_output"]) == 2


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_errors_of_outputs_that_hang_together_are_so_in_the_covariance(rho: float) -> None:
    rng = np.random.default_rng(7)
    u, y = rng.standard_normal((500, 2)), np.zeros((500, 2))
    e = 0.2 * rng.standard_normal((500, 2)) @ np.linalg.cholesky(np.array([[1.0, rho], [rho, 1.0]])).T
    for t in range(1, 500):
        y[t] = [0.5, 0.7] * y[t - 1] + u[t - 1] + e[t]
    fit = rbf([data(u, y)], {"ny": 1, "nu": 1, "neurons": 0})
    model = model_of(fit)
    ys, us = (y - model.y_level) / model.y_scale, (u - model.u_level) / model.u_scale
    z = np.hstack([model.function.rows(ys, us).x, np.ones((499, 1))])
    noise = fit.noise_covariance / model.y_scale[:, None] / model.y_scale
    exact = np.kron(noise, np.linalg.inv(z.T @ z))  # least squares, output by output
    order = np.array([0, 1, 2, 3, 8, 4, 5, 6, 7, 9])  # the two constants come last
    assert fit.covariance is not None
    np.testing.assert_allclose(fit.covariance[np.ix_(order, order)], exact, rtol=0.01, atol=1e-3 * exact.max())


def test_shared_centres_have_deviations_that_hold_for_errors_that_hang_together() -> None:
    """Two outputs, one bump: units are common, and so each of their numbers sees both errors."""
    f, rho, z = network(2, 1, ny=0, nu=1, neurons=1, linear=False), 0.95, []
    truth = np.array([0.2, -0.1, 1.0, 1.0, 0.3, np.log(0.7)])
    u = np.linspace(-2.5, 2.5, 200)[:, None]
    clean = f.values(truth, f.rows(np.zeros((200, 2)), u))
    for seed in range(60):
        e = np.random.default_rng(seed).standard_normal((199, 2)) @ np.linalg.cholesky([[1.0, rho], [rho, 1.0]]).T
        y = np.vstack([np.zeros((1, 2)), clean + 0.1 * e])
        problem = rbf_problem(f, ((y, u),), truth, np.full(2, 1e3), truth, all_numbers=True)
        problem = replace(problem, precision=np.full(truth.size, 1e-3), weight=10.0 * np.eye(2))
        theta = search(problem, truth, stage="", most=30).theta
        P = laplace(problem, theta).covariance
        assert P is not None
        z.append((theta - truth) / np.sqrt(np.diag(P)))
    assert np.all(np.std(z, axis=0) < 1.26)  # the centre's was 1.4
    assert np.all(np.std(z, axis=0) > 0.78)


def test_it_does_about_as_well_as_a_neural_network() -> None:
    record, _ = bumpy(800, 9, 0.1)
    other, clean = bumpy(800, 10, 0.1)
    off = []
    for estimator, told in ((rbf, {"ny": 1, "nu": 1}), (narx, {"neurons": 8, "ny": 1, "nu": 1})):
        model = estimator([record], told).model  # type: ignore[arg-type]
        assert model is not None
        off.append(float(np.std((model.predict(other.u, other.y)[:, 0] - clean)[model.lag :])))
    assert off[0] < 2 * off[1]


def test_feedback_is_warned_of_and_nothing_to_predict_from_refused() -> None:
    record, _ = bumpy(300, 11, 0.1)
    closed = data(record.u, record.y, open_loop=False)
    assert any("feedback" in w for w in rbf([closed], {"neurons": 4}).warnings)
    assert not any("feedback" in w for w in rbf([record], {"neurons": 4}).warnings)
    with pytest.raises(EstimationError, match="nothing is left"):
        rbf([record], {"ny": 0, "nu": 0})


@pytest.mark.parametrize(
    ("told", "word"),
    [
        ({"held_out": 0.0}, "held_out"),
        ({"held_out": 0.0, "ny": 1, "nu": 1, "neurons": 3}, "width"),
    ],
)
def test_settings_that_make_each_other_void_are_refused(told: dict[str, object], word: str) -> None:
    record, _ = bumpy(100, 11, 0.1)
    with pytest.raises(EstimationError, match=word):
        rbf([record], told)  # type: ignore[arg-type]
    rbf([record], {"held_out": 0.0, "ny": 1, "nu": 1, "neurons": 3, "width": 1.4})


def test_a_model_that_follows_the_noise_says_so() -> None:
    record, _ = bumpy(62, 14, 0.1)
    assert any("overfits" in w for w in rbf([record], {"ny": 20, "nu": 20, "neurons": 0}).warnings)
    assert not any("overfits" in w for w in rbf([record], {"ny": 1, "nu": 1, "neurons": 0}).warnings)


def test_numbers_that_the_data_do_not_tell_apart_are_named() -> None:
    rng = np.random.default_rng(3)
    u, y = np.where(np.arange(300) % 2, 1.0, -1.0), np.zeros(300)
    for t in range(1, 300):
        y[t] = 0.5 * y[t - 1] + u[t - 1] + 0.2 * rng.standard_normal()
    told = {"ny": 1, "neurons": 3, "width": 1.4, "trained": "all"}
    (found,) = [w for w in rbf([data(u, y)], {**told, "nu": 2}).warnings if "distinguish" in w]
    assert "y: u(t-1), y: u(t-2)." in found
    assert not any("distinguish" in w for w in rbf([data(u, y)], {**told, "nu": 1}).warnings)


def test_units_that_have_no_place_are_left_out_and_told() -> None:
    record, _ = bumpy(120, 13, 0.1)
    fit = rbf([record], {"ny": 1, "nu": 1, "neurons": 100})
    assert 20 < fit.settings["neurons"] == units_of(fit).neurons < 60
    assert any("instead of 100" in w for w in fit.warnings)
    assert not any("instead" in w for w in rbf([record], {"ny": 1, "nu": 1}).warnings)


def test_a_time_series_has_no_inputs() -> None:
    rng = np.random.default_rng(12)
    y = np.zeros(800)
    for t in range(2, 800):
        y[t] = np.sin(2 * y[t - 1]) + 0.3 * y[t - 2] + 0.1 * rng.standard_normal()
    fit = rbf([data(np.empty((800, 0)), y)], {})
    assert float(np.sqrt(fit.noise_covariance[0, 0])) == pytest.approx(0.1, rel=0.08)
    assert model_of(fit).n_inputs == 0
