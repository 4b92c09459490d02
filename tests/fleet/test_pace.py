"""What is said to be left of a fleet, with records simulated on a clock of its own."""

import heapq
import math

import numpy as np
import pytest

from ambid.fleet import pace
from ambid.fleet.pace import Pace

LOAD = 1.0  # s that a process needs before its first record


def ratio(monkeypatch, n, by_size, noise, seed):
    """What is said to be left after a tenth of the records, over what is; `by_size`: share of the cost."""
    rng, clock = np.random.default_rng(seed), [0.0]
    monkeypatch.setattr(pace.time, "monotonic", lambda: clock[0])
    sizes = rng.choice([0.025, 0.1, 0.4], n)
    costs = 0.1 * (1.0 - by_size + by_size * sizes / sizes.mean()) * np.exp(noise * rng.standard_normal(n))
    of, running, said = Pace(sizes.tolist(), 2), [(LOAD + costs[k], k, True) for k in (0, 1)], None
    coming = iter(range(2, n))
    heapq.heapify(running)
    for done in range(1, n + 1):
        clock[0], k, first = heapq.heappop(running)
        of.over(float(sizes[k]))
        of.take(float(sizes[k]), float(costs[k] + LOAD * first), first=first)
        if done == n // 10:
            said = clock[0], of.left_s()
        if (after := next(coming, None)) is not None:
            heapq.heappush(running, (clock[0] + costs[after], after, False))
    return said[1] / (clock[0] - said[0])


@pytest.mark.parametrize("by_size", [0.0, 0.3, 0.7, 1.0])
def test_what_is_left_is_told_within_thirty_percent_after_a_tenth(monkeypatch, by_size):
    found = np.array([ratio(monkeypatch, 100, by_size, 0.1, seed) for seed in range(40)])
    assert np.mean(np.abs(np.log(found)) < math.log(1.3)) > 0.8
    assert np.median(found) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("by_size", [0.0, 0.5, 1.0])
def test_four_records_lean_to_neither_side(monkeypatch, by_size):
    found = [ratio(monkeypatch, 40, by_size, 0.3, seed) for seed in range(60)]
    assert 0.75 < np.median(found) < 1.25
