"""Latencies of a stream in constant memory: counts in bins that widen with the latency.

A quantile is the upper edge of its bin, so it is never too low and at most 2.4 % too high (100 bins per decade).
"""

from __future__ import annotations

from math import ceil, log10

from ambid.errors import EstimationError
from ambid.recursive.lines import Latency

_LOWEST = 1e-7  # s: upper edge of the first bin
_PER_DECADE = 100
_DECADES = 11  # up to 10 000 s; what is beyond is in the last bin


class LatencyStatistics:
    """Counts latencies, overruns and late blocks.

    `count`: blocks; `largest`: s; `overruns`: blocks that were lost because the ring was full; `late`: blocks whose
    work ended after the next one had come.
    """

    def __init__(self) -> None:
        self._bins = [0] * (_PER_DECADE * _DECADES + 1)
        self.count = self.overruns = self.late = 0
        self.largest = 0.0

    def add(self, latency_s: float) -> None:
        """Count a block."""
        if latency_s <= _LOWEST:
            at = 0
        elif latency_s < float("inf"):
            at = min(ceil(_PER_DECADE * log10(latency_s / _LOWEST)), len(self._bins) - 1)
            self.largest = max(self.largest, latency_s)
        else:
            raise EstimationError(
                f"a latency of {latency_s} s cannot be counted; it must be a number. Correct the clock"
            )
        self._bins[at] += 1
        self.count += 1

    def quantile(self, fraction: float) -> float:
        """Return the latency that this fraction of the blocks does not exceed.

        `fraction`: 0 to 1. Returns s; upper edge of its bin, or the largest latency if that is less; NaN without any
        block.
        """
        if not 0 <= fraction <= 1:
            raise EstimationError(f"the fraction of a quantile is {fraction}; it must lie within 0 and 1. Correct it")
        if not self.count:
            return float("nan")
        wanted, seen = max(fraction * self.count, 1.0), 0
        for at, n in enumerate(self._bins):
            seen += n
            if seen >= wanted and at < len(self._bins) - 1:
                return min(_LOWEST * float(10.0 ** (at / _PER_DECADE)), self.largest)
        return self.largest

    def summary(self) -> Latency | None:
        """Return what a track reports of them; None without any block."""
        if not self.count:
            return None
        return Latency(
            median=self.quantile(0.5),
            p99=self.quantile(0.99),
            largest=self.largest,
            overruns=self.overruns,
            late=self.late,
        )
