"""Residual tests and coloured-noise covariances of black-box fits keep their word: Monte Carlo over 200 records."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ambid.blackbox.polynomial import arma, armax, arx, oe
from ambid.blackbox.prediction import errors, gradient
from ambid.validation.fits import judge, linear_residuals
from ambid.validation.residuals import correlations
from tests.tiers import runs
from tests.validation.blackbox.fits import io, polynomial, run

RUNS, N = runs(200, short=60), 400
ARX = polynomial(A=(1, -1.5, 0.7), B=((0, 1.0, 0.5),))
ARMAX = polynomial(A=(1, -1.5, 0.7), B=((0, 1.0, 0.5),), C=(1, 0.6))
COLOURED = polynomial(F=((1, -1.5, 0.7),), B=((0, 1.0, 0.5),), D=(1, -0.95))


def record(model, seed, n=N):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n, 1))
    return io(u, run(model, u, 0.4 * rng.standard_normal((n, 1))) + 2.0)


def loop(seed, n=N):
    """An ARX plant under u = r - 0.5 y."""
    rng = np.random.default_rng(seed)
    u, y, e = np.zeros(n), np.zeros(n), 0.4 * rng.standard_normal(n)
    for k in range(2, n):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1] + 0.5 * u[k - 2] + e[k]
        u[k] = rng.standard_normal() - 0.5 * y[k]
    return io(u, y)


@cache
def coloured_fits():
    """Output-error fits of coloured records: as estimated, and judged."""
    out = []
    for seed in range(RUNS):
        data = record(COLOURED, seed)
        plain = oe(data, {"nb": 2, "nf": 2, "nk": 1})
        out.append((plain, judge(plain, data)))
    return out


@cache
def p_values(name):
    make = {
        "arx": lambda s: (arx, record(ARX, s), {"na": 2, "nb": 2, "nk": 1}),
        "armax": lambda s: (armax, record(ARMAX, s), {"na": 2, "nb": 2, "nc": 1, "nk": 1}),
        "loop": lambda s: (arx, loop(s), {"na": 2, "nb": 2, "nk": 1}),
    }

    def fit(seed):
        estimator, data, orders = make[name](seed)
        return judge(estimator(data, orders), data)

    fits = [f for _, f in coloured_fits()] if name == "oe, coloured" else [fit(seed) for seed in range(RUNS)]
    tests = ("residuals_white", "residuals_uncorrelated", "feedback")
    return np.array([[f.checks[k].p for k in tests] for f in fits])


# 5 % of 200: 10 +- 3.1; the bounds are three standard deviations wide, low enough to let conservative tests pass
@pytest.mark.parametrize("name", ["arx", "armax", "oe, coloured", "loop"])
@pytest.mark.parametrize("test", ["white", "uncorrelated", "feedback"])
def test_false_alarms_are_as_rare_as_promised(name, test):
    if (name, test) in (("oe, coloured", "white"), ("loop", "feedback")):
        found = np.mean(p_values(name)[:, 0 if test == "white" else 2] < 1e-3)
        assert found > 0.95  # what is there is found
        return
    p = p_values(name)[:, ["white", "uncorrelated", "feedback"].index(test)]
    assert RUNS.limit(0.005, centre=0.05) <= np.mean(p < 0.05) <= RUNS.limit(0.10, centre=0.05)
    assert RUNS.limit(0.25, centre=0.5) < np.mean(p) < RUNS.limit(0.60, centre=0.5)
    assert np.mean(p < 1e-3) <= max(0.01, 1 / RUNS)


def shown(fit, data, n_lags):
    found = errors(fit, data)
    residuals = linear_residuals(fit, data, found, gradient(fit, data, found))
    return correlations(residuals, data.inputs, data.outputs, n_lags=n_lags)


def test_bands_hold_95_percent_of_the_correlations():
    inside = []
    for seed in range(60):
        data = record(ARX, seed)
        fit = arx(data, {"na": 2, "nb": 2, "nk": 1})
        inside += [np.mean(np.abs(x.values) <= x.band) for x in shown(fit, data, 30)]
    assert 0.935 < np.mean(inside) < 0.965


def test_the_band_of_an_autoregression_is_the_published_one():
    """After fitting AR(1), the variance of r_k is (1 - (1 - a^2) a^(2k - 2))/N (Box and Pierce 1970)."""
    a, n = 0.4, 4000
    rng = np.random.default_rng(0)
    data = io(np.zeros((n, 0)), run(polynomial(A=(1, -a), B=(), F=()), np.zeros((n, 0)), rng.standard_normal((n, 1))))
    fit = arma(data, {"na": 1, "nc": 0})
    band = shown(fit, data, 6)[0].band
    k = np.arange(1, 7)
    wanted = 1.95996 * np.sqrt((1 - (1 - a**2) * a ** (2 * k - 2)) / n)
    np.testing.assert_allclose(band, wanted, rtol=0.05)


def test_coloured_noise_gets_the_covariance_that_the_scatter_shows():
    thetas, sds, naive = [], [], []
    for plain, fit in coloured_fits():
        assert any("coloured" in w for w in fit.warnings)
        assert fit.checks["residuals_white"].passed
        free = fit.sd > 0
        thetas.append(fit.model.theta[free])
        sds.append(fit.sd[free])
        naive.append(plain.sd[free])
    scatter, said, before = np.std(thetas, axis=0), np.mean(sds, axis=0), np.mean(naive, axis=0)
    np.testing.assert_allclose(said, scatter, rtol=RUNS.limit(0.2, centre=0))
    assert np.max(np.abs(np.log(before / scatter))) > 0.3
