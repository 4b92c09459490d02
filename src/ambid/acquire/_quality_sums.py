"""What is kept of a stream to judge it: sums over all columns at once, of constant size however long it runs."""

from __future__ import annotations

import numpy as np

from ambid.acquire.device import Column
from ambid.arrays import Array

_DIFFERENCES = np.array([1.0, -3.0, 3.0, -1.0])
_GAIN = float(np.sum(_DIFFERENCES**2))  # of white noise through a third difference: 20


class Moments:
    """Mean, spread, extremes, saturation and standstill of each column."""

    def __init__(self, columns: tuple[Column, ...]) -> None:
        width = len(columns)
        spans = [c.span if c.span is not None else (-np.inf, np.inf) for c in columns]
        self._low, self._high = np.array(spans, dtype=np.float64).reshape(width, 2).T
        self.count = 0
        self.mean, self._squares = np.zeros(width), np.zeros(width)
        self.least, self.most = np.full(width, np.inf), np.full(width, -np.inf)
        self.saturated = np.zeros(width, dtype=np.int64)
        self.longest = np.zeros(width, dtype=np.int64)
        self._held = np.zeros(width, dtype=np.int64)  # samples for which the last value has stood
        self._last = np.full(width, np.nan)

    @property
    def variance(self) -> Array:
        """About the mean, shape (n_columns,)."""
        return np.asarray(self._squares / max(self.count, 1))

    def add(self, x: Array) -> None:
        """Take consecutive samples, shape (n_samples, n_columns)."""
        n, mean = len(x), x.mean(axis=0)
        total, step = self.count + n, mean - self.mean
        self._squares += np.square(x - mean).sum(axis=0) + step**2 * (self.count * n / total)
        self.mean += step * (n / total)
        self.count = total
        np.minimum(self.least, x.min(axis=0), out=self.least)
        np.maximum(self.most, x.max(axis=0), out=self.most)
        self.saturated += ((x <= self._low) | (x >= self._high)).sum(axis=0)
        self._stand(x)

    def _stand(self, x: Array) -> None:
        """Follow how long each value has stood, over the ends of blocks."""
        n = len(x)
        moved = np.vstack((x[:1] != self._last, x[1:] != x[:-1]))
        number = np.arange(n)[:, None]
        since = np.maximum.accumulate(np.where(moved, number, -1), axis=0)
        runs = np.where(since >= 0, number - since + 1, number + 1 + self._held)
        np.maximum(self.longest, runs.max(axis=0), out=self.longest)
        self._held, self._last = runs[-1], x[-1].copy()


class Differences:
    """Noise by third differences: white noise is in them twentyfold, what moves slowly hardly at all."""

    def __init__(self, width: int) -> None:
        self._tail = np.empty((0, width))
        self._sum, self.count = np.zeros(width), 0

    @property
    def variance(self) -> Array:
        """Of the noise, at most, shape (n_columns,)."""
        return np.asarray(self._sum / (_GAIN * max(self.count, 1)))

    def add(self, x: Array, *, joined: bool) -> None:
        """Take consecutive samples, shape (n_samples, n_columns); `joined` to the last ones or after a gap."""
        series = np.vstack((self._tail, x)) if joined else x
        if len(series) > 3:
            third = series[:-3] - 3.0 * series[1:-2] + 3.0 * series[2:-1] - series[3:]
            self._sum += np.square(third).sum(axis=0)
            self.count += len(third)
        self._tail = series[-3:].copy()


class Periods:
    """Signal and noise by averaging over the periods of an excitation: what repeats is signal, the rest noise."""

    def __init__(self, width: int, period: int) -> None:
        self.period = period
        self._visits = np.zeros(period, dtype=np.int64)
        self._sum, self._squares = np.zeros((period, width)), np.zeros(width)
        self._origin: Array | None = None

    def add(self, x: Array, first: int) -> None:
        """Take samples from number `first` on, shape (n_samples, n_columns)."""
        if self._origin is None:
            self._origin = x[0].copy()  # so that squares of what hardly moves stay exact
        moved = x - self._origin
        phase = (first + np.arange(len(x))) % self.period
        if len(x) <= self.period:
            self._sum[phase] += moved
            self._visits[phase] += 1
        else:
            np.add.at(self._sum, phase, moved)
            np.add.at(self._visits, phase, 1)
        self._squares += np.square(moved).sum(axis=0)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the noise."""
        return int(self._visits.sum() - np.count_nonzero(self._visits))

    def variances(self) -> tuple[Array, Array]:
        """Return those of signal and noise, each shape (n_columns,); `freedom` has to be positive."""
        seen = self._visits > 0
        visits, sums = self._visits[seen, None], self._sum[seen]
        total = int(visits.sum())
        between = (sums**2 / visits).sum(axis=0)
        noise = np.maximum(self._squares - between, 0.0) / self.freedom
        means = between / total - (sums.sum(axis=0) / total) ** 2
        # the mean of a phase carries noise/visits of its own
        signal = np.maximum(means - noise * (len(visits) - 1) / total, 0.0)
        return np.asarray(signal), np.asarray(noise)


class Rate:
    """Samples in a second of the host's clock: slope of a straight line through the times of arrival."""

    def __init__(self) -> None:
        self._n = 0
        self._t = self._k = self._tt = self._tk = self._kk = 0.0

    def add(self, arrived_s: float, number: int) -> None:
        """Take the time of arrival of the sample before `number`."""
        self._n += 1
        t, k = arrived_s - self._t, number - self._k
        self._t += t / self._n
        self._k += k / self._n
        self._tt += t * (arrived_s - self._t)
        self._tk += t * (number - self._k)
        self._kk += k * (number - self._k)

    def slope(self) -> tuple[float, float]:
        """Return the rate and its standard deviation, Hz; NaN where it is not known."""
        if self._n < 3 or self._tt <= 0.0:
            return float("nan"), float("nan")
        rate = self._tk / self._tt
        rest = max(self._kk - rate * self._tk, 0.0) / (self._n - 2)
        return rate, float(np.sqrt(rest / self._tt))
