"""How long a fleet still takes: each record costs a part that all have, and one by its size."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

_FEW = 4  # records that tell of no slope
_KEPT = 0.98  # of what was learnt, with each record: what comes next is like the last fifty


class Pace:
    """What is over of a fleet, and what is left.

    `sizes`: of the records, in any unit; `workers`: at work at a time. What a process does first is left aside, as far
    as others have come: it loads what all need.
    """

    def __init__(self, sizes: Sequence[float], workers: int) -> None:
        self._left, self._size_left, self._workers = len(sizes), float(sum(sizes)), workers
        self._begin = time.monotonic()
        self._since = self._begin  # when a process was last through with its first
        self._busy_s = 0.0  # of all workers since then
        self._sums = [0.0] * 6  # number, sizes, their squares, seconds, products, squares of seconds
        self._first = [0.0] * 6

    def over(self, size: float) -> None:
        """Take a record off that nobody has to do any more."""
        self._left -= 1
        self._size_left -= size

    def take(self, size: float, seconds: float, *, first: bool) -> None:
        """Learn from a record that is over."""
        sums = self._first if first else self._sums
        for k, x in enumerate((1.0, size, size * size, seconds, size * seconds, seconds * seconds)):
            sums[k] = _KEPT * sums[k] + x
        if first:
            self._since, self._busy_s = time.monotonic(), 0.0
        else:
            self._busy_s += seconds

    @property
    def mean_s(self) -> float:
        """What a record takes; infinite as long as nothing is known."""
        n, seconds = (self._sums if self._sums[0] else self._first)[0:4:3]
        return seconds / n if n else math.inf

    def left_s(self, runs: int = 1) -> float | None:
        """Return how long the rest takes where so many runs share it; None as long as nothing is known."""
        sums = self._sums if self._sums[0] else self._first
        if not sums[0]:
            return None
        fixed, by_size = _line(*sums)
        mean_s = max(self.mean_s, 1e-9)
        passed = time.monotonic() - self._since
        at_once = (self._busy_s + self._workers * mean_s) / (passed + mean_s)  # at first as many as there are workers
        return (fixed * self._left + by_size * max(self._size_left, 0.0)) / (max(at_once, 1e-9) * runs)

    def share(self, runs: int = 1) -> float | None:
        """Return the share of the time that is over."""
        left = self.left_s(runs)
        passed = time.monotonic() - self._begin
        return None if left is None else passed / max(passed + left, 1e-9)


def _line(n: float, size: float, squares: float, seconds: float, products: float, powers: float) -> tuple[float, float]:
    """Return what is the same for all records, and what one costs by its size; neither is negative.

    A slope counts as far as it stands out of its scatter: it is carried to sizes that have not come yet.
    """
    spread, common = squares - size * size / n, products - size * seconds / n
    if n < _FEW or spread <= 1e-9 * squares:
        return seconds / n, 0.0
    slope = common / spread
    scatter = max(powers - seconds * seconds / n - slope * common, 0.0) / (n - 2.0) / spread  # of the slope, squared
    slope *= max(0.0, 1.0 - 4.0 * scatter / max(slope * slope, 1e-300))
    if slope <= 0.0:
        return seconds / n, 0.0
    fixed = (seconds - slope * size) / n
    return (fixed, slope) if fixed >= 0.0 else (0.0, seconds / size)
