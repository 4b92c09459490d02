"""Intervals with calibration hold the truth where scales are as wrong as the rig says; those of the record do not."""

import numpy as np
import pytest

import ambid
from ambid.physics.presets import preset
from tests.estimation.test_calibration import rig_of, wrong
from tests.tiers import runs

SD = {"voltage": 0.01, "current": 0.01, "position": 0.01, "rate": 0.01}
RUNS = runs(200, short=8)
NAMES = ("m", "k_x", "k_i", "R", "L")


def errors_of(estimate, bench):
    """Errors in standard deviations of the record and with calibration."""
    truth = preset(bench).parameters
    return np.array(
        [
            [(p.value - truth[p.name]) / p.sd, (p.value - truth[p.name]) / p.sd_calibrated]
            for p in (estimate[name] for name in NAMES)
        ]
    )


@pytest.mark.parametrize("channel", SD)
def test_a_scale_that_is_one_per_cent_wrong_is_within_the_interval(channel):
    record = ambid.simulate("thesis", duration=0.5, seed=7)
    alone, whole = errors_of(ambid.identify(wrong(record, channel, 1.01), rig_of({channel: 0.01})), "thesis").T
    assert max(abs(alone)) > 7.0
    assert max(abs(whole)) < 3.0


def test_95_of_100_intervals_with_calibration_hold_the_truth():
    found = []
    for seed in range(RUNS):
        rng = np.random.default_rng(900 + seed)
        record = ambid.simulate("unstable-bearing", duration=0.25, seed=seed)
        for channel, sd in SD.items():
            record = wrong(record, channel, 1.0 + sd * rng.standard_normal())
        found.append(errors_of(ambid.identify(record, rig_of(SD)), "unstable-bearing"))
    alone, whole = np.moveaxis(np.array(found), 2, 0)
    inside = np.mean(abs(whole) < 1.96)
    assert RUNS.limit(0.90) <= inside <= RUNS.limit(0.99)
    assert np.mean(abs(alone) < 1.96) < 0.8
