import dataclasses
import math

import numpy as np
import pytest

from ambid.tracking.monitors import ErrorLevel
from tests.tracking.evidences import evidence, triangle

J = triangle(5, 1)


def fed(level, noise, n, seed=0, truth=None):
    rng = np.random.default_rng(seed)
    truth = np.zeros(5) if truth is None else truth
    return [level.update(evidence(J, truth, k, rng, noise=noise), np.zeros(5)) for k in range(n)]


def test_the_level_is_one_as_at_identification_and_counts_parameter_error():
    level = ErrorLevel(1.5, 1.2, 100)
    assert math.isnan(level.error)
    assert fed(level, 1.0, 300)[-1] == pytest.approx(1.0, abs=0.02)
    off = np.linalg.solve(J, np.full(5, math.sqrt(200 * 3 / 5)))  # adds three times the noise's power
    assert fed(level, 1.0, 100, truth=off)[-1] == pytest.approx(2.0, abs=0.03)


def test_hysteresis_and_the_smallest_number_of_blocks():
    level = ErrorLevel(1.5, 1.2, 10)
    fed(level, 3.0, 9)
    assert not level.above
    fed(level, 3.0, 1)
    assert level.above
    fed(level, 1.35, 50)  # between release and limit
    assert level.above
    fed(level, 1.0, 10)
    assert not level.above
    fed(level, 1.35, 50)
    assert not level.above
    fed(level, 3.0, 10)
    level.restart()
    assert not level.above
    assert math.isnan(level.error)


def test_rounding_does_not_gather_and_memory_is_bounded():
    level = ErrorLevel(1.5, 1.2, 7)
    rng = np.random.default_rng(1)
    e = evidence(J, np.zeros(5), 0, rng)
    level.update(dataclasses.replace(e, rest=1e18), np.zeros(5))
    for _ in range(20):
        level.update(e, np.zeros(5))
    assert level.error == pytest.approx(math.sqrt(e.loss(np.zeros(5)) / 200), rel=1e-12)
    assert len(level._squares) == 7


def test_a_block_that_is_not_finite_changes_nothing():
    level = ErrorLevel(1.5, 1.2, 5)
    before = fed(level, 1.0, 10)[-1]
    bad = dataclasses.replace(evidence(J, np.zeros(5), 0, np.random.default_rng(0)), rest=math.nan)
    assert level.update(bad, np.zeros(5)) == before
    assert level.n_blocks == 10
