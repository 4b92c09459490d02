"""Many runs of an unstable bearing under feedback: intervals cover, the spread is the bound, the mean is the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest, norm

import ambid
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset
from tests.bearing.benches import run
from tests.estimation.kalman import cramer_rao_sd
from tests.statistical.runs import EXCITATION_SEED, NAMES, many
from tests.tiers import runs as number

N_RUNS = number(160, short=40)
N_SAMPLES = 4000


@pytest.fixture(scope="module")
def runs():
    return many(N_RUNS, n=N_SAMPLES)


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


@pytest.fixture(scope="module")
def bound(runs):
    """Deviations by the information at the truth, and the part of each error that the score makes."""
    whole = np.linalg.inv(np.mean([r.information for r in runs], axis=0))
    chance = -np.array([(whole @ r.score)[: len(NAMES)] * r.unit for r in runs])
    return np.sqrt(np.diag(whole)[: len(NAMES)]) * np.abs(runs[0].unit), chance


def test_intervals_cover_as_they_say(estimates, sds):
    assert np.all(sds < 0.25)  # each is identifiable
    # 160 runs know a share of 0.95 to 0.017 and one of 0.5 to 0.04; the spread below is known far better
    for half_width, low, high in ((1.959964, 0.898, 1.0), (0.674490, 0.36, 0.64)):
        inside = np.mean(np.abs(estimates - 1) < half_width * sds, axis=0)
        low, high = (N_RUNS.limit(x, centre=0.95 if low > 0.5 else 0.5) for x in (low, high))
        assert np.all((inside >= low) & (inside <= high)), named(inside)


def test_spread_is_the_cramer_rao_bound(estimates, sds, bound):
    sd, chance = bound
    # the score's part of the errors has this spread whatever the estimator does: 160 runs know the ratio to 0.8 %
    ratio = estimates.std(axis=0, ddof=1) / chance.std(axis=0, ddof=1)
    assert np.all(np.abs(ratio - 1) < N_RUNS.limit(0.04, centre=0)), named(ratio)
    ratio = np.sqrt(np.mean(sds**2, axis=0)) / sd
    assert np.all((ratio < 1.06) & (ratio > 0.93)), named(ratio)
    bench = run("bearing", N_SAMPLES, 1000, delay=0.0, excitation_seed=EXCITATION_SEED)
    ratio = sd * np.abs([bench.truth[k] for k in NAMES]) / cramer_rao_sd(bench, NAMES)
    assert np.all((ratio < 1.02) & (ratio > 0.98)), named(ratio)


def test_feedback_leaves_no_bias(estimates, bound):
    sd = estimates.std(axis=0, ddof=1)
    plain = (estimates.mean(axis=0) - 1) / sd
    assert np.all(np.abs(plain) < 3.3 / np.sqrt(N_RUNS)), named(plain)
    # the score at the truth has mean zero and explains 98 % of each variance: what is left shows a bias much sharper
    left = estimates - 1 - bound[1]
    assert np.all(left.std(axis=0) < 0.2 * sd), named(left.std(axis=0) / sd)
    assert np.all(np.abs(left.mean(axis=0)) < N_RUNS.limit(0.03, centre=0) * sd), named(left.mean(axis=0) / sd)


def test_estimates_are_jointly_normal(estimates):
    centred = estimates - estimates.mean(axis=0)
    distance = np.einsum("ri,ij,rj->r", centred, np.linalg.inv(np.cov(centred.T)), centred)
    assert kstest(distance, chi2(len(NAMES)).cdf).pvalue > 1e-3


@pytest.mark.parametrize("test", ["white", "uncorrelated"])
def test_residual_tests_are_calibrated_under_feedback(runs, test):
    p = np.array([getattr(r, test) for r in runs])
    assert kstest(p, "uniform").pvalue > 1e-3
    assert abs(np.mean(norm.ppf(p))) < 3.3 / np.sqrt(N_RUNS)
    # at the checks' threshold of 0.001, 160 runs give 0.16 false alarms on average
    assert np.sum(p < 1e-3) <= 2


def test_what_is_not_given_is_found():
    # the whole job: delay searched, start values from the data alone
    n = number(60, short=16)
    rig = rig_of_preset(preset("unstable-bearing"))
    truth = {p.name: p.value for p in rig.parameters if p.role == "free"}
    known = replace(rig, parameters=tuple(replace(p, value=None) if p.name in truth else p for p in rig.parameters))
    found = [ambid.identify(ambid.simulate(rig, duration=0.2, seed=k), known) for k in range(1, n + 1)]
    assert {e.verdict.word for e in found} <= {"usable", "caution"}
    for name, value in truth.items():
        x, sd = np.array([(e[name].value - value, e[name].sd) for e in found]).T
        assert all(e[name].identifiable for e in found)
        assert np.max(np.abs(x / sd)) < 4.5
        assert abs(x.mean()) < 3.3 * x.std(ddof=1) / np.sqrt(n)
        assert np.sum(np.abs(x / sd) < 1.959964) >= 0.95 * n - 3.5 * np.sqrt(0.95 * 0.05 * n)
        ratio = np.sqrt(np.mean(sd**2)) / x.std(ddof=1)  # 60 runs know a spread to 9 %
        assert n.limit(0.7, centre=1) < ratio < n.limit(1.4, centre=1)


def test_a_short_record_is_not_overconfident():
    # 50 ms: the noise levels themselves are hardly known, and maximum likelihood takes them for too small
    n = number(75, short=25)
    found = many(n, n=1000)
    estimates, sds = np.array([r.estimate for r in found]), np.array([r.sd for r in found])
    # 75 runs know a coverage of 0.95 to 0.025; more than it promises is no harm here
    inside = np.mean(np.abs(estimates - 1) < 1.959964 * sds, axis=0)
    assert np.all(inside >= n.limit(0.88)), named(inside)
    ratio = np.median(sds, axis=0) / estimates.std(axis=0, ddof=1)
    assert np.all((ratio > n.limit(0.8, centre=1)) & (ratio < 2.0)), named(ratio)


@pytest.mark.parametrize("seed", [12, 13])
def test_a_record_shorter_than_the_noise_needs_is_not_explained_by_a_walk(seed):
    estimate = ambid.identify(
        ambid.simulate("levitated-ball", duration=0.15, seed=seed), rig_of_preset(preset("levitated-ball"))
    )
    assert not estimate.extended
    assert not estimate.checks["long_enough"].passed
