"""Monte Carlo: frequency response estimates are unbiased and scatter as their variances state."""

from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.signals.frf import frf_local, frf_random
from ambid.signals.periodic_response import frf_periodic
from tests.signals.frf_benches import A, B, Loop, inside, mimo, mimo_response, one_period, response, steady
from tests.tiers import runs as number

RUNS = number(200, short=60)
N = 256
LINES = np.arange(2, 90)


def periodic_noisy_both(rng):
    x = one_period(rng, LINES, N)
    common = rng.standard_normal(4 * N)  # the same noise at input and output, as a loop makes it
    u = np.tile(x, 4) + 0.2 * rng.standard_normal(4 * N) + 0.2 * common
    y = steady(lambda s: lfilter(B, A, s), x, 4) + 0.3 * common
    return frf_periodic(u, y, 1.0, period=N, lines=LINES)


def periodic_realisations(rng):
    x = [one_period(rng, LINES, N) for _ in range(6)]
    u = [np.tile(s, 2) + 0.1 * rng.standard_normal(2 * N) for s in x]
    y = [steady(lambda s: lfilter(B, A, s), s, 2) + 0.3 * rng.standard_normal(2 * N) for s in x]
    return frf_periodic(u, y, 1.0, period=N, lines=LINES)


def periodic_with_reference(rng):
    r = [np.tile(one_period(rng, LINES, N), 5) for _ in range(6)]
    io = [Loop().run(s, 0.1 * rng.standard_normal(5 * N)) for s in r]
    return frf_periodic(
        [u for u, _ in io], [y for _, y in io], 1.0, r=r, period=N, lines=LINES, drop_periods=1, open_loop=False
    )


def h1(rng):
    u = rng.standard_normal(4096)
    return frf_random(u, lfilter(B, A, u) + 0.5 * rng.standard_normal(4096), 1.0, segment=256)


def welch_with_reference(rng):
    r = rng.standard_normal(16384)
    u, y = Loop().run(r, 0.1 * rng.standard_normal(16384))
    return frf_random(u, y, 1.0, r=r, segment=256)


def local(rng):
    u = rng.standard_normal(712)
    y = lfilter(B, A, u) + 0.3 * lfilter([1.0], [1.0, -0.5], rng.standard_normal(712))
    return frf_local(u[200:], y[200:], 1.0, free=12)


def local_with_reference(rng):
    r = rng.standard_normal(1224)
    u, y = Loop().run(r, 0.1 * rng.standard_normal(1224))
    return frf_local(u[200:], y[200:], 1.0, r=r[200:], free=12)


@cache
def runs(estimate):
    rng = np.random.default_rng(7)
    return [estimate(rng) for _ in range(RUNS)]


@pytest.mark.parametrize(
    ("estimate", "plant"),
    [
        (periodic_noisy_both, (B, A)),
        (periodic_realisations, (B, A)),
        (periodic_with_reference, (Loop.b, Loop.a)),
        (h1, (B, A)),
        (welch_with_reference, (Loop.b, Loop.a)),
        (local, (B, A)),
        (local_with_reference, (Loop.b, Loop.a)),
    ],
    ids=lambda x: x.__name__ if callable(x) else "at",
)
def test_the_estimate_is_unbiased_and_its_variance_true(estimate, plant):
    found = runs(estimate)
    truth = response(*plant, found[0].frequency_hz)[:, None, None]
    error = np.stack([f.G for f in found]) - truth
    variance = np.mean(np.abs(error - error.mean(axis=0)) ** 2, axis=0)
    stated = np.mean([f.sd**2 for f in found], axis=0)
    bias = np.abs(error.mean(axis=0)) / np.sqrt(variance)
    assert np.sqrt(np.mean(bias**2)) < RUNS.limit(0.15, centre=0)  # 0.07 is what 200 runs leave
    assert RUNS.limit(0.9, centre=1) < np.median(stated / variance) < RUNS.limit(1.12, centre=1)
    assert RUNS.limit(0.93) < np.mean([inside(f, truth) for f in found]) < RUNS.limit(0.968)


def test_variance_of_what_is_fitted_to_all_lines_is_foretold():
    for estimate in (h1, local):
        found = runs(estimate)
        truth = response(B, A, found[0].frequency_hz)[:, None, None]
        weight = 1 / np.mean([f.sd**2 for f in found], axis=0)
        mean = np.array([np.sum(weight * (f.G - truth)) for f in found]) / np.sum(weight)
        apart = np.sum(weight) * np.mean(np.abs(mean) ** 2)
        assert apart > 1.5  # lines are not independent
        assert (
            RUNS.limit(0.7, centre=1)
            < apart / np.mean([f.lines_per_independent for f in found])
            < RUNS.limit(1.4, centre=1)
        )


def mimo_periodic(rng):
    e = rng.standard_normal((2, 4 * N, 2)) @ np.array([[0.2, 0.1], [0.0, 0.15]])
    x = np.stack([one_period(rng, LINES, N), one_period(rng, LINES, N)], axis=1)
    pairs = [x, x * np.array([1.0, -1.0])]  # orthogonal experiments
    return frf_periodic(
        [np.tile(p, (4, 1)) for p in pairs], [steady(mimo, p, 4) + v for p, v in zip(pairs, e, strict=True)], 1.0,
        period=N, lines=LINES,
    )  # fmt: skip


def mimo_h1(rng):
    u = rng.standard_normal((4096, 2)) @ np.array([[1.0, 0.5], [0.0, 1.0]])
    y = mimo(u) + rng.standard_normal((4096, 2)) @ np.array([[0.4, 0.2], [0.0, 0.3]])
    return frf_random(u, y, 1.0, segment=256)


def mimo_local(rng):
    u = rng.standard_normal((712, 2)) @ np.array([[1.0, 0.5], [0.0, 1.0]])
    y = mimo(u) + rng.standard_normal((712, 2)) @ np.array([[0.4, 0.2], [0.0, 0.3]])
    return frf_local(u[200:], y[200:], 1.0)


@pytest.mark.parametrize("estimate", [mimo_periodic, mimo_h1, mimo_local])
def test_several_inputs_and_outputs_have_the_joint_covariance_that_is_stated(estimate):
    rng = np.random.default_rng(9)
    found = [estimate(rng) for _ in range(RUNS)]
    error = np.stack([f.G for f in found]) - mimo_response(found[0].frequency_hz)
    vectors = error.reshape(*error.shape[:2], 4)
    sampled = np.einsum("rfi,rfj->ij", vectors, vectors.conj()) / vectors.shape[0] / vectors.shape[1]
    stated = np.mean([f.covariance for f in found], axis=(0, 1))
    assert np.linalg.norm(stated - sampled) < RUNS.limit(0.06, centre=0) * np.linalg.norm(sampled)
    off = np.abs(stated[0, 2])  # the same input, two outputs: the noise they share
    assert off > 0.2 * np.sqrt(np.real(stated[0, 0] * stated[2, 2]))
    pseudo = np.einsum("rfi,rfj->ij", vectors, vectors) / vectors.shape[0] / vectors.shape[1]
    assert np.linalg.norm(pseudo) < RUNS.limit(0.06, centre=0) * np.linalg.norm(sampled)  # circular
