"""Hybrid NARMAX and network: truth comes back, spreads are right, feedback and noise do no harm, slopes are exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.estimation.search import search
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.hybrid import HybridFunction, choose_noise, hybrid, hybrid_problem
from ambid.nonlinear.lagged import LaggedModel
from ambid.nonlinear.lagged_problem import laplace
from ambid.nonlinear.narmax import narmax
from ambid.nonlinear.narx import narx
from ambid.nonlinear.polynomial import Factor
from tests.nonlinear.narmax.systems import coefficients, polynomial, record
from tests.tiers import runs

TRUTH = {"y(t-1)": 0.5, "y(t-2)": -0.2, "u(t-1)*y(t-1)": 0.3, "u(t-2)": 0.4, "e(t-1)": 0.7}


def bent(n: int, seed: int, *, noise: float = 0.1, loop: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Input and output of `TRUTH` with tanh(2 u(t-1) - y(t-1)) beside it; `loop` closes u = r - 0.6 y around it."""
    rng = np.random.default_rng(seed)
    r, y, e = rng.uniform(-1.5, 1.5, n), np.zeros(n), noise * rng.standard_normal(n)
    u = r.copy()
    for t in range(2, n):
        y[t] = 0.5 * y[t - 1] - 0.2 * y[t - 2] + 0.3 * u[t - 1] * y[t - 1] + 0.4 * u[t - 2]
        y[t] += np.tanh(2.0 * u[t - 1] - y[t - 1]) + e[t] + 0.7 * e[t - 1]
        if loop:
            u[t] = r[t] - 0.6 * y[t]
    return u, y


def model_of(fit: NonlinearFit) -> LaggedModel:
    assert isinstance(fit.model, LaggedModel)
    return fit.model


def readable(fit: NonlinearFit) -> dict[str, tuple[float, float]]:
    """Coefficients of the polynomial and of C."""
    return {k: v for k, v in coefficients(fit).items() if "unit" not in k}


def free_run(fit: NonlinearFit, u: np.ndarray, y: np.ndarray) -> float:
    assert fit.model is not None
    run = fit.model.simulate(u[:, None], y[:, None])[:, 0]
    return float(np.sqrt(np.mean((run - y)[10:] ** 2)))


def test_polynomial_network_and_noise_come_back_where_either_alone_does_not_fit() -> None:
    data, other = record(*bent(2000, 0)), bent(2000, 5, noise=0.0)
    both, terms, network = hybrid([data], {}), narmax([data], {"degree": 3}), narx([data], {"ny": 2, "nu": 2})
    assert both.settings["neurons"] == both.settings["ne"] == 1
    values = readable(both)
    assert set(values) == set(TRUTH)
    for name, (value, sd) in values.items():
        assert abs(value - TRUTH[name]) < 4 * sd, name
        assert sd < 0.03
    assert both.noise_covariance[0, 0] == pytest.approx(0.01, rel=0.1)
    mine = free_run(both, *other)
    assert mine < 0.1 * free_run(terms, *other)
    assert mine < 0.5 * free_run(network, *other)


