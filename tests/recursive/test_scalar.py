"""Streaming scalar filters: the off-line ones sample by sample, and the error that the thesis compares them by."""

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.streaming import PassiveLowpass, ScalarKalman
from ambid.signals import kalman_bucy, passive_lowpass

RATE = 1000.0


def walk(seed, n, *, a=0.0, c=1.0, q=60.0, r=1.0, channels=1):
    """State and samples of x' = a x + noise of intensity q, y = c x + noise of intensity r."""
    rng = np.random.default_rng(seed)
    rho = np.exp(a / RATE)
    step = np.sqrt(q * (np.expm1(2 * a / RATE) / (2 * a) if a else 1 / RATE))
    x = np.zeros((n, channels))
    w = step * rng.standard_normal((n, channels))
    for k in range(1, n):
        x[k] = rho * x[k - 1] + w[k]
    return x, c * x + np.sqrt(r * RATE) * rng.standard_normal((n, channels))


@pytest.mark.parametrize("numbers", [{}, {"a": -3.0, "c": 2.0, "w": 0.5}, {"a": 2.0, "q": 5.0}])
def test_the_continuous_form_is_the_off_line_filter(numbers):
    y = walk(0, 2000)[1][:, 0]
    found = ScalarKalman(RATE, **numbers).update(y)
    np.testing.assert_allclose(found, kalman_bucy(y, RATE, **numbers), rtol=1e-10, atol=1e-10)


def test_the_passive_form_is_the_off_line_filter():
    y = walk(0, 2000)[1][:, 0]
    found = PassiveLowpass(RATE, corner_hz=3.0).update(y)
    np.testing.assert_allclose(found, passive_lowpass(y, RATE, corner_hz=3.0), rtol=1e-10, atol=1e-10)


FORMS = [
    lambda m: ScalarKalman(RATE, a=-4.0, c=2.0, channels=m),
    lambda m: ScalarKalman(RATE, start=3.0, channels=m),
    lambda m: PassiveLowpass(RATE, corner_hz=5.0, channels=m),
]


@pytest.mark.parametrize("make", FORMS)
def test_splitting_a_stream_changes_no_number(make):
    y = walk(1, 600, channels=3)[1]
    y[:2, 1] = np.nan
    y[100:130] = np.nan
    y[300, 2] = np.inf
    whole = make(3)
    blocks, singles, alone = whole.copy(), whole.copy(), make(1)
    wanted = whole.update(y)
    np.testing.assert_array_equal(np.vstack([blocks.update(y[a:b]) for a, b in ((0, 1), (1, 117), (117, 600))]), wanted)
    np.testing.assert_array_equal([singles.update(row) for row in y], wanted)
    np.testing.assert_array_equal([alone.update(float(v)) for v in y[:, 1]], wanted[:, 1])
    assert singles.n_missing == whole.n_missing == 2 + 90 + 1
    assert singles.n_samples == 600
    assert np.isfinite(wanted[130:]).all()


def test_input_is_left_alone_and_may_be_read_only():
    y = walk(1, 50)[1]
    y.flags.writeable = False
    assert np.array_equal(ScalarKalman(RATE).update(y), ScalarKalman(RATE).update(y.copy()))
    assert ScalarKalman(RATE).update(list(y[:, 0])).shape == (50,)


def test_kalman_bucy_beside_passive_filters_at_equal_noise():
    # Error variances of thesis figs 5.10-5.12's comparison: Q = 60, R = 1. A low-pass of corner w rad/s leaves
    # (Q + w^2 R)/(2 w); least at w = L = sqrt(60), where it is S = 7.746: the
    # Kalman-Bucy filter is the low-pass that fits the noise.
    x, y = walk(7, 100_000, channels=8)
    variance = {"kalman": np.mean((ScalarKalman(RATE, channels=8).update(y) - x)[2000:] ** 2)}
    for corner in (0.3, 1.0, 5.0, 20.0):
        found = PassiveLowpass(RATE, corner_hz=corner, channels=8).update(y)
        variance[corner] = np.mean((found - x)[2000:] ** 2)
        omega = 2 * np.pi * corner
        assert variance[corner] == pytest.approx((60 + omega**2) / (2 * omega), rel=0.08)
    assert variance["kalman"] == pytest.approx(np.sqrt(60), rel=0.05)
    assert variance["kalman"] == min(variance.values())
    assert variance[20.0] > 8 * variance["kalman"]


def test_refusals():
    with pytest.raises(EstimationError, match="rate"):
        ScalarKalman(0.0)
    with pytest.raises(EstimationError, match="stationary"):
        ScalarKalman(RATE, q=0.0)
    with pytest.raises(EstimationError, match="channels"):
        ScalarKalman(RATE, channels=0)
    with pytest.raises(EstimationError, match="corner"):
        PassiveLowpass(RATE, corner_hz=0.0)
    with pytest.raises(EstimationError, match=r"shape \(4,\)"):
        ScalarKalman(RATE, channels=3).update(np.ones(4))
