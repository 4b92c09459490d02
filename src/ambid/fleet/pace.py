"""How long a fleet still takes: an order in which the first records are like all, and what the others cost by size."""

from __future__ import annotations

import math
import time
from bisect import bisect
from collections.abc import Sequence
from itertools import accumulate

import numpy as np

_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)  # steps of it fill a circle evenly, from the first ones on
_STEPS = 4  # of them for each record; what they pass over comes last, and is small
_KEPT = 0.98  # of what was learnt, with each record: what comes next is like the last fifty
_BY_SIZE, _BELIEF = 0.25, 0.25  # share of what a record costs that goes by its size, and the belief's worth in records
_SCATTER, _WORTH = 0.4, 2.0  # relative scatter of costs before any is known, and its worth in records
_WIDE = 0.13  # relative standard deviation from which a range is told: 30 % are beyond two of it
_LEAST = 0.2  # of what records took, which others take at least


def in_order(sizes: Sequence[float]) -> list[int]:
    """Return the places of records in an order of which any beginning is like the whole: by equal steps around a circle
    of which each record has a part, some of it by its size; those of one size as they came.
    """
    places: dict[float, list[int]] = {}
    for k in reversed(range(len(sizes))):
        places.setdefault(sizes[k], []).append(k)
    ranked, mean, last = sorted(sizes), max(sum(sizes) / max(len(sizes), 1), 1e-300), len(sizes) - 1
    ends = list(accumulate(1.0 - _BY_SIZE + _BY_SIZE * size / mean for size in ranked))
    steps = (bisect(ends, (0.25 + k * _GOLDEN) % 1.0 * ends[-1]) for k in range(_STEPS * len(sizes)))
    return [places[ranked[k]].pop() for k in dict.fromkeys([*(min(k, last) for k in steps), *range(len(sizes))])]


class Pace:
    """What is over of a fleet, and what is left.

    `sizes`: of the records, in any unit; `workers`: at work at a time. Costs are a + b size, and of the first record of
    a process, which loads what all need, something more.
    """

    def __init__(self, sizes: Sequence[float], workers: int) -> None:
        self._left, self._size_left, self._workers = len(sizes), float(sum(sizes)), workers
        self._mean = max(self._size_left / max(len(sizes), 1), 1e-300)
        self._begin = time.monotonic()
        self._since = self._begin  # when a process was last through with its first
        self._busy_s = 0.0  # of all workers since then
        self._products = np.zeros((4, 4))  # of 1, size, whether it is a first one and seconds, summed
        self._records, self._seconds = [0.0, 0.0], [0.0, 0.0]  # of later ones, and first ones

    def over(self, size: float) -> None:
        """Take a record off that nobody has to do any more."""
        self._left -= 1
        self._size_left -= size

    def take(self, size: float, seconds: float, *, first: bool) -> None:
        """Learn from a record that is over."""
        x = size / self._mean
        row = np.array([1.0, x, first, seconds]) / (1.0 - _BY_SIZE + _BY_SIZE * x)  # costs scatter by their size
        self._products = _KEPT * self._products + np.outer(row, row)
        for of, more in ((self._records, 1.0), (self._seconds, seconds)):
            of[first] = _KEPT * of[first] + more
        if first:
            self._since, self._busy_s = time.monotonic(), 0.0
        else:
            self._busy_s += seconds

    @property
    def mean_s(self) -> float:
        """What a record takes; infinite as long as nothing is known."""
        which = 0 if self._records[0] else 1
        return self._seconds[which] / self._records[which] if self._records[which] else math.inf

    def left_s(self, runs: int = 1) -> tuple[float, float] | None:
        """Return how long the rest takes where so many runs share it, and its relative standard deviation, infinite
        after first ones alone, which take longer; None as long as nothing is known.
        """
        mean_s, n = max(self.mean_s, 1e-9), self._records[0]
        if math.isinf(mean_s):
            return None
        known, right = self._products[:3, :3], self._products[:3, 3]
        believed = 2.0 * np.array([_BY_SIZE, _BY_SIZE - 1.0, 0.0])  # across the costs that are believed
        belief = _BELIEF * np.outer(believed, believed) + np.diag([0.0, 0.0, 1e-6])
        cost = np.linalg.solve(known + belief, right)
        work = cost[0] * self._left + cost[1] * self._size_left / self._mean
        at_once = (self._busy_s + self._workers * mean_s) / (time.monotonic() - self._since + mean_s)
        left = max(work, _LEAST * mean_s * self._left) / (max(at_once, 1e-9) * runs)
        if not n:
            return left, math.inf
        misfit = max(self._products[3, 3] - (2.0 * right - known @ cost) @ cost, 0.0) / mean_s**2
        scatter = (_WORTH * _SCATTER**2 + misfit) / (_WORTH + max(n - 1.0, 0.0))
        return left, math.sqrt(scatter * (1.0 / n + 1.0 / max(self._left, 1)))

    def said(self, runs: int = 1) -> tuple[str, float | None]:
        """Return between which times the rest takes, in words, where that is wide; and the share of the time that is
        over.
        """
        known, passed = self.left_s(runs), time.monotonic() - self._begin
        if known is None:
            return "", None
        left, sd = known
        share = passed / max(passed + left, 1e-9)
        scale, unit = (60.0, "min") if left >= 100.0 else (1.0, "s")
        if math.isinf(sd):
            return f", at most {left / scale:.0f} {unit} left", share
        low, high = (left / scale * math.exp(k * min(sd, 1.0)) for k in (-2.0, 2.0))
        wide = sd > _WIDE and round(low) < round(high)
        return f", {low:.0f} to {high:.0f} {unit} left" if wide else "", share
