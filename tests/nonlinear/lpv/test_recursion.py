"""The compiled recursions: equations as written, exact derivatives, set points, functions of p."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.nonlinear.lpv import Candidate, carry_over, lpv, slowest_mode, slowest_that_does, time_constants
from ambid.nonlinear.lpv_model import (
    LpvProblem,
    LpvShape,
    Schedule,
    basis_values,
    beginning,
    errors,
    part_of,
    settling,
)
from tests.nonlinear.lpv.plants import record


def shape_of(form="output", ar=2, ma=1, degree=1, offset="scheduled"):
    return LpvShape(
        columns=(0,),
        order=2,
        nb=2,
        nk=1,
        ar=ar,
        ma=ma,
        degree=degree,
        form=form,
        offset=offset,
    )


def theta_of(shape, seed=0):
    """Coefficients of a stable predictor."""
    values = {"a1": -1.1, "a2": 0.4, "b1": 0.7, "b2": 0.3, "offset": 0.2, "d1": -0.5, "d2": 0.1, "c1": 0.4}
    out = 0.03 * np.random.default_rng(seed).standard_normal(shape.n_theta)
    for k, name in enumerate(shape.coefficients):
        where = shape.place(k)
        out[where.start] += values[name]
    return out


def signals(n=60, seed=1):
    rng = np.random.default_rng(seed)
    return rng.standard_normal(n), rng.standard_normal((n, 1)), rng.uniform(-1, 1, n)


def by_hand(shape, theta, y, u, s):
    """The difference equations as `shape` writes them, with loops."""
    phi = basis_values(s, shape.degree + 1)
    places = [theta[shape.place(k)] for k in range(len(shape.coefficients))]
    c = [phi[:, : x.size] @ x if k < shape.n_process else np.full(s.size, x[0]) for k, x in enumerate(places)]
    a1, a2, b1, b2, offset, d1, d2, c1 = c
    x, e = y.copy(), np.zeros(y.size)
    for t in range(2, y.size):
        z = x if shape.form == "output" else y
        x[t] = -a1[t] * z[t - 1] - a2[t] * z[t - 2] + b1[t] * u[t - 1, 0] + b2[t] * u[t - 2, 0] + offset[t]
        if t >= 4:
            v = y - x
            e[t] = v[t] + d1[t] * v[t - 1] + d2[t] * v[t - 2] - c1[t] * e[t - 1]
    return x, e


@pytest.mark.parametrize("form", ["equation", "output"])
@pytest.mark.parametrize("offset", ["scheduled", "constant"])
def test_innovations_are_those_of_the_equations(form, offset):
    shape = shape_of(form, degree=2, offset=offset)
    assert shape.n_theta == len(shape.names) == theta_of(shape).size
    assert shape.place(shape.n_process - 1).stop == shape.n_process_theta
    y, u, s = signals()
    theta = theta_of(shape)
    found = errors(shape, part_of(shape, y, u, s), theta)
    x, e = by_hand(shape, theta, y, u, s)
    assert found.finite
    np.testing.assert_allclose(found.x, x, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(found.e, e, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose((y - found.g)[4:], e[4:], atol=1e-13)


@pytest.mark.parametrize("form", ["equation", "output"])
@pytest.mark.parametrize(("ar", "ma"), [(0, 0), (2, 0), (0, 1), (2, 1)])
@pytest.mark.parametrize("offset", ["scheduled", "constant"])
def test_derivatives_are_exact(form, ar, ma, offset):
    shape = shape_of(form, ar=ar, ma=ma, degree=2, offset=offset)
    y, u, s = signals()
    part, theta = part_of(shape, y, u, s), theta_of(shape)
    start = 0.3 * np.arange(1.0, shape.n_start + 1)
    whole = np.concatenate([theta, start])
    J = errors(shape, part, theta, start, slopes=2).J

    def predicted(w):
        return errors(shape, part, w[: theta.size], w[theta.size :]).g

    for k in range(whole.size):
        h = 1e-4 * np.eye(whole.size)[k]
        d1, d2 = ((predicted(whole + m * h) - predicted(whole - m * h)) / (2e-4 * m) for m in (1, 2))
        np.testing.assert_allclose(J[shape.lag :, k], ((4 * d1 - d2) / 3)[shape.lag :], rtol=1e-7, atol=1e-9)
    only = errors(shape, part, theta, start, slopes=1).J
    np.testing.assert_array_equal(only[shape.lag :, theta.size :], J[shape.lag :, theta.size :])


@pytest.mark.parametrize("form", ["equation", "output"])
def test_predictions_from_an_estimated_beginning_have_exact_derivatives(form):
    shape = shape_of(form, degree=2)
    y, u, s = signals()
    part, theta = part_of(shape, y, u, s), theta_of(shape)
    lag = shape.lag + settling(shape)

    def predicted(w):
        return errors(shape, part, w, beginning(shape, part, w)[0]).g

    start, slope = beginning(shape, part, theta, slopes=True)
    J = errors(shape, part, theta, start, slopes=2).J
    total = J[:, : theta.size] + J[:, theta.size :] @ slope
    for k in range(theta.size):
        h = 1e-4 * np.eye(theta.size)[k]
        d1, d2 = ((predicted(theta + m * h) - predicted(theta - m * h)) / (2e-4 * m) for m in (1, 2))
        np.testing.assert_allclose(total[lag:, k], ((4 * d1 - d2) / 3)[lag:], rtol=1e-7, atol=1e-9)


def test_a_beginning_keeps_slow_noise_from_spoiling_the_first_predictions():
    """C has a zero at 0.99: taken as zero, the innovations before a record would be missed for hundreds of samples."""
    shape = shape_of("equation", ar=0, ma=1, degree=0)
    theta = np.zeros(shape.n_theta)
    for name, value in {"a1": -1.1, "a2": 0.4, "b1": 0.7, "c1": -0.99}.items():
        theta[shape.place(shape.coefficients.index(name))] = value
    rng = np.random.default_rng(0)
    gained = []
    for _ in range(30):
        u, e, y = rng.standard_normal((400, 1)), rng.standard_normal(400), np.zeros(400)
        for t in range(2, 400):
            y[t] = 1.1 * y[t - 1] - 0.4 * y[t - 2] + 0.7 * u[t - 1, 0] + e[t] - 0.99 * e[t - 1]
        part = part_of(shape, y[200:], u[200:], np.zeros(200))
        found = [errors(shape, part, theta, start).g for start in (None, beginning(shape, part, theta)[0])]
        gained.append([np.mean((y[200:] - e[200:] - g)[10:50] ** 2) for g in found])  # against the best prediction
    zero, estimated = np.mean(gained, axis=0)
    assert zero > 0.3
    assert estimated < 0.5 * zero


@pytest.mark.parametrize("form", ["equation", "output"])
def test_what_was_before_is_projected_out(form):
    """The gradient of the projected cost, against differences: the triangle's J'e is minus half of it."""
    shape = shape_of(form)
    parts = tuple(part_of(shape, *signals(seed=k)) for k in (1, 2))
    problem = LpvProblem(shape=shape, parts=parts, first=shape.lag, weight=2.0)
    theta = theta_of(shape)
    R = problem.triangle(theta)
    np.testing.assert_allclose(np.sum(R[:, -1] ** 2), problem.cost(theta), rtol=1e-10)
    gradient = -2 * R[:, :-1].T @ R[:, -1]
    for k in range(theta.size):
        h = 1e-4 * np.eye(theta.size)[k]
        slope = (problem.cost(theta + h) - problem.cost(theta - h)) / 2e-4
        np.testing.assert_allclose(gradient[k], slope, rtol=1e-4, atol=1e-4)


def test_an_unstable_predictor_counts_as_infinitely_bad():
    shape = shape_of("output")
    theta = theta_of(shape)
    problem = LpvProblem(shape=shape, parts=(part_of(shape, *signals()),), first=shape.lag)
    assert np.isfinite(problem.cost(theta))
    for name, value in (("c1", 1.2), ("a2", 1.1)):
        worse = theta.copy()
        worse[shape.place(shape.coefficients.index(name)).start] = value
        assert not shape.is_sound(worse)
        assert problem.cost(worse) == np.inf
    equation = shape_of("equation")
    worse = theta_of(equation)
    worse[equation.place(1).start] = 1.1
    assert equation.is_sound(worse)  # its predictor does not feed x back


def test_the_free_run_follows_its_own_set_point():
    data = record(0, 400)
    model = lpv([data], {"degree": 1, "form": "equation", "error_form": "ar", "time_constant": 0.3}).model
    run = model.simulate(data.u, data.y)[:, 0]
    of, share = model.shape, 1 - np.exp(-0.01 / 0.3)
    a1, a2, b1 = (model.theta[of.place(k)] for k in (0, 1, 2))
    u = data.u - model.u_level
    b2, offset, first = model.theta[of.place(3)], model.theta[of.place(of.n_process - 1)], model.lag
    assert of.columns == (0, 1)
    w1, w2 = (model.theta[of.place(k)] for k in (4, 5))
    expected, level = data.y[:, 0].copy(), 0.0
    for t in range(400):
        if t >= first:
            phi = np.array([1.0, (level - model.schedule.middle) / model.schedule.half])
            z = expected - model.y_level
            x = -(a1 @ phi) * z[t - 1] - (a2 @ phi) * z[t - 2] + (b1 @ phi) * u[t - 1, 0] + (b2 @ phi) * u[t - 2, 0]
            x += (w1 @ phi) * u[t - 1, 1] + (w2 @ phi) * u[t - 2, 1] + offset @ phi
            expected[t] = x + model.y_level[0]
        level += max(share, 1 / (t + 1)) * (expected[t] - level)
    np.testing.assert_allclose(run, expected, rtol=1e-9, atol=1e-10)


def test_the_set_point_is_causal_a_mean_at_first_and_then_forgets():
    y = np.random.default_rng(0).standard_normal((500, 1))
    of = Schedule(name="level", column=-1, time_constant=0.2, low=-1.0, high=1.0)
    p = of.signal(np.empty((500, 0)), y, 0.01)
    np.testing.assert_allclose(p[1:10], [y[:t].mean() for t in range(1, 10)])
    changed = y.copy()
    changed[300:] = 7.0
    np.testing.assert_array_equal(of.signal(np.empty((500, 0)), changed, 0.01)[:301], p[:301])
    settled = of.signal(np.empty((500, 0)), changed, 0.01)
    np.testing.assert_allclose(7.0 - settled[340], (7.0 - settled[320]) * np.exp(-1), rtol=1e-9)  # 20 samples: 0.2 s
    last = Schedule(name="y", column=-1, time_constant=0.0, low=-1.0, high=1.0)
    np.testing.assert_allclose(last.signal(np.empty((500, 0)), y, 0.01)[1:], y[:-1, 0], atol=1e-15)


def test_the_output_itself_may_schedule():
    data = record(0, 500)
    fit = lpv([data], {"schedule": "y", "degree": 1})
    assert fit.settings["time_constant"] == 0.0
    np.testing.assert_allclose(
        fit.model.scheduling(data.u, data.y)[1:], fit.model.schedule.scaled(data.y[:-1, 0]), atol=1e-14
    )


def test_what_follows_the_last_output_has_standard_deviations_that_hold():
    """y = 0.9 y1 - 0.1 y1^2 - 0.2 y2 + (0.5 + 0.1 y1) u1 + 0.3 + e: a_1(p) y1 with p = y1 holds all of c(p) but 0.3."""
    found = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        u, e, y = rng.standard_normal((500, 1)), 0.1 * rng.standard_normal(500), np.zeros(500)
        for t in range(2, 500):
            y[t] = (
                0.9 * y[t - 1]
                - 0.1 * y[t - 1] ** 2
                - 0.2 * y[t - 2]
                + (0.5 + 0.1 * y[t - 1]) * u[t - 1, 0]
                + 0.3
                + e[t]
            )
        data = IOData(
            u=u, y=y[:, None], dt=0.01, inputs=("u",), outputs=("y",), units={"u": "V", "y": "m"}, open_loop=True
        )
        fit = lpv([data], {"schedule": "y", "degree": 1, "form": "equation", "error_form": "ar", "error_order": 1})
        assert fit.model.shape.n_offset == 1
        for p in (0.2, 1.2):
            at = fit.model.at(p, fit.covariance)
            found.append([(at.a[2] - 0.2) / at.a_sd[2], (at.b[0, 0] - 0.5 - 0.1 * p) / at.b_sd[0, 0]])
        run = fit.model.simulate(u, y[:, None])[:, 0]
        np.testing.assert_allclose(run[fit.model.lag :], y[fit.model.lag :], atol=1.0)
    z = np.array(found)
    assert 0.9 < np.mean(np.abs(z) < 1.96) < 0.99
    assert np.all((z.std(axis=0) > 0.75) & (z.std(axis=0) < 1.25))


def test_a_model_is_carried_over_to_more_functions_of_p():
    old, new = shape_of(degree=1), shape_of(degree=2, ar=1)
    y, u, s = signals()
    theta = theta_of(old)
    one = errors(old, part_of(old, y, u, s), theta).x
    same = errors(new, part_of(new, y, u, s), carry_over(new, old, theta)).x
    np.testing.assert_allclose(same, one, rtol=1e-10, atol=1e-12)


def test_what_is_tried_for_the_set_point():
    assert time_constants(26.0, 13000, 0.001) == pytest.approx([0.13, 0.39, 1.17])
    assert time_constants(1.0, 600, 0.01) == pytest.approx([0.1, 0.3, 0.9])
    assert time_constants(1e9, 600, 0.01) == pytest.approx([1.2])  # slower than a fifth of the record says nothing
    assert slowest_that_does([1.0, 3.0, 9.0], [0.0, 4.0, 50.0]) == 3.0
    assert slowest_mode(np.poly([np.exp(0.02), np.exp(-0.5)])) == pytest.approx(50.0)


def test_candidates_are_compared_by_criteria_that_numbers_for_the_beginning_enter():
    def value(criterion, cost, n, starts=0):
        shape = shape_of("equation", ar=0, ma=0, degree=0)
        return Candidate(shape=shape, theta=np.zeros(5), cost=cost, n=n, starts=starts).value(criterion)

    assert value("bic", 10.0, 10) == pytest.approx(5 * np.log(10))
    assert value("aicc", 10.0, 100) > value("aic", 10.0, 100)
    assert value("bic", 10.0, 20, starts=3) == pytest.approx(value("bic", 10.0, 20) + 6.0)
    assert value("bic", np.inf, 10) == np.inf
    assert value("bic", 1e-30, 10, starts=4) == np.inf  # as many numbers as samples fit anything
