"""The scalar Kalman-Bucy filter of the thesis, and the passive filter beside it."""

from __future__ import annotations

from math import exp, pi, sqrt

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.signals import kalman_bucy, kalman_bucy_gain, passive_lowpass

RATE = 1000.0


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
    np.testing.assert_allclose(kalman_bucy(y, RATE, start=0.0), 1 - np.exp(-sqrt(60.0) * t), atol=1e-13)
    np.testing.assert_allclose(passive_lowpass(y, RATE, corner_hz=2.0, start=0.0), 1 - np.exp(-4 * pi * t), atol=1e-13)


def test_sampled_filter_is_the_continuous_one_at_any_rate():
    # The same held signal sampled 10 times as fast gives the same values: the discretisation is exact.
    y = np.random.default_rng(1).standard_normal(200)
    fast = kalman_bucy(np.repeat(y, 10), 10 * RATE, a=-3.0, c=2.0)
    np.testing.assert_allclose(fast[::10], kalman_bucy(y, RATE, a=-3.0, c=2.0), atol=1e-12)


def test_first_value_and_decay():
    y = np.zeros(50)
    x = kalman_bucy(y, RATE, start=2.0)
    np.testing.assert_allclose(x, 2.0 * exp(-sqrt(60.0) / RATE) ** np.arange(50))
    assert kalman_bucy(y + 3.0, RATE, c=2.0, a=0.0)[0] == 1.5


def random_walk(seed: int, n: int, q: float, r: float) -> tuple[np.ndarray, np.ndarray]:
    """A random walk of intensity q and its samples with white noise of intensity r."""
    rng = np.random.default_rng(seed)
    x = np.cumsum(np.sqrt(q / RATE) * rng.standard_normal(n))
    return x, x + np.sqrt(r * RATE) * rng.standard_normal(n)


def test_error_is_that_of_the_riccati_equation_and_below_any_other_corner():
    x, y = random_walk(1, 300_000, q=60.0, r=1.0)

    def error(estimate: np.ndarray) -> float:
        return float(np.mean((estimate - x)[5000:] ** 2))

    best = error(kalman_bucy(y, RATE))
    # S = √(Q R); 300 s hold about 2300 independent errors (correlation time 1/L).
    assert best == pytest.approx(sqrt(60.0), rel=0.12)
    corner = sqrt(60.0) / (2 * pi)
    for factor in (0.3, 0.5, 2.0, 3.0, 10.0):
        assert best < error(passive_lowpass(y, RATE, corner_hz=factor * corner))


def test_with_a_0_the_filter_is_the_passive_one_of_corner_L():
    _, y = random_walk(2, 1000, q=60.0, r=1.0)
    same = passive_lowpass(y, RATE, corner_hz=sqrt(60.0) / (2 * pi))
    np.testing.assert_allclose(kalman_bucy(y, RATE), same, rtol=1e-10)


@pytest.mark.parametrize(
    "numbers", [{"c": 0.0}, {"q": -1.0}, {"r": 0.0}, {"q": 0.0}, {"a": float("nan")}, {"w": float("inf")}]
)
def test_numbers_without_a_filter_are_refused(numbers):
    with pytest.raises(EstimationError, match="Kalman-Bucy"):
        kalman_bucy_gain(**numbers)


def test_passive_filter_refuses_what_it_cannot_use():
    for corner in (0.0, -1.0, float("nan")):
        with pytest.raises(EstimationError, match="corner"):
            passive_lowpass(np.ones(5), RATE, corner_hz=corner)
    with pytest.raises(EstimationError, match="shape"):
        kalman_bucy(np.ones((5, 2)), RATE)
    with pytest.raises(EstimationError, match="finite"):
        kalman_bucy(np.array([1.0, np.nan]), RATE)
    with pytest.raises(EstimationError, match="rate"):
        kalman_bucy(np.ones(5), 0.0)
