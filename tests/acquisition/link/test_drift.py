"""The drift of a clock from arrivals that are late by chance and never early."""

import numpy as np
import pytest

from ambid.acquisition.devices.line_device import ClockDrift


def learned(drift, *, seconds=60.0, rate=2000.0, step=20, seed=0, mean=2e-3, stall=None, grows=None):
    """Arrivals of every `step`-th sample with exponential latencies; `grows`: 2 ms more after so many seconds."""
    rng, clock = np.random.default_rng(seed), ClockDrift(rate)
    n = np.arange(0, round(seconds * rate), step)
    arrived = 1234.5 + n / rate / (1.0 + drift) + rng.exponential(mean, n.size)
    if grows is not None:
        arrived += 2e-3 * np.minimum(n / rate / grows, 1.0)
    if stall is not None:
        held = (n / rate >= stall[0]) & (n / rate < stall[1])
        arrived[held] = np.maximum(arrived[held], arrived[held].max())  # all come together once the host goes on
    for number, at in zip(n.tolist(), arrived.tolist(), strict=True):
        clock.learn(number, at)
    return clock.estimate()


@pytest.mark.parametrize("drift", [50e-6, -50e-6, 0.0, 2e-3])
def test_a_drift_is_found_within_its_spread_after_a_minute(drift):
    far = []
    for seed in range(20):
        found = learned(drift, seed=seed)
        assert found.drift_sd < 5e-6
        far.append((found.drift - drift) / found.drift_sd)
    assert max(map(abs, far)) < 4.0
    assert sum(abs(x) > 3.0 for x in far) <= 1
    assert 0.4 < np.std(far) < 1.8


def test_a_stall_of_the_host_does_not_pull_it():
    found = learned(50e-6, stall=(20.0, 24.0))
    assert abs(found.drift - 50e-6) < max(3.0 * found.drift_sd, 1e-6)
    assert found.drift_sd < 5e-6


def test_the_offset_is_when_sample_0_was_there():
    assert learned(50e-6).offset_s == pytest.approx(1234.5, abs=2e-4)


def test_little_is_known_after_a_moment_and_it_says_so():
    assert np.isnan(learned(50e-6, seconds=9.7).drift)
    assert np.isnan(learned(50e-6, seconds=9.7).drift_sd)
    assert learned(50e-6, seconds=10.3).drift_sd > learned(50e-6, seconds=30.0).drift_sd


@pytest.mark.parametrize("grows", [2.0, 5.0])
def test_a_latency_that_grows_in_the_first_seconds_is_never_told_as_a_drift(grows):
    """After five seconds the line through 2 ms in 5 s looked like 400 ppm, with a hundredth of that as deviation."""
    for seconds in (3.0, 5.0, 8.0, 10.5, 15.0, 30.0):
        found = learned(50e-6, seconds=seconds, grows=grows, mean=5e-4)
        assert np.isnan(found.drift) or abs(found.drift - 50e-6) < 4.0 * found.drift_sd, seconds


def test_hours_take_the_memory_of_a_minute():
    clock = ClockDrift(2000.0)
    rng = np.random.default_rng(1)
    for n in range(0, 3600 * 2000, 400):
        clock.learn(n, n / 2000.0 * (1.0 - 20e-6) + rng.exponential(2e-3))
    assert len(clock._lowest) <= 513
    found = clock.estimate()
    assert abs(found.drift - 20e-6) < 4.0 * found.drift_sd + 1e-9
