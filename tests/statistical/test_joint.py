"""Joint filters on an unstable bearing in its loop: intervals hold the truth as often as they say."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.recursive.joint import JointEkf, JointUkf
from tests.bearing.benches import run
from tests.recursive.joint_starts import start_of, truth_of
from tests.tiers import runs

RUNS = runs(80, short=24)


@pytest.fixture(scope="module")
def benches():
    return [run("bearing", 5000, 400 + seed) for seed in range(RUNS)]


@pytest.mark.parametrize("kind", [JointEkf, JointUkf])
def test_intervals_hold_the_truth_as_often_as_they_say(benches, kind):
    errors, squares, sds = [], [], []
    for seed, bench in enumerate(benches):
        filter_ = kind(start_of(bench, 0.04, seed=seed))
        filter_.update(bench.signals.u, bench.signals.y)
        error = filter_.estimate - truth_of(bench, filter_.names)
        squares.append(error[:5] @ np.linalg.solve(filter_.covariance[:5, :5], error[:5]))
        sds.append(np.sqrt(np.diag(filter_.covariance)))
        errors.append(error)
    e, s = np.array(errors)[:, :5], np.array(sds)[:, :5]
    # the record has told something of each number: the start alone would pass, too
    assert np.all(s.mean(axis=0) < [0.25 * 0.04 * abs(v) for v in truth_of(benches[0], filter_.names)[:5]])
    inside = np.mean(np.abs(e) < 1.96 * s, axis=0)
    assert np.all(inside > RUNS.limit(0.87))  # 80 runs: one number's share scatters by 0.024
    assert RUNS.limit(0.90) < inside.mean() < RUNS.limit(0.98)
    # normalised squared errors: their mean is 5, with a standard deviation of sqrt(10 / 80)
    assert abs(np.mean(squares) - 5.0) < 3.0 * np.sqrt(10.0 / RUNS)
    assert np.all(np.abs(e.mean(axis=0)) < RUNS.limit(0.4, centre=0) * e.std(axis=0))
