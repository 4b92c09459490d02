"""The clock follows a crystal's drift and jitter, and one wrong sample stands out."""

import math

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.tracking.order import SampleClock

RATE = 20e3


def learned(drift, jitter, n=3000, size=100, tolerance=0.75):
    """A clock that saw n blocks, and how many of their stamps agreed."""
    rng = np.random.default_rng(1)
    clock = SampleClock(RATE, tolerance / RATE)
    clock.start(0, 5.0)
    agreed = 0
    for k in range(size, n * size, size):
        stamp = 5.0 + k * (1 + drift) / RATE + rng.uniform(-jitter, jitter) / RATE
        agreed += clock.agrees(k, stamp)
        clock.learn(k, stamp)
    return clock, agreed / (n - 1)


@pytest.mark.parametrize("drift", [0.0, 5e-5, -2e-4])
def test_drift_is_found_and_every_stamp_agrees(drift):
    clock, agreed = learned(drift, 0.2)
    assert clock.drift == pytest.approx(drift, abs=2e-6)
    assert agreed == 1.0


def test_after_a_minute_without_data_the_learned_drift_still_numbers_the_samples():
    clock, _ = learned(1e-4, 0.1)
    later = 3000 * 100 + 60 * 20_000
    stamp = 5.0 + later * (1 + 1e-4) / RATE
    assert clock.agrees(later, stamp)
    assert abs(clock.deviation(later, stamp)) < 3.0 / RATE  # a clock taken as exact would be off by 120


@pytest.mark.parametrize("wrong", [-1, 1, 100])
def test_one_wrong_sample_stands_out(wrong):
    clock, _ = learned(1e-4, 0.1)
    at = 3000 * 100
    assert not clock.agrees(at + wrong, 5.0 + at * (1 + 1e-4) / RATE)


def test_an_old_stamp_teaches_nothing():
    clock, _ = learned(0.0, 0.0)
    before = clock.deviation(10**6, 0.0)
    clock.learn(5, 1e9)
    assert clock.deviation(10**6, 0.0) == before


@pytest.mark.parametrize("stamp", [math.nan, math.inf, -math.inf])
def test_a_stamp_that_is_no_number_never_agrees(stamp):
    clock, _ = learned(0.0, 0.0)
    assert not clock.agrees(300_000, stamp)
    assert not clock.agree(0, stamp, 100, 0.005)


@pytest.mark.parametrize(
    ("rate", "tolerance"), [(0.0, 1.0), (math.nan, 1.0), (math.inf, 1.0), (1.0, 0.0), (1.0, math.nan)]
)
def test_settings_that_make_no_clock_are_refused(rate, tolerance):
    with pytest.raises(EstimationError, match="positive"):
        SampleClock(rate, tolerance)
