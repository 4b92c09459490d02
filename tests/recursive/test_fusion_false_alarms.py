"""Less than one false alarm an hour: counted where they are common, under a bound that holds at every threshold.

A log-likelihood sum passes h at most once in e^h quiet samples in the mean (Lorden 1971); 4 sums for each sensor. At
0.1 alarms an hour h is near 23. Two million samples show the bound at thresholds where alarms can be counted.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.recursive.fusion_benches import GAIN, NOISE, RATE, fusion, vibration

N = 200_000
DRIFT = 2e-3


@pytest.mark.parametrize(("n", "h"), [(3, 10.0), (3, 12.0), (2, 12.0)])
def test_alarms_stay_under_the_bound_that_the_threshold_promises(n, h):
    samples = 3 * N
    per_hour = 4 * n * np.exp(-h) * RATE * 3600
    fused = fusion(n, settings={"drift_rate": DRIFT}, false_alarms_per_hour=per_hour, restore_s=1e-3)
    rng = np.random.default_rng(int(h) + n)
    walk, alarms, told = np.zeros(n), 0, 0
    for _ in range(3):
        walks = walk + np.cumsum(rng.standard_normal((N, n)) * DRIFT / np.sqrt(RATE), axis=0)
        walk = walks[-1]
        fused.update(GAIN * vibration(N)[:, None] + walks + NOISE * rng.standard_normal((N, n)))
        new, told = fused.n_events - told, fused.n_events
        alarms += sum(e.kind != "restored" for e in fused.events[-new:]) if new else 0
        assert new < 1000  # all of them are kept
    assert alarms < 4 * n * np.exp(-h) * samples
    assert fused.levels == pytest.approx(np.ones(n), abs=0.03)


def test_at_the_threshold_of_daily_use_half_a_minute_is_quiet():
    fused = fusion(settings={"drift_rate": DRIFT})
    rng = np.random.default_rng(9)
    for _ in range(3):
        fused.update(GAIN * vibration(N)[:, None] + NOISE * rng.standard_normal((N, 3)))
    assert fused.n_samples == 3 * N
    assert fused.events == ()
    assert fused.working == ("a", "b", "c")
