"""Residual tests: quiet on the right model, with and without feedback, and loud on a wrong one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from ambid.estimation.likelihood import innovations, search
from ambid.validation.physical import innovation_products, innovation_tests
from tests.bearing.benches import problem_of, run
from tests.validation.wrong import WithoutMotionalVoltage

AXIS = ("m", "k_x", "k_i", "R", "L")
KNOWN = {
    "bearing": AXIS,
    "thesis": AXIS,
    "coil": ("R", "L"),
    "falling rotor": ("k_x", "k_i"),
    "sprung rotor": ("k_x", "k_i", "c"),
}


def fitted(name, n, seed, *, change=lambda problem: problem, **bench):
    problem, vector = problem_of(run(name, n, seed, **bench), estimated=KNOWN[name])
    fit = search(change(problem), vector)
    return fit, innovations(fit.problem, fit.vector)


def residuals_white(fit, e):
    return innovation_tests(fit, innovation_products(fit, e))[0]


def residuals_uncorrelated(fit, e):
    return innovation_tests(fit, innovation_products(fit, e))[1]


@pytest.mark.parametrize("name", KNOWN)
@pytest.mark.parametrize("test", [residuals_white, residuals_uncorrelated])
def test_the_right_model_passes(name, test):
    fit, e = fitted(name, 5000, 31)
    found = test(fit, e)
    assert found.passed
    assert found.p == pytest.approx(chi2.sf(found.statistic, found.degrees), rel=1e-9)
    assert found.largest < 5 / np.sqrt(len(e))


@pytest.fixture(scope="module")
def coils():
    return [fitted("coil", 1500, 200 + s) for s in range(100)]


@pytest.mark.parametrize("test", [residuals_white, residuals_uncorrelated])
def test_p_is_uniform_without_feedback(test, coils):
    found = [test(fit, e) for fit, e in coils]
    assert kstest([t.p for t in found], "uniform").pvalue > 1e-3
    degrees = {t.degrees for t in found}
    mean = np.mean([t.statistic / t.degrees for t in found])
    assert mean == pytest.approx(1.0, abs=3.5 * np.sqrt(2 / min(degrees) / 100))


def test_an_ignored_delay_is_noticed():
    ignored = {"delay": 0, "lag": 0.0}
    fit, e = fitted("bearing", 4000, 32, change=lambda p: replace(p, **ignored))
    assert not residuals_uncorrelated(fit, e).passed
    assert residuals_uncorrelated(fit, e).p < 1e-6


def test_an_ignored_part_of_a_sample_is_noticed():
    fit, e = fitted("bearing", 8000, 32, delay=1.5, change=lambda p: replace(p, delay=1, lag=0.0))
    assert not residuals_uncorrelated(fit, e).passed


def test_a_missing_motional_voltage_is_noticed():
    fit, e = fitted("bearing", 4000, 33, change=lambda p: replace(p, model=WithoutMotionalVoltage()))
    assert not residuals_white(fit, e).passed or not residuals_uncorrelated(fit, e).passed


def test_a_wrong_fixed_mass_is_noticed():
    def heavier(problem):
        names = ("k_x", "k_i", "R", "L")
        keep = [problem.estimated.index(k) for k in names]
        return replace(
            problem, estimated=names, known={**problem.known, "m": 1.3 * 4.0}, magnitude=problem.magnitude[keep],
            prior_mean=problem.prior_mean[keep], prior_sd=problem.prior_sd[keep],
        )  # fmt: skip

    problem, vector = problem_of(run("bearing", 8000, 34), estimated=AXIS)
    fit = search(heavier(problem), vector[1:])
    e = innovations(fit.problem, fit.vector)
    assert min(residuals_white(fit, e).p, residuals_uncorrelated(fit, e).p) < 1e-3


def test_coloured_sensor_noise_is_not_white():
    bench = run("thesis", 4000, 35)
    rng = np.random.default_rng(0)
    ring = np.convolve(rng.standard_normal(4000), 0.7 ** np.arange(40) * np.cos(np.arange(40)), mode="same")
    signals = replace(bench.signals, y=bench.signals.y + np.c_[ring, 0 * ring] * 3 * bench.sensor[0])
    problem, vector = problem_of(replace(bench, signals=signals), estimated=AXIS)
    fit = search(problem, vector)
    assert residuals_white(fit, innovations(problem, fit.vector)).p < 1e-6


def test_feedback_does_not_disturb():
    # innovations do correlate with inputs to come, because the controller answers them: that may not count
    fit, e = fitted("falling rotor", 8000, 36, position=1e-6)
    white = e / e.std(axis=0)
    u = fit.problem.u[fit.problem.skip :, 0]
    u = (u - u.mean()) / u.std()
    ahead = max(abs(np.mean(white[:-k, j] * u[k:])) for k in (1, 2, 5, 20) for j in range(e.shape[1]))
    assert ahead > 5 / np.sqrt(len(e))  # the trap is there
    assert residuals_uncorrelated(fit, e).passed
    assert residuals_white(fit, e).passed


def test_lags_of_a_slow_input_are_not_counted_twice():
    bench = run("coil", 3000, 37)
    slow = np.sin(2 * np.pi * np.arange(3000) / 3000)[:, None]
    problem, vector = problem_of(replace(bench, signals=replace(bench.signals, u=slow)), estimated=("R",))
    fit = search(problem, vector)
    found = residuals_uncorrelated(fit, innovations(problem, fit.vector))
    assert 0 <= found.degrees < 12  # all lags of one sine span two columns (and ends)


def test_every_sample_counts_with_a_stride():
    bench = run("bearing", 4000, 38)
    problem, vector = problem_of(bench, estimated=AXIS, noise="gain", stride=2)
    fit = search(problem, vector)
    e = innovations(problem, fit.vector)
    assert residuals_white(fit, e).passed
    assert residuals_uncorrelated(fit, e).passed
