"""Two-sided cumulative sum of one standardised number (Page 1954), with the run lengths that its threshold buys.

g+ = max(0, g+ + x - drift), g- = max(0, g- - x - drift); a change is called when one passes the threshold.
"""

from __future__ import annotations

import math

from ambid.errors import EstimationError

_OVERSHOOT = 1.166  # twice the mean excess of a normal random walk over a barrier (Siegmund 1985, ch. 10)


class Cusum:
    """Find a shift of the mean of a sequence that is standard normal in quiet times.

    `drift`: half the smallest shift worth finding, in standard deviations; `threshold`: see `threshold_for`; `mean`,
    `sd`: of the sequence in quiet times.

    `high`: the two sums; `low`: the two sums; `n`: numbers taken in since the last reset.
    """

    __slots__ = ("_drift", "_mean", "_rise", "_scale", "_sink", "_threshold", "high", "low", "n")

    def __init__(self, *, drift: float = 0.5, threshold: float = 8.0, mean: float = 0.0, sd: float = 1.0) -> None:
        if not (drift >= 0 and threshold > 0 and sd > 0):
            raise EstimationError("a cumulative sum wants drift >= 0, threshold > 0 and sd > 0. Mend them")
        self._drift, self._threshold, self._mean, self._scale = drift, threshold, mean, 1.0 / sd
        self.reset()

    def reset(self) -> None:
        """Begin anew, as after a change that was handled."""
        self.high = self.low = 0.0
        self.n = self._rise = self._sink = 0

    def update(self, value: float) -> int:
        """Take in one number.

        `value`: one that is not finite is not used. Returns 1 if the mean rose, -1 if it fell, else 0; it stays so
        until `reset`, or until the sum comes down again.
        """
        if not math.isfinite(value):
            return 0
        x = (value - self._mean) * self._scale
        self.high += x - self._drift
        self.low -= x + self._drift
        self.n += 1
        if self.high <= 0.0:
            self.high, self._rise = 0.0, self.n
        if self.low <= 0.0:
            self.low, self._sink = 0.0, self.n
        if max(self.high, self.low) <= self._threshold:
            return 0
        return 1 if self.high >= self.low else -1

    @property
    def onset(self) -> int:
        """How many numbers came before the change: the maximum-likelihood estimate for the larger of the two sums."""
        return self._rise if self.high >= self.low else self._sink


def run_length(threshold: float, drift: float, shift: float = 0.0, *, two_sided: bool = True) -> float:
    """Return the mean number of samples to an alarm (Siegmund 1985, eq. 2.56).

    `threshold`, `drift`: of the `Cusum`; `shift`: mean of the sequence, standard deviations; `two_sided`: both sums, or
    the upper one alone. Returns infinite if too long for a float. Good to some per cent for thresholds over 3.
    """
    up = _one_sided(threshold, shift - drift)
    return 1.0 / (1.0 / up + 1.0 / _one_sided(threshold, -shift - drift)) if two_sided else up


def threshold_for(length: float, drift: float) -> float:
    """Return the threshold at which a quiet sequence gives a false alarm every `length` samples in the mean.

    `length`: samples; larger than 2.
    """
    if not length > 2:
        raise EstimationError(f"a run length of {length:g} samples is no quiet time. Give more than 2")
    low, high = 0.0, 1.0
    while run_length(high, drift) < length:
        high *= 2
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if run_length(middle, drift) < length else (low, middle)
    return high


def _one_sided(threshold: float, slope: float) -> float:
    """Return the mean run length of one sum whose terms have mean `slope` and unit variance."""
    b = threshold + _OVERSHOOT
    x = 2.0 * slope * b
    if abs(x) < 1e-4:
        return b * b * (1.0 - x / 3.0)
    if x < -700.0:
        return math.inf
    return (math.expm1(-x) + x) / (2.0 * slope * slope)
