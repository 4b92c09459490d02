"""Scalar filters: the gain and the step response of the thesis, and the error that it compares them by."""

from math import pi, sqrt

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.kalman import PassiveLowpass, ScalarKalman, kalman_bucy_gain

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


def test_gain_of_the_thesis():
    assert kalman_bucy_gain() == pytest.approx(sqrt(60.0))
    assert round(kalman_bucy_gain(), 3) == 7.746


@pytest.mark.parametrize(
    ("a", "c", "w", "q", "r"), [(-2.0, 0.5, 3.0, 7.0, 0.1), (5.0, 2.0, 1.0, 0.0, 1.0), (1, -1, 1, 1, 1)]
)
def test_gain_solves_the_riccati_equation_and_stabilises(a, c, w, q, r):
    gain = kalman_bucy_gain(a=a, c=c, w=w, q=q, r=r)
    s = gain * r / c
    assert 2 * a * s - (s * c) ** 2 / r + w * q * w == pytest.approx(0.0, abs=1e-12)
    assert s > 0
    assert a - gain * c < 0


def test_step_response_is_the_exact_exponential():
    y = np.ones(500)
    t = np.arange(500) / RATE
    np.testing.assert_allclose(ScalarKalman(RATE, start=0.0).update(y), 1 - np.exp(-sqrt(60.0) * t), atol=1e-13)
    np.testing.assert_allclose(
        PassiveLowpass(RATE, corner_hz=2.0, start=0.0).update(y), 1 - np.exp(-4 * pi * t), atol=1e-13
    )


def test_sampled_filter_is_the_continuous_one_at_any_rate():
    # The same held signal sampled 10 times as fast gives the same values: the discretisation is exact.
    y = np.random.default_rng(1).standard_normal(200)
    fast = ScalarKalman(10 * RATE, a=-3.0, c=2.0).update(np.repeat(y, 10))
    np.testing.assert_allclose(fast[::10], ScalarKalman(RATE, a=-3.0, c=2.0).update(y), atol=1e-12)


def test_first_value_and_decay():
    y = np.zeros(50)
    x = ScalarKalman(RATE, start=2.0).update(y)
    np.testing.assert_allclose(x, 2.0 * np.exp(-sqrt(60.0) / RATE) ** np.arange(50))
    assert ScalarKalman(RATE, c=2.0, a=0.0).update(y + 3.0)[0] == 1.5


def test_with_a_0_the_filter_is_the_passive_one_of_corner_L():
    y = walk(2, 1000)[1][:, 0]
    same = PassiveLowpass(RATE, corner_hz=sqrt(60.0) / (2 * pi)).update(y)
    np.testing.assert_allclose(ScalarKalman(RATE).update(y), same, rtol=1e-10)


@pytest.mark.parametrize(
    "numbers", [{"c": 0.0}, {"q": -1.0}, {"r": 0.0}, {"q": 0.0}, {"a": float("nan")}, {"w": float("inf")}]
)
def test_numbers_without_a_filter_are_refused(numbers):
    with pytest.raises(EstimationError, match="Kalman-Bucy"):
        kalman_bucy_gain(**numbers)


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
    for corner in (0.0, -1.0, float("nan")):
        with pytest.raises(EstimationError, match="corner"):
            PassiveLowpass(RATE, corner_hz=corner)
    with pytest.raises(EstimationError, match=r"shape \(4,\)"):
        ScalarKalman(RATE, channels=3).update(np.ones(4))
