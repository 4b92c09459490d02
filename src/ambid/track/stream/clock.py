"""Clock of an acquisition against its sample numbers: offset and drift, and what their spread allows.

A stamp of sample n is t_0 + (n - n_0) T (1 + d) + jitter: T = 1 / rate as it is stated, d the drift of the crystal.
A Kalman filter of the two states (t_0, d), moved from block to block, predicts the next stamp with its spread.
"""

from __future__ import annotations

from math import sqrt

from ambid.errors import EstimationError

DRIFT_SD = 1e-4  # of a crystal against its stated rate, before anything is known
_DRIFT_WALK = 1e-6  # wander of the drift in one second
_SIGMAS = 4.0


class SampleClock:
    """Predicts the time stamp of a sample number, and learns from stamps that agree.

    `rate_hz`: as stated.

    `drift`: estimated relative deviation of the stamps' period from the stated one.
    """

    def __init__(self, rate_hz: float, tolerance_s: float) -> None:
        if not 0 < rate_hz < float("inf"):
            raise EstimationError(f"the clock's rate is {rate_hz}; it must be a positive number of Hz. Correct rate_hz")
        if not tolerance_s > 0:
            raise EstimationError(
                f"the clock's tolerance is {tolerance_s} s; it must be positive. Give math.inf without stamps"
            )
        self._period = 1.0 / rate_hz
        self._tolerance = tolerance_s
        self._jitter = (tolerance_s / 3.0) ** 2
        self.drift = 0.0
        self.start(0, 0.0)

    def start(self, number: int, time_s: float) -> None:
        """Begin anew at one stamp, keeping what is known of the drift.

        `number`: sample number; `time_s`: its stamp, s.
        """
        self._number, self._time = number, time_s
        self._p00, self._p01, self._p11 = self._jitter, 0.0, DRIFT_SD**2

    def deviation(self, number: int, time_s: float) -> float:
        """Return how far a stamp lies from its prediction.

        `number`: sample number; `time_s`: its stamp, s. Returns s; positive if the stamp is late.
        """
        return time_s - self._time - (number - self._number) * self._period * (1.0 + self.drift)

    def agrees(self, number: int, time_s: float) -> bool:
        """Tell whether a stamp lies within the tolerance of its prediction, and what the drift may have added.

        `number`: sample number; `time_s`: its stamp, s. Returns false for a stamp that is not a number.
        """
        dt = (number - self._number) * self._period
        # The spread of the offset is left out: it is jitter, which the tolerance covers, and one sample must stand out.
        return abs(self.deviation(number, time_s)) <= self._tolerance + _SIGMAS * sqrt(self._p11) * abs(dt)

    def agree(self, number: int, time_s: float, other: int, other_s: float) -> bool:
        """Tell whether two stamps agree with each other, whatever was known before.

        `number`, `other`: sample numbers; `time_s`, `other_s`: their stamps, s. Returns false if one of the stamps is
        not a number.
        """
        dt = (other - number) * self._period
        between = other_s - time_s - dt * (1.0 + self.drift)
        return abs(between) <= self._tolerance + _SIGMAS * DRIFT_SD * abs(dt)

    def learn(self, number: int, time_s: float) -> None:
        """Take in a stamp that agrees.

        `number`: sample number; below that of the last stamp, nothing is learned; `time_s`: its stamp, s.
        """
        if number <= self._number:
            return
        error = self.deviation(number, time_s)
        dt = (number - self._number) * self._period
        p00 = self._p00 + dt * (2.0 * self._p01 + dt * self._p11)
        p01 = self._p01 + dt * self._p11
        p11 = self._p11 + _DRIFT_WALK**2 * max(dt, 0.0)
        # Joseph form for one measurement of the first state.
        total = p00 + self._jitter
        k0, k1 = p00 / total, p01 / total
        self._time = time_s - (1.0 - k0) * error
        self._number = number
        self.drift += k1 * error
        self._p00 = (1.0 - k0) ** 2 * p00 + k0**2 * self._jitter
        self._p01 = (1.0 - k0) * (p01 - k1 * p00) + k0 * k1 * self._jitter
        self._p11 = p11 - 2.0 * k1 * p01 + k1**2 * total
