"""Rows by their own values, and channels that freeze."""

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.tracking.blocks import Stretch
from ambid.tracking.guard import RowCheck, StreamGuard
from tests.tracking.damage import RATE, blocks, signal

X = signal(8000)
QUANTISED = np.round(np.cumsum(X, axis=0) / 3)  # repeats its values often, as a coarse converter does


def given(values, size=100, **settings):
    """Numbers of the samples that are given; each is checked to be the original."""
    guard = StreamGuard(RATE, 3, **settings)
    out = [passed for block in blocks(values, size) for passed in guard.take(block)] + guard.flush()
    kept = [s for s in out if isinstance(s, Stretch)]
    for s in kept:
        np.testing.assert_array_equal(s.values, values[s.first : s.first + len(s.values)])
    return np.concatenate([np.arange(s.first, s.first + len(s.values)) for s in kept]), guard, out


@pytest.mark.parametrize("size", [3, 20, 450])
@pytest.mark.parametrize("start", [6000, 6001, 6099])
def test_every_frozen_sample_is_refused_wherever_the_blocks_end(size, start):
    frozen = X.copy()
    frozen[start : start + 700, 1] = frozen[start - 1, 1]
    numbers, guard, _ = given(frozen, size)
    np.testing.assert_array_equal(numbers, np.r_[:start, start + 700 : 8000])
    assert guard.samples == {"stuck": 700}


def test_a_frozen_channel_is_seen_through_gaps_and_missing_values():
    frozen = X.copy()
    frozen[6000:7000, 1] = frozen[5999, 1]
    frozen[6300:6330] = np.nan
    guard = StreamGuard(RATE, 3)
    stream = [block for block in blocks(frozen) if block.first not in (6500, 6600)]
    out = [passed for block in stream for passed in guard.take(block)] + guard.flush()
    numbers = np.concatenate([np.arange(s.first, s.first + len(s.values)) for s in out if isinstance(s, Stretch)])
    np.testing.assert_array_equal(numbers, np.r_[:6000, 7000:8000])


def test_a_run_that_a_gap_leaves_undecided_is_refused():
    frozen = X.copy()
    frozen[6090:7000, 1] = frozen[6089, 1]
    stream = [block for block in blocks(frozen) if block.first != 6100]
    guard = StreamGuard(RATE, 3)
    out = [passed for block in stream for passed in guard.take(block)] + guard.flush()
    numbers = np.concatenate([np.arange(s.first, s.first + len(s.values)) for s in out if isinstance(s, Stretch)])
    np.testing.assert_array_equal(numbers, np.r_[:6090, 7000:8000])


@pytest.mark.parametrize("size", [7, 100])
def test_a_coarse_converter_is_not_taken_for_frozen(size):
    numbers, guard, _ = given(QUANTISED, size)
    assert numbers.size == 8000
    assert guard.events == {}


def test_a_coarse_channel_that_freezes_is_noticed():
    frozen = QUANTISED.copy()
    frozen[6000:, 2] = frozen[5999, 2]
    numbers, guard, _ = given(frozen)
    assert numbers.max() < 6000
    assert guard.samples["stuck"] >= 1990


def test_a_commanded_channel_may_rest():
    steps = X.copy()
    steps[:, 0] = np.repeat(X[:80, 0], 100)
    steps[6000:, 0] = 0.0
    assert given(steps)[0].size == 8000  # steps are no noise: not watched
    resting = X.copy()
    resting[5000:7000, 0] = 0.0
    assert given(resting)[0].size == 8000 - 1999
    assert given(resting, watched=(False, True, True))[0].size == 8000
    assert given(resting, watched=(False, False, False))[0].size == 8000


def test_limits_are_each_channel_s_own():
    far = np.abs(X) > [1.0, 2.0, 3.0]
    numbers, _, _ = given(X, limits=[1.0, 2.0, 3.0])
    np.testing.assert_array_equal(numbers, np.flatnonzero(~far.any(axis=1)))


def test_a_row_counts_under_one_kind():
    values = X.copy()
    values[5, 0], values[5, 1] = np.nan, 1e9
    values[6, 1] = 1e9
    _, guard, out = given(values, limits=100.0)
    assert guard.samples == {"nan": 1, "range": 1}
    why = [passed.why for passed in out if not isinstance(passed, Stretch)]
    assert why[0] == "1 sample from 5 on: not finite"


def test_without_limits_only_what_no_bearing_can_show_is_refused():
    values = X.copy()
    values[[3, 4], 0] = 1e14, 1e16
    assert given(values)[1].samples == {"range": 1}


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"n_channels": 0}, "at least one"),
        ({"limits": [1.0, 2.0]}, "limits"),
        ({"limits": -1.0}, "limits"),
        ({"limits": np.nan}, "limits"),
        ({"watched": [True, False]}, "watched"),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings, complaint):
    with pytest.raises(EstimationError, match=complaint):
        RowCheck(**({"n_channels": 3} | settings))
