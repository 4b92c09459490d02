"""Many runs of an unstable bearing under feedback: intervals cover, the spread is the bound, the mean is the truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from tests.bearing.benches import run
from tests.estimation.kalman import cramer_rao_sd
from tests.statistical.runs import EXCITATION_SEED, NAMES, many

pytestmark = pytest.mark.slow

N_RUNS = 400
N_SAMPLES = 4000


@pytest.fixture(scope="module")
def runs():
    return many(N_RUNS, n=N_SAMPLES, auto=False)


@pytest.fixture(scope="module")
def estimates(runs):
    return np.array([r.estimate for r in runs])


@pytest.fixture(scope="module")
def sds(runs):
    return np.array([r.sd for r in runs])


def named(values):
    return dict(zip(NAMES, np.round(values, 4).tolist(), strict=True))


def test_every_run_converges(runs):
    assert all(r.converged for r in runs)


def test_intervals_cover_as_they_say(estimates, sds):
    assert np.all(sds < 0.25)  # each is identifiable
    for half_width, low, high in ((1.959964, 0.917, 0.983), (0.674490, 0.41, 0.59)):
        inside = np.mean(np.abs(estimates - 1) < half_width * sds, axis=0)
        assert np.all((inside >= low) & (inside <= high)), named(inside)


def test_spread_is_the_cramer_rao_bound(estimates, sds):
    # 400 runs: the spread itself is known to 1/sqrt(800) = 3.5 %
    ratio = estimates.std(axis=0, ddof=1) / np.sqrt(np.mean(sds**2, axis=0))
    assert np.all((ratio < 1.10) & (ratio > 0.88)), named(ratio)
    bench = run("bearing", N_SAMPLES, 1000, delay=0.0, excitation_seed=EXCITATION_SEED)
    bound = cramer_rao_sd(bench, NAMES) / np.abs([bench.truth[k] for k in NAMES])
    ratio = estimates.std(axis=0, ddof=1) / bound
    assert np.all((ratio < 1.10) & (ratio > 0.88)), named(ratio)


def test_feedback_leaves_no_bias(estimates, runs):
    sd = estimates.std(axis=0, ddof=1)
    plain = (estimates.mean(axis=0) - 1) / sd
    assert np.all(np.abs(plain) < 3.3 / np.sqrt(N_RUNS)), named(plain)
    # the score at the truth has mean zero and explains 90 % of each error: what is left shows a bias ten times sharper
    whole = np.linalg.inv(np.mean([r.information for r in runs], axis=0))
    chance = -np.array([(whole @ r.score)[: len(NAMES)] * r.unit for r in runs])
    left = estimates - 1 - chance
    assert np.all(left.std(axis=0) < 0.3 * sd), named(left.std(axis=0) / sd)
    assert np.all(np.abs(left.mean(axis=0)) < 0.03 * sd), named(left.mean(axis=0) / sd)


def test_estimates_are_jointly_normal(estimates):
    centred = estimates - estimates.mean(axis=0)
    distance = np.einsum("ri,ij,rj->r", centred, np.linalg.inv(np.cov(centred.T)), centred)
    assert kstest(distance, chi2(len(NAMES)).cdf).pvalue > 1e-3


@pytest.mark.parametrize("test", ["white", "uncorrelated"])
def test_residual_tests_are_calibrated_under_feedback(runs, test):
    p = np.array([getattr(r, test) for r in runs])
    assert kstest(p, "uniform").pvalue > 1e-3
    # at the checks' threshold of 0.001, 400 runs give 0.4 false alarms on average
    assert np.sum(p < 1e-3) <= 4


def test_what_is_not_given_is_found():
    # delay searched, start values from the data alone
    found = many(60, n=N_SAMPLES, auto=True)
    assert all(r.converged for r in found)
    assert all(r.delay_right for r in found)
    z = np.array([(r.estimate - 1) / r.sd for r in found])
    assert np.abs(z).max() < 4.5
    assert np.all(np.abs(z.mean(axis=0)) < 3.3 / np.sqrt(60)), named(z.mean(axis=0))
    # 15 of 300 expected beyond 1.96; those of one run are correlated
    assert np.sum(np.abs(z) > 1.959964) <= 30


def test_a_short_record_is_not_overconfident():
    # 50 ms: the noise levels themselves are hardly known, and maximum likelihood takes them for too small
    found = many(150, n=1000, auto=False)
    estimates, sds = np.array([r.estimate for r in found]), np.array([r.sd for r in found])
    # 150 runs know a coverage of 0.95 to 0.018; more than it promises is no harm here
    inside = np.mean(np.abs(estimates - 1) < 1.959964 * sds, axis=0)
    assert np.all(inside >= 0.90), named(inside)
    ratio = np.median(sds, axis=0) / estimates.std(axis=0, ddof=1)
    assert np.all((ratio > 0.8) & (ratio < 2.0)), named(ratio)
