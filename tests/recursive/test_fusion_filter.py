"""The filter: the textbook's numbers, honest standard deviations, the same from samples and blocks, sound for ever."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.fusion import SensorFusion, still_samples
from ambid.recursive.kalman import KalmanFilter, constant_velocity, linear_state
from tests.recursive.fusion_benches import GAIN, NOISE, RATE, SIGMA, Q, fusion, readings, sensors, vibration

DRIFT = 0.2  # V/√s: fast, so that offsets walk in single samples


def walking_motion(rng, runs, n, q=Q):
    """Position under white acceleration, from a start of the spread that the filter is told, (runs, n)."""
    T = 1 / RATE
    v = 1e-3 * rng.standard_normal((runs, 1)) + np.cumsum(rng.standard_normal((runs, n)) * np.sqrt(q * T), axis=1)
    return 5e-6 * rng.standard_normal((runs, 1)) + np.cumsum(v, axis=1) * T


def test_without_faults_it_is_the_kalman_filter_of_the_whole_state():
    """Against the array form of `KalmanFilter` on [x, v, o_a, o_b, o_c], an unlike implementation."""
    y = readings(vibration(400), seed=3)
    y[100:103, 1] = np.nan
    fused = fusion(settings={"drift_rate": DRIFT, "offset_sd": 4e-3})
    state = constant_velocity(RATE, q=Q, r=1.0)
    A, Qs = np.eye(5), np.diag([0, 0, *[(DRIFT / GAIN) ** 2 / RATE] * 3])
    A[:2, :2], Qs[:2, :2] = state.A, state.Q
    model = linear_state(A, np.hstack([np.ones((3, 1)), np.zeros((3, 1)), np.eye(3)]), Qs, SIGMA**2 * np.eye(3))
    other = KalmanFilter(model, start_covariance=np.diag([1e-6, 1.0, *[(4e-3 / GAIN) ** 2] * 3]))
    expected, got = other.update(y / GAIN), fused.update(y)
    assert fused.n_gated.sum() == 0
    assert np.abs(got[:, 0] - expected[:, 0]).max() < 1e-6 * SIGMA
    assert fused.state == pytest.approx(other.state, rel=1e-6, abs=1e-6 * SIGMA)
    assert fused.covariance == pytest.approx(other.covariance, rel=1e-6, abs=1e-9 * other.covariance[2, 2])


def test_errors_are_as_large_as_stated_and_smaller_than_of_the_best_sensor():
    rng = np.random.default_rng(5)
    runs, n = 400, 120
    x = walking_motion(rng, runs, n)
    steps = rng.standard_normal((runs, n, 3)) * (0.02 / np.sqrt(RATE))
    zeros = 3e-3 * rng.standard_normal((runs, 1, 3)) + np.cumsum(steps, axis=1)
    noise = np.array([2e-3, 3e-3, 4e-3])
    y = GAIN * x[:, :, None] + zeros + noise * rng.standard_normal((runs, n, 3))
    used = [replace(s, noise_sd=sd, drift_rate=0.02, offset_sd=3e-3) for s, sd in zip(sensors(), noise, strict=True)]
    fresh = SensorFusion(RATE, used, q=Q, start_sd=(5e-6, 1e-3))
    normalised, errors = np.empty(runs), np.empty(runs)
    for k in range(runs):
        out = fresh.copy().update(y[k])
        errors[k] = out[-1, 0] - x[k, -1]
        normalised[k] = errors[k] / out[-1, 1]
    assert 0.90 < np.mean(np.abs(normalised) < 1.96) < 0.98
    assert 0.85 < np.std(normalised) < 1.15
    best = np.sqrt(np.mean((y[:, -1] / GAIN - x[:, -1:]) ** 2, axis=0)).min()
    assert np.sqrt(np.mean(errors**2)) < 0.8 * best


def test_samples_and_blocks_give_the_same_numbers_through_faults():
    y = readings(vibration(6000), seed=7)
    y[500:520, 0] = np.nan
    y[1500:, 1] += 20 * NOISE
    y[3000:3100, 2] = y[3000, 2]
    whole, pieces, singles = (fusion(restore_s=0.01) for _ in range(3))
    out = whole.update(y)
    cut = np.vstack([pieces.update(part) for part in np.array_split(y, [1, 7, 64, 65, 501, 1502, 3003, 5999])])
    one = np.array([singles.update(row) for row in y])
    for other, got in ((pieces, cut), (singles, one)):
        assert np.array_equal(out, got)
        assert whole.events == other.events
        assert np.array_equal(whole.covariance, other.covariance)
    assert {e.kind for e in whole.events} == {"excluded", "restored"}


def test_a_copy_goes_its_own_way():
    y = readings(vibration(300))
    first = fusion()
    first.update(y[:100])
    second = first.copy()
    ahead = first.update(y[100:])
    assert second.n_samples == 100
    assert np.array_equal(second.update(y[100:]), ahead)


def test_the_covariance_stays_positive_and_what_cannot_be_seen_grows_as_the_drift_says():
    drift = 0.05
    fused = fusion(settings={"drift_rate": drift, "offset_sd": 2e-3})
    variances, times = [], []
    y = readings(vibration(20_000))
    for k in range(40):
        fused.update(y + 0.0)
        P = fused.covariance
        assert np.linalg.eigvalsh(P / np.sqrt(np.outer(np.diag(P), np.diag(P)))).min() > 0
        variances.append(P[0, 0])  # the position up, all offsets down: what no sensor shows
        times.append((k + 1) * 1.0)
    mean_drift = (2e-3 / GAIN) ** 2 / 3 + (drift / GAIN) ** 2 * np.array(times) / 3  # of the mean of three zeros
    assert np.array(variances) == pytest.approx(mean_drift, rel=0.1)
    assert fused.relative_sd < SIGMA


def test_all_missing_is_predicted_with_growing_doubt():
    fused = fusion()
    fused.update(readings(vibration(200)))
    out = fused.update(np.full((5, 3), np.nan))
    assert np.isfinite(out).all()
    assert (np.diff(out[:, 1]) > 0).all()


def test_levels_say_whether_the_stated_noise_is_right():
    fused = fusion(settings={"noise_sd": 1.25 * NOISE})
    fused.update(readings(vibration(20_000)))
    assert fused.levels == pytest.approx(np.full(3, 0.8), rel=0.03)


def test_how_long_a_value_may_stand_still_follows_from_resolution_and_noise():
    rng = np.random.default_rng(0)
    (fine,) = sensors(1, resolution=NOISE)
    n = still_samples(fine, RATE, 1e4)
    rounded = np.round(rng.standard_normal(2_000_000))  # in steps, at the middle of one: where it stands still most
    same = np.flatnonzero(np.diff(rounded) != 0)
    assert 3 < n < 20
    assert np.mean(np.diff(same) > n) < 3e-4
    assert still_samples(sensors(1, resolution=100 * NOISE)[0], RATE, 1e9) == 0.0
    assert still_samples(sensors(1)[0], RATE, 1e9) == 3.0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: fusion(1), "two or more"),
        (lambda: SensorFusion(RATE, sensors() + sensors(1), q=Q), "distinct names"),
        (lambda: fusion(restore_s=0.0), "must be positive"),
        (lambda: sensors(1, gain=0.0), "finite and not 0"),
        (lambda: sensors(1, noise_sd=-1.0), "positive"),
        (lambda: sensors(1, limits=(1.0, 0.0)), "low < high"),
        (lambda: fusion().update(np.zeros((5, 2))), "for 3 channels"),
        (lambda: fusion(start_sd=(0.0, 1.0)), "two positive numbers"),
    ],
)  # fmt: skip
def test_refusals_name_the_rule(make, words):
    with pytest.raises(EstimationError, match=words):
        make()
