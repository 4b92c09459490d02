"""Quantiles from bins: never below the true one, at most one bin above."""

import numpy as np
import pytest

from ambid.tracking.engine import LatencyStatistics


def filled(latencies):
    statistics = LatencyStatistics()
    for latency in latencies:
        statistics.add(latency)
    return statistics


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.5, 0.99, 0.999, 1.0])
def test_quantiles_lie_within_one_bin_above_the_true_ones(fraction):
    latencies = np.random.default_rng(0).lognormal(-8, 1.5, 5000)
    true = np.quantile(latencies, fraction, method="inverted_cdf")
    assert true <= filled(latencies).quantile(fraction) * (1 + 1e-12) <= true * 10**0.01 * (1 + 1e-9)


def test_the_summary_holds_median_p99_and_the_exact_largest():
    statistics = filled([1e-3] * 98 + [0.02, 0.5])
    statistics.late = 4
    summary = statistics.summary()
    assert summary.median == pytest.approx(1e-3, rel=0.024)
    assert summary.p99 == pytest.approx(0.02, rel=0.024)
    assert (summary.largest, summary.overruns, summary.late) == (0.5, 0, 4)


def test_the_start_is_apart_until_the_work_has_caught_up_once():
    statistics = filled([0.3, 0.2])
    statistics.late = 1
    assert (statistics.summary().start, statistics.summary().largest, statistics.summary().late) == (None, 0.3, 1)
    statistics.caught_up()
    statistics.add(0.01)
    statistics.caught_up()
    statistics.add(0.02)
    summary = statistics.summary()
    assert (summary.start, summary.largest, summary.late, statistics.count) == (0.3, 0.02, 0, 2)


@pytest.mark.parametrize("latency", [0.0, -1e-9, 1e-12, 1e-7])
def test_what_the_clock_cannot_resolve_counts_as_zero(latency):
    assert filled([latency]).quantile(1.0) == 0.0


def test_beyond_the_last_bin_the_largest_is_exact():
    assert filled([3e5]).quantile(0.5) == 3e5


def test_without_blocks_there_is_nothing_to_report():
    assert LatencyStatistics().summary() is None
    assert np.isnan(LatencyStatistics().quantile(0.5))