def slope_by_past_output(fit: NonlinearFit, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Slope of y(t) by y(t-1) for samples of a record, innovations zero."""
    assert fit.model is not None
    out = []
    for t in range(10, u.size, 10):
        two = []
        for h in (1e-4, -1e-4):
            run = fit.model.simulate(u[t - 2 : t + 1, None], np.array([[y[t - 2]], [y[t - 1] + h]]))
            two.append(run[2, 0])
        out.append((two[0] - two[1]) / 2e-4)
    return np.array(out)


def test_coloured_noise_goes_into_a_network_alone_and_not_into_the_hybrid() -> None:
    u, y = bent(3000, 4, noise=0.4)
    t = np.arange(10, u.size, 10) - 1
    truth = 0.5 + 0.3 * u[t] - 1 / np.cosh(2 * u[t] - y[t]) ** 2
    both, network = hybrid([record(u, y)], {"neurons": 1}), narx([record(u, y)], {"ny": 2, "nu": 2, "neurons": 6})
    mine, its = (float(np.mean(slope_by_past_output(x, u, y) - truth)) for x in (both, network))
    assert abs(mine) < 0.03
    assert abs(its) > 0.1


def test_standard_deviations_are_those_of_repeated_records() -> None:
    scores, exact = [], 0
    n = runs(40, short=20)
    for seed in range(n):
        values = readable(hybrid([record(*bent(500, 100 + seed))], {"neurons": 1}))
        exact += set(values) == set(TRUTH)
        scores.append([(values[k][0] - v) / values[k][1] for k, v in TRUTH.items()])
    assert exact >= n.limit(0.75, centre=0.9) * n  # the criterion lets a superfluous term through in one of ten
    z = np.array(scores)
    assert np.all(np.abs(z.mean(axis=0)) < 4 / np.sqrt(n))
    assert abs(np.mean(z**2) - 1) < 4 * np.sqrt(2 / z.size) + 0.15  # 0.15 for the choice of terms
    assert n.limit(0.90) < np.mean(np.abs(z) < 1.96) < n.limit(0.985)


def test_without_neurons_it_is_narmax() -> None:
    data = polynomial(1500, 0)
    settings = {"ny": 2, "nu": 2, "ne": 1}
    one, same = narmax([data], {**settings, "selection": "frols"}), hybrid([data], {**settings, "neurons": 0})
    a, b = coefficients(one), coefficients(same)
    assert set(a) == set(b)
    for name, (value, sd) in a.items():
        assert b[name][0] == pytest.approx(value, abs=1e-3 * sd)
        assert b[name][1] == pytest.approx(sd, rel=1e-3)
    assert model_of(same).lag == one.model.lag  # type: ignore[union-attr]
    np.testing.assert_allclose(same.noise_covariance, one.noise_covariance, rtol=1e-3)
    test = polynomial(300, 9)
    assert one.model is not None
    for run in ("predict", "simulate"):
        np.testing.assert_allclose(
            getattr(same.model, run)(test.u, test.y), getattr(one.model, run)(test.u, test.y), atol=1e-4
        )


def test_a_polynomial_truth_gets_no_neurons_and_is_told() -> None:
    found = hybrid([polynomial(1000, 1)], {})
    assert found.settings["neurons"] == 0
    assert any("no neurons" in w for w in found.warnings)
    assert isinstance(found.details["tried"], list)
    assert [x["neurons"] for x in found.details["tried"]][:3] == [0, 1, 2]


@pytest.mark.parametrize(("p", "m"), [(1, 1), (2, 1), (2, 2)])
def test_slopes_through_the_innovations_are_exact(p: int, m: int) -> None:
    rng = np.random.default_rng(3)
    y1, y2, u1 = Factor("y", 0, 1), Factor("y", p - 1, 2), Factor("u", m - 1, 3)  # a lag that the network does not see
    terms = tuple((tuple(sorted((y1, y1))), (u1,), tuple(sorted((y2, u1))))[: 3 - o] for o in range(p))
    of = HybridFunction(terms=terms, ne=2, p=p, m=m, ny=2, nu=2, nk=0, neurons=3)
    theta, y, u = 0.3 * rng.standard_normal(of.n_theta), rng.standard_normal((200, p)), rng.standard_normal((200, m))
    rows = of.rows(y, u)
    assert of.affine
    assert len(set(of.names)) == of.n_theta
    D = of.slopes(theta, of.predict(theta, rows)[1], free=False)
    for k in range(of.n_theta):
        d = np.zeros(theta.size)
        d[k] = 1e-5
        four = [of.predict(theta + s * d, rows)[0] for s in (1, -1, 2, -2)]
        slope = (8 * (four[0] - four[1]) - (four[2] - four[3])) / 12e-5
        np.testing.assert_allclose(D[:, :, k], slope, atol=1e-8 * max(1.0, np.abs(D).max()))


def test_polynomial_and_noise_model_have_no_prior() -> None:
    of = two_lags(ne=1)
    assert not np.any(of.precision(2.0)[: of.n_linear])
    of = replace(of, neurons=1)
    assert np.all(of.precision(2.0)[of.n_linear :] == 0.5)


def two_axes(n: int, seed: int, c: np.ndarray, rho: float) -> tuple[np.ndarray, np.ndarray]:
    """Two outputs, each pushed by its own input, with innovations that hang together: y+ = a y + u + e+ + c e."""
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1.5, 1.5, (n, 2)), np.zeros((n, 2))
    e = 0.3 * rng.standard_normal((n, 2)) @ np.linalg.cholesky(np.array([[1.0, rho], [rho, 1.0]])).T
    e[0] = 0
    for t in range(1, n):
        y[t] = [0.5, 0.3] * y[t - 1] + u[t - 1] + e[t] + c @ e[t - 1]
    return y, u


def two_lags(*, ne: int) -> HybridFunction:
    terms = tuple(((Factor("y", o, 1),), (Factor("u", o, 1),)) for o in range(2))
    return HybridFunction(terms=terms, ne=ne, p=2, m=2, ny=1, nu=1, nk=1, neurons=0)


def test_innovations_that_hang_together_are_weighted_as_such() -> None:
    c, rho, seeds = np.array([[0.5, 0.3], [0.0, 0.6]]), 0.95, 40
    truth = np.array([0.5, 1.0, 0.3, 1.0, 0.5, 0.3, 0.0, 0.6])
    shape, z, off = two_lags(ne=1), [], []
    for seed in range(seeds):
        y, u = two_axes(300, seed, c, rho)
        problem = hybrid_problem(shape, ((y, u),), truth, 3.0)
        theta = search(problem, truth, stage="", most=30).theta
        found = laplace(problem, theta)
        P, noise = found.covariance, found.noise
        assert P is not None
        np.testing.assert_allclose(noise[0, 1] / np.sqrt(noise[0, 0] * noise[1, 1]), rho, atol=0.03)
        z.append((theta - truth) / np.sqrt(np.diag(P)))
        off.append(theta - truth)
    gains = np.array(off)[:, [1, 3]]
    assert np.sqrt(np.mean(gains**2)) < 0.5 * 0.3 / (0.866 * np.sqrt(300))  # half of what each output alone gives
    assert 0.91 < np.mean(np.abs(z) < 1.96) < 0.98
    together = np.array(z)[:, 4:]
    assert 0.8 < np.sqrt(np.mean(together**2)) < 1.18


def test_the_order_of_the_noise_model_pays_for_all_outputs_and_is_paid_by_all() -> None:
    start, orders = np.array([0.5, 1.0, 0.3, 1.0]), []
    for c in (0.15, 0.0):
        for seed in range(6):
            problem = hybrid_problem(two_lags(ne=0), (two_axes(1000, seed, c * np.eye(2), 0.0),), start, 3.0)
            orders.append(choose_noise(problem, start, 3.0, None)[0].ne)
    assert orders[:6].count(1) >= 5  # gain about 2 n c^2 = 45, price 4 log n = 28
    assert orders[6:].count(0) == 6


def test_feedback_does_no_harm_where_the_noise_model_is_right() -> None:
    data = record(*bent(3000, 2, noise=0.3, loop=True), open_loop=False)
    found = hybrid([data], {"neurons": 1, "ne": 1})
    values = readable(found)
    assert not any("biased" in w for w in found.warnings)
    for name, truth in TRUTH.items():
        assert abs(values[name][0] - truth) < 4 * values[name][1], name
    without = hybrid([data], {"neurons": 1, "ne": 0})
    assert any("biased" in w for w in without.warnings)
    value, sd = readable(without)["y(t-2)"]
    assert abs(value + 0.2) > 4 * sd  # the bias that the noise model takes away


def moving_average(n: int, seed: int, c: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u, y, e = rng.uniform(-1.5, 1.5, n), np.zeros(n), 0.3 * rng.standard_normal(n)
    for t in range(1, n):
        y[t] = 0.5 * y[t - 1] + np.tanh(2 * u[t - 1]) + e[t] + c * e[t - 1]
    return u, y


def test_noise_zeros_near_the_unit_circle_stay_inside() -> None:
    z = []
    for seed in range(12):
        found = hybrid([record(*moving_average(800, seed, -0.95))], {"neurons": 1, "ne": 1, "degree": 1})
        value, sd = readable(found)["e(t-1)"]
        assert -1 < value < -0.85
        if not any("unit circle" in w for w in found.warnings):
            z.append((value + 0.95) / sd)
        assert found.status == "converged"
    assert len(z) >= 10
    assert np.sqrt(np.mean(np.square(z))) < 1.9


def test_a_differenced_output_is_told_not_clipped() -> None:
    found = hybrid([record(*moving_average(800, 3, -1.0))], {"neurons": 1, "ne": 1, "degree": 1})
    model = model_of(found)
    value = readable(found)["e(t-1)"][0]
    assert -1 < value < -0.98
    assert any("unit circle" in w for w in found.warnings)
    u, y = moving_average(800, 4, -1.0)
    error = (y[:, None] - model.predict(u[:, None], y[:, None]))[5:]
    assert np.all(np.isfinite(error))
    assert np.std(error) < 0.36  # 0.3 is the innovation's


def test_spare_neurons_take_no_term_away_and_leave_no_deviations() -> None:
    """Units to spare could do what is linear: terms stay, and intervals beside them, too narrow, are not given."""
    for seed in range(3):
        data = record(*bent(600, 300 + seed))
        found, lean = hybrid([data], {"neurons": 3}), hybrid([data], {"neurons": 1})
        assert found.model is not None
        assert set(TRUTH) <= set(found.model.names)
        assert found.covariance is None
        assert any("improve the fit by less" in w for w in found.warnings)
        assert lean.covariance is not None
        np.testing.assert_allclose(found.noise_covariance, lean.noise_covariance, rtol=0.05)


def test_two_outputs_two_inputs_and_two_records() -> None:
    rng = np.random.default_rng(8)

    def made(n: int) -> tuple[np.ndarray, np.ndarray]:
        u, y, e = rng.uniform(-1.5, 1.5, (n, 2)), np.zeros((n, 2)), 0.05 * rng.standard_normal((n, 2))
        for t in range(1, n):
            y[t, 0] = 0.6 * y[t - 1, 0] - 0.2 * y[t - 1, 1] + np.tanh(2 * u[t - 1, 0]) + e[t, 0] + 0.4 * e[t - 1, 1]
            y[t, 1] = 0.4 * y[t - 1, 1] + 0.3 * y[t - 1, 0] * u[t - 1, 1] + u[t - 1, 1] + e[t, 1] + 0.5 * e[t - 1, 1]
        return u, y

    records = [record(*made(700)), record(*made(500))]
    found = hybrid(records, {"ny": 1, "nu": 1, "ne": 1, "neurons": 1})
    values = readable(found)
    truth = {
        "y1: y1(t-1)": 0.6, "y1: y2(t-1)": -0.2, "y1: e1(t-1)": 0.0, "y1: e2(t-1)": 0.4, "y2: y2(t-1)": 0.4,
        "y2: u2(t-1)*y1(t-1)": 0.3, "y2: u2(t-1)": 1.0, "y2: e1(t-1)": 0.0, "y2: e2(t-1)": 0.5,
    }  # fmt: skip
    for name, value in truth.items():
        assert abs(values[name][0] - value) < 4.5 * values[name][1], name
    np.testing.assert_allclose(found.noise_covariance, 0.0025 * np.eye(2), atol=3e-4)
    u, y = made(200)
    J = model_of(found).jacobian(u, y)
    assert J.shape == (200, 2, model_of(found).theta.size)


def test_a_time_series_without_inputs() -> None:
    rng = np.random.default_rng(0)
    y, e = np.zeros(1000), 0.2 * rng.standard_normal(1000)
    for t in range(2, 1000):
        y[t] = 1.6 * np.tanh(2 * y[t - 1]) - 0.6 * y[t - 2] + e[t] + 0.5 * e[t - 1]
    found = hybrid([record(np.empty((1000, 0)), y)], {"neurons": 1})
    values = readable(found)
    assert set(values) == {"y(t-2)", "e(t-1)"}
    assert abs(values["y(t-2)"][0] + 0.6) < 4 * values["y(t-2)"][1]
    assert abs(values["e(t-1)"][0] - 0.5) < 4 * values["e(t-1)"][1]
    noise = hybrid([record(np.empty((999, 0)), e[1:] + 0.8 * e[:-1])], {"neurons": 0})  # nothing to explain but noise
    assert readable(noise)["e(t-1)"][0] == pytest.approx(0.8, abs=0.1)


def test_every_stage_has_its_curve_and_progress_never_falls() -> None:
    seen: list[tuple[str, float | None]] = []

    def tick(stage: str, done: float | None = None, /) -> None:
        seen.append((stage, done))

    found = hybrid([record(*bent(500, 7))], {}, tick=tick)
    methods = " ".join(c.method for c in found.curves)
    for stage in ("polynomial", "network on the residual", "all together"):
        assert stage in methods
    last = [c for c in found.curves if c.method.startswith("all together")][-1]
    assert last.training[-1] == pytest.approx(0.1 / np.std(bent(500, 7)[1]), rel=0.15)
    shares = [d for _, d in seen if d is not None]
    assert len(shares) > 10
    assert np.all(np.diff(shares) >= -1e-12)
    assert shares[0] >= 0
    assert shares[-1] <= 1


def test_an_interruption_keeps_what_there_is() -> None:
    data = record(*bent(500, 8))
    left = []
    for stage in ("network on the residual", "all together"):

        def tick(now: str, done: float | None = None, /, stage: str = stage) -> None:
            if now == stage:
                raise KeyboardInterrupt

        found = hybrid([data], {"neurons": 1}, tick=tick)
        assert found.status == "stalled"
        left.append(float(found.noise_covariance[0, 0]))
    assert left[1] < 0.5 * left[0]  # the network was there already


def test_settings_that_make_no_sense_are_refused() -> None:
    data = record(*bent(200, 1))
    with pytest.raises(EstimationError, match="predict from"):
        hybrid([data], {"ny": 0, "nu": 0})
    with pytest.raises(EstimationError, match="neurons"):
        hybrid([data], {"neurons": "many"})
    with pytest.raises(EstimationError, match="no record"):
        hybrid([], {})
    with pytest.raises(EstimationError, match="hybrid: record 1"):
        hybrid([data.part(0, 12)], {})
    few = hybrid([data.part(0, 40)], {})
    assert few.settings["neurons"] == 0
    assert not any("overfits" in w for w in few.warnings)
    crowded = hybrid([data.part(0, 20)], {"neurons": 4})
    assert any("overfits" in w for w in crowded.warnings)
