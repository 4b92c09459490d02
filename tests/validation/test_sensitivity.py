"""Sensitivity analysis against what refits and moved coefficients do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox.polynomial import fir, oe
from ambid.blackbox.prediction import errors
from ambid.errors import EstimationError
from ambid.validation.sensitivity import sensitivity_analysis
from tests.validation.blackbox.fits import arx, io, polynomial, run

TRUTH = polynomial(A=(1, -1.5, 0.7), B=((0, 1.0, 0.5),))


def record(n=2000, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n, 1))
    return io(u, run(TRUTH, u, 0.3 * rng.standard_normal((n, 1))))


def moved(fit, name, share):
    theta = fit.model.theta.copy()
    theta[fit.model.names.index(name)] *= 1 + share
    return replace(fit, model=fit.model.with_theta(theta))


def test_the_rise_of_the_likelihood_is_that_of_a_moved_coefficient():
    data = record()
    fit = arx(data, 2, 2)
    found = {x.name: x for x in sensitivity_analysis(fit, data).influences}
    variance = fit.noise_covariance[0, 0]
    base = np.sum(errors(fit, data).one_step[2:] ** 2)
    assert set(found) == {"a1", "a2", "b1", "b2"}
    for name, x in found.items():
        rise = (np.sum(errors(moved(fit, name, 0.01), data).one_step[2:] ** 2) - base) / variance
        assert x.fit_alone == pytest.approx(rise, rel=0.1)
        assert x.fit_free == pytest.approx((0.01 * x.value / x.sd) ** 2)
        assert x.fit_free <= x.fit_alone


def test_poles_and_response_move_as_told():
    data = record()
    fit = arx(data, 2, 2)
    omega = np.geomspace(2 * np.pi / (1900 * data.dt), 0.999 * np.pi / data.dt, 60)
    for x in sensitivity_analysis(fit, data).influences:
        other = moved(fit, x.name, 1e-5).model
        before, after = (np.log(m.poles()) for m in (fit.model, other))
        step = np.max(np.abs(after - before) / np.abs(before)) * 1e3
        assert x.poles == pytest.approx(step, rel=1e-3, abs=1e-9)
        g, h = (m.frequency_response(omega)[:, 0, 0] for m in (fit.model, other))
        change = np.sqrt(np.mean(np.abs(h - g) ** 2) / np.mean(np.abs(g) ** 2)) * 1e3
        assert x.response == pytest.approx(change, rel=1e-3)


def test_numbers_that_stand_in_for_each_other_are_a_pair():
    rng = np.random.default_rng(3)
    u = np.repeat(rng.standard_normal((40, 1)), 50, axis=0)  # so slow that b1 and b2 do nearly the same
    model = polynomial(B=((0, 1.0, 0.5),))
    data = io(u, run(model, u, 0.1 * rng.standard_normal(u.shape)))
    found = sensitivity_analysis(fir(data, {"nb": 2, "nk": 1}), data)
    assert [{a, b} for a, b, _ in found.pairs] == [{"b1", "b2"}]
    assert found.pairs[0][2] < -0.9
    assert found.collinearity > 4
    assert found.weakest[0][0] == "b2"  # a relative step of the smaller one is the larger
    assert found.weakest[1][1] < 0
    white = sensitivity_analysis(arx(record(), 2, 2), record())
    assert white.collinearity < found.collinearity


def test_without_a_covariance_nothing_is_told():
    data = record(n=300)
    with pytest.raises(EstimationError, match="covariance"):
        sensitivity_analysis(replace(arx(data, 2, 2), covariance=None), data)


def test_an_output_error_model_of_too_high_an_order_is_nearly_dependent():
    data = record()
    right, high = (oe(data, {"nb": n, "nf": n, "nk": 1}) for n in (2, 3))
    assert sensitivity_analysis(high, data).collinearity > 2 * sensitivity_analysis(right, data).collinearity
