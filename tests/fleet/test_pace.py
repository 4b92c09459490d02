"""What is said to be left of a fleet, on records of every mix, with a clock of its own."""

import heapq
from itertools import product

import numpy as np
import pytest

from ambid.fleet import pace
from ambid.fleet.pace import Pace, in_order

SIZES = {
    "equal": lambda rng, n: np.ones(n),
    "three": lambda rng, n: rng.choice([0.025, 0.1, 0.4], n),
    "any": lambda rng, n: np.exp(rng.standard_normal(n)),
}
COSTS = {  # of a record by its size, in multiples of the mean
    "the same": np.ones_like,
    "some": lambda x: 0.7 + 0.3 * x,
    "most": lambda x: 0.3 + 0.7 * x,
    "by size": lambda x: x,
    "small ones more": lambda x: np.where(x < 0.5, 1.6, 0.8),
}
COMING = {"random": lambda x: x, "small first": np.sort, "large first": lambda x: np.sort(x)[::-1]}


def told(monkeypatch, n, workers, seed, *, sizes, costs, coming, noise=0.3, load=10.0):
    """What is said to be left after a tenth of the records, over what is, and its relative spread; the first record of
    a process takes as long as ten more.
    """
    rng, clock = np.random.default_rng(seed), [0.0]
    monkeypatch.setattr(pace.time, "monotonic", lambda: clock[0])
    x = COMING[coming](SIZES[sizes](rng, n))
    order = in_order(x.tolist())
    assert sorted(order) == list(range(n))
    cost = COSTS[costs](x / x.mean()) * np.exp(noise * rng.standard_normal(n))
    of, left = Pace(x.tolist(), workers), iter(order)
    running = [(cost[k] + load, k, True) for k in (next(left) for _ in range(workers))]
    heapq.heapify(running)
    for over in range(1, n + 1):
        clock[0], k, first = heapq.heappop(running)
        of.over(x[k])
        of.take(x[k], cost[k] + load * first, first=first)
        if over == n // 10:
            now, (said, sd), (words, share) = clock[0], of.left_s(), of.said()
            assert share == pytest.approx(now / (now + said))
            assert (" to " in words) == (sd > 0.13)
        k = next(left, None)
        if k is not None:
            heapq.heappush(running, (clock[0] + cost[k], k, False))
    assert of.left_s()[0] == pytest.approx(0.0, abs=1e-6)
    return said / (clock[0] - now), sd


def mixes(monkeypatch, n, seeds, workers=(1, 2)):
    found = [
        told(monkeypatch, n, w, seed, sizes=a, costs=b, coming=c)
        for w, a, b, c in product(workers, SIZES, COSTS, COMING) for seed in range(seeds)
    ]  # fmt: skip
    ratio, sd = np.array(found).T
    return np.log(ratio), sd


@pytest.mark.parametrize(("n", "least"), [(200, 0.95), (1000, 0.99)])
def test_what_is_left_is_right_within_thirty_percent_after_a_tenth(monkeypatch, n, least):
    off, _ = mixes(monkeypatch, n, 4 if n == 200 else 1)
    assert np.mean(np.abs(off) < np.log(1.3)) >= least
    assert abs(np.median(off)) < 0.05


def test_four_records_of_forty_tell_a_range_that_holds_what_is_left(monkeypatch):
    """Two or three costs that scatter by a third cannot tell more: their mean alone does so by a fifth."""
    off, sd = mixes(monkeypatch, 40, 10)
    assert np.mean(np.abs(off) < 2.0 * sd) >= 0.9
    assert np.mean(sd > 0.13) > 0.9
    assert abs(np.median(off)) < 0.15


def test_records_of_one_size_stay_in_their_order():
    assert in_order([3.0] * 7) == list(range(7))
    assert in_order([]) == []
    assert sorted(in_order([0.0, 5.0, 0.0])) == [0, 1, 2]
