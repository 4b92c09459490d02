"""The eight structures on simulated records: truth, exactness, offsets, initial states, units, several channels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from ambid.blackbox import polynomial
from ambid.blackbox.prediction import one_step
from ambid.errors import EstimationError
from tests.blackbox.polynomial.systems import SYSTEMS, record, two_outputs, unstable_loop


def free(fit) -> np.ndarray:
    return fit.sd > 0


@pytest.mark.parametrize("name", SYSTEMS)
def test_truth_within_its_uncertainty(name: str) -> None:
    system = SYSTEMS[name]
    fit = system.fit(system.data(1, 3000, offset=-4.0))
    assert fit.status == "converged"
    assert fit.orders == system.orders
    use = free(fit)
    assert fit.n_estimated == np.sum(use) == sum(v for k, v in system.orders.items() if k != "nk")
    np.testing.assert_array_equal(fit.model.theta[~use], system.truth[~use])
    error = (fit.model.theta - system.truth)[use]
    assert np.max(np.abs(error) / fit.sd[use]) < 3.5
    assert error @ np.linalg.solve(fit.covariance[np.ix_(use, use)], error) < chi2.ppf(0.999, error.size)
    assert fit.noise_covariance[0, 0] == pytest.approx(system.sd**2, rel=0.1)


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_model_predicts_what_the_search_did(name: str) -> None:
    system = SYSTEMS[name]
    data = system.data(2, 1500, offset=50.0)
    fit = system.fit(data)
    e = data.y - one_step(fit.model.state_space(), data.u, data.y, fit.offsets)
    assert np.mean(e[20:] ** 2) == pytest.approx(fit.noise_covariance[0, 0], rel=0.02)
    assert abs(np.mean(e)) < 0.05 * system.sd


def test_arx_is_least_squares() -> None:
    data = SYSTEMS["arx"].data(3, 800, offset=1.0)
    fit = SYSTEMS["arx"].fit(data)
    y, u = data.y[:, 0], data.u[:, 0]
    rows = np.column_stack([-y[1:-1], -y[:-2], u[1:-1], u[:-2], np.ones(y.size - 2)])
    x, rest, _, _ = np.linalg.lstsq(rows, y[2:], rcond=None)
    covariance = rest[0] / (y.size - 2 - 5) * np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose(fit.model.theta[free(fit)], x[:4], rtol=1e-9)
    np.testing.assert_allclose(fit.covariance[np.ix_(free(fit), free(fit))], covariance[:4, :4], rtol=1e-7)
    level = fit.offsets.y[0] - np.sum(fit.model.outputs[0].B[0]) / np.sum(fit.model.outputs[0].A) * fit.offsets.u[0]
    assert level == pytest.approx(x[4] / (1 + x[0] + x[1]), rel=1e-9)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_do_not_matter(name: str, scale: float) -> None:
    system = SYSTEMS[name]
    data = system.data(4, 600, offset=2.0)
    one, other = system.fit(data), system.fit(record(data.u / scale, data.y * scale, open_loop=True))
    worth = np.array([scale**2 if "b" in x else 1.0 for x in one.model.names])
    np.testing.assert_allclose(other.model.theta, one.model.theta * worth, rtol=1e-7)
    np.testing.assert_allclose(other.sd, one.sd * worth, rtol=1e-6)
    np.testing.assert_allclose(other.noise_covariance, one.noise_covariance * scale**2, rtol=1e-7)
    np.testing.assert_allclose(other.offsets.y, one.offsets.y * scale, rtol=1e-7)


@pytest.mark.parametrize("name", ["arx", "oe", "bj"])
def test_offset_of_a_hundred_times_the_signal(name: str) -> None:
    system = SYSTEMS[name]
    data = system.data(5, 1000)
    far = record(data.u - 100 * np.std(data.u), data.y + 100 * np.std(data.y), open_loop=True)
    one, other = system.fit(data), system.fit(far)
    np.testing.assert_allclose(other.model.theta, one.model.theta, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(other.offsets.y - one.offsets.y, 100 * np.std(data.y), rtol=1e-9)


def test_a_short_record_of_a_slow_pole_that_begins_off_rest() -> None:
    rng = np.random.default_rng(7)
    poles, gains = [], []
    for _ in range(60):
        u = rng.standard_normal(120)
        y = lfilter([0, 0.1], [1, -0.98], u) + 3.0 * 0.98 ** np.arange(120) + 0.05 * rng.standard_normal(120)
        fit = polynomial.oe(record(u[:, None], y[:, None], open_loop=True), {"nb": 1, "nf": 1, "nk": 1})
        p = fit.model.outputs[0]
        poles.append((p.F[0][1] + 0.98) / fit.sd[-1])
        gains.append(p.B[0][1])
    assert abs(np.mean(poles)) < 0.45
    assert 0.75 < np.std(poles) < 1.3
    assert np.mean(gains) == pytest.approx(0.1, abs=0.003)


def test_fixed_coefficients_stay_and_help() -> None:
    system = SYSTEMS["oe"]
    data = system.data(8, 800)
    loose, tight = system.fit(data), system.fit(data, fixed={"f2": 0.7, "b1": 1.0})
    names = {x: k for k, x in enumerate(tight.model.names)}
    assert tight.model.theta[names["f2"]] == 0.7
    assert tight.model.theta[names["b1"]] == pytest.approx(1.0, rel=1e-15)
    assert tight.sd[names["f2"]] == tight.sd[names["b1"]] == 0.0
    assert tight.sd[names["f1"]] < 0.9 * loose.sd[names["f1"]]
    assert tight.n_estimated == loose.n_estimated - 2
    with pytest.raises(EstimationError, match="Did you mean 'f2'"):
        system.fit(data, fixed={"f22": 0.7})
    with pytest.raises(EstimationError, match="'b0'"):
        system.fit(data, fixed={"b0": 0.7})
    with pytest.raises(EstimationError, match="Change the fixed"):
        system.fit(data, fixed={"f1": -2.0, "f2": 1.5})


def test_an_integrator_has_its_offset_on_the_input() -> None:
    rng = np.random.default_rng(9)
    u = 3.0 + rng.standard_normal((500, 1))
    y = 7.0 + np.cumsum(np.r_[0.0, 0.5 * (u[:-1, 0] - 2.0)]) + 0.01 * np.cumsum(rng.standard_normal(500))
    fit = polynomial.arx(record(u, y[:, None]), {"na": 1, "nb": 1, "nk": 1}, fixed={"a1": -1.0})
    assert fit.model.theta[3] == pytest.approx(0.5, abs=5 * fit.sd[3])
    assert fit.offsets.u[0] == pytest.approx(2.0, abs=0.01)


def test_two_outputs_share_their_noise() -> None:
    u, y, covariance = two_outputs()
    fit = polynomial.oe(record(u, y + np.array([10, -20]), open_loop=True), {"nb": 1, "nf": 1, "nk": (1, 2)})
    truth = {"y0:b1.0": 1.0, "y0:b2.1": 0.7, "y0:f1.0": -0.8, "y0:f1.1": 0.4}
    truth |= {"y1:b1.0": 0.3, "y1:b2.1": -0.5, "y1:f1.0": -0.5, "y1:f1.1": -0.9}
    found = dict(zip(fit.model.names, zip(fit.model.theta, fit.sd, strict=True), strict=True))
    assert {x for x, (_, sd) in found.items() if sd > 0} == set(truth)
    assert all(abs(found[x][0] - v) < 3.5 * found[x][1] for x, v in truth.items())
    np.testing.assert_allclose(fit.noise_covariance, covariance, rtol=0.15)
    values = np.linalg.eigvalsh(fit.covariance)
    assert values[0] > -1e-12 * values[-1]


def test_shared_noise_correlates_coefficients_as_theory_says() -> None:
    u, y, _ = two_outputs(400)
    fit = polynomial.arx(record(u, y), {"na": 0, "nb": 2, "nk": 1})  # same regressors: cov = Sigma x (J'J)^-1
    use = free(fit)
    whole = fit.covariance[np.ix_(use, use)]
    half = whole.shape[0] // 2
    inverse = whole[:half, :half] / fit.noise_covariance[0, 0]
    np.testing.assert_allclose(whole, np.kron(fit.noise_covariance, inverse), rtol=1e-6, atol=1e-12)


def test_unstable_plant_in_closed_loop() -> None:
    data, a, c = unstable_loop(3000, 3)
    for name, orders in (("armax", {"na": 2, "nc": 2}), ("ararmax", {"na": 2, "nc": 2, "nd": 1})):
        fit = getattr(polynomial, name)(data, {"nb": 1, "nk": 1, **orders})
        p, sd = fit.model.outputs[0], fit.sd
        assert np.all(np.abs(p.A - a)[1:] < 3.5 * sd[1:3])
        if name == "armax":
            assert np.all(np.abs(p.C - c)[1:] < 3.5 * sd[6:8])
            assert not fit.warnings
    assert np.max(np.abs(polynomial.armax(data, {"na": 2, "nb": 1, "nc": 2, "nk": 1}).model.poles())) == pytest.approx(
        1.1, abs=0.02
    )


@pytest.mark.parametrize("name", ["oe", "bj"])
def test_an_unstable_plant_is_named_where_the_structure_cannot_hold_it(name: str) -> None:
    data, _, _ = unstable_loop(2000, 4)
    orders = {"nb": 1, "nf": 2, "nk": 1} | ({"nc": 1, "nd": 1} if name == "bj" else {})
    fit = getattr(polynomial, name)(data, orders)
    assert any("the plant looks unstable" in x and "armax" in x for x in fit.warnings)
    assert np.max(np.abs(fit.model.poles())) < 1.0
