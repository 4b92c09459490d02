"""First-order filters that run on-line: the scalar Kalman-Bucy filter (thesis eq. 5.3) and the passive low-pass.

The state x' = a x + w·noise of intensity q, measured as y = c x + noise of intensity r, is estimated in one of two
discrete forms: the continuous filter fed with held samples, or the Kalman filter of the sampled state itself.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from math import cosh, exp, expm1, isfinite, pi, sinh, sqrt, tanh
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.estimator import as_block, check_channels
from ambid.signals.scalar_filter import kalman_bucy_gain

Scan = Callable[[Array, Array, Array, Array], int]

_FAST = 300.0  # time constants within one sample


class StreamingFilter:
    """A filter that runs on each of several channels alone, with state.

    Splitting a stream into samples and blocks in another way does not change any number. A value that is not finite is
    missing: the filter runs on over it and counts it.

    `name`: for messages; `state`: (channels, n_state); `constants`: (n_constants,); `scan`: name of the compiled
    recursion.

    `n_samples`: samples (of all channels) that were taken in, and single values that were missing; `n_missing`: samples
    (of all channels) that were taken in, and single values that were missing.
    """

    def __init__(self, name: str, *, channels: int, state: Array, constants: Array, scan: str) -> None:
        from ambid.recursive import kalman_kernels

        self.name = name
        self.channels = channels
        self.n_samples = 0
        self.n_missing = 0
        self._state = np.ascontiguousarray(state, dtype=np.float64)
        self._begun = self._state.copy()
        self._constants = np.ascontiguousarray(constants, dtype=np.float64)
        self._scan: Scan = getattr(kalman_kernels, scan)
        self._one, self._one_out = np.empty((1, channels)), np.empty((1, channels))

    @property
    def state(self) -> Array:
        """A copy of the estimate that is ready for the next sample, shape (channels,)."""
        return self._state[:, 0].copy()

    def update(self, measurement: ArrayLike) -> Array | float:
        """Take in one sample or a block and return it filtered.

        `measurement`: (channels,), or (n_samples, channels) for a block.
        """
        if isinstance(measurement, float) and self.channels == 1:
            self._one[0, 0] = measurement
            self.n_missing += self._scan(self._one, self._one_out, self._state, self._constants)
            self.n_samples += 1
            return float(self._one_out[0, 0])
        given = np.asarray(measurement, dtype=np.float64)
        block = as_block(given, self.channels, self.name)
        out = np.empty(block.shape)
        self.n_missing += self._scan(block, out, self._state, self._constants)
        self.n_samples += block.shape[0]
        return float(out[0, 0]) if given.ndim == 0 else out.reshape(given.shape)

    def run(self, block: Array, out: Array) -> None:
        """Filter a block without looking at its shape or allocating anything.

        `block`, `out`: (n_samples, channels), C order, writeable, measured and, on return, filtered; may be one array.
        """
        self.n_missing += self._scan(block, out, self._state, self._constants)
        self.n_samples += block.shape[0]

    def anew(self, channels: int) -> Self:
        """Return a filter of the same numbers that has seen nothing yet.

        `channels`: all begin as the first channel of this one did.
        """
        other = copy(self)
        other.channels, other.n_samples, other.n_missing = channels, 0, 0
        other._begun = np.tile(self._begun[:1], (channels, 1))
        other._state = other._begun.copy()
        other._one, other._one_out = np.empty((1, channels)), np.empty((1, channels))
        return other

    def copy(self) -> Self:
        """Return an independent filter in the same state."""
        other = copy(self)
        other._state = self._state.copy()
        other._one, other._one_out = self._one.copy(), self._one_out.copy()
        return other


class ScalarKalman(StreamingFilter):
    """Scalar Kalman filter of one or several channels that have nothing to do with each other.

    The defaults are the thesis's (5.3.2): A = 0, W = C = 1, R = 1, Q = 60, so that L = √60 = 7.746 1/s.

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    a, c, w, q, r : float
        As in `ambid.signals.kalman_bucy_gain`: intensities, not variances of samples. White noise of
        variance σ² in samples of f Hz has r = σ²/f.
    form : {"continuous", "discrete"}
        "continuous": x̂' = A x̂ + L (y - C x̂) solved exactly, each sample of y held until the next; gives x̂ at the
        sampling instants, from the samples before (as `ambid.signals.kalman_bucy`). "discrete": the
        optimal filter of the sampled state, x⁺ = e^(aT) x + noise of the exact variance, y with variance r f.
    start_variance : float, optional
        Variance of the state before the first sample: the gain then follows the variance in time. None: stationary.
    start : float, optional
        Estimate before the first sample; y/c of the first sample by default.
    give : {"filtered", "predicted"}
        What the discrete form returns: x̂ from the samples up to this one, or before this one.
    channels : int

    Raises
    ------
    EstimationError
        If a number is out of range, or there is no stationary filter and no `start_variance`.
    """

    def __init__(
        self,
        rate_hz: float,
        *,
        a: float = 0.0,
        c: float = 1.0,
        w: float = 1.0,
        q: float = 60.0,
        r: float = 1.0,
        form: Literal["continuous", "discrete"] = "continuous",
        start_variance: float | None = None,
        start: float | None = None,
        give: Literal["filtered", "predicted"] = "filtered",
        channels: int = 1,
    ) -> None:
        check_channels("scalar Kalman filter", rate_hz, channels)
        if form not in ("continuous", "discrete") or give not in ("filtered", "predicted"):
            raise EstimationError(
                f"scalar Kalman filter: form {form!r}, give {give!r}; form is 'continuous' or 'discrete', give "
                f"'filtered' or 'predicted'. Choose one of them"
            )
        self._fixed = (a, c, w, q, r, rate_hz)
        varying = start_variance is not None
        if start_variance is not None and not (isfinite(start_variance) and start_variance >= 0):
            raise EstimationError(
                f"scalar Kalman filter: start_variance is {start_variance}; it must be 0 or more. Give another"
            )
        if form == "continuous":
            self.gain = _gain(a, c, w, q, r, varying=varying)
            S = start_variance if start_variance is not None else self.gain * r / c
            scan = "riccati_scan" if varying else "hold_scan"
            constants = _riccati(a, c, w, q, r, 1 / rate_hz) if varying else _held(a, c, self.gain, 1 / rate_hz)
            columns = [S, 0.0]
        else:
            rho, noise = _sampled(a, w, q, 1 / rate_hz)
            _gain(a, c, w, q, r, varying=varying)
            P = _stationary(rho, c, noise, r * rate_hz) if start_variance is None else start_variance
            self.gain = c * P / (c * c * P + r * rate_hz)
            scan, constants = "scalar_scan", np.array([rho, c, noise, r * rate_hz, float(give == "predicted")])
            columns = [P, 0.0 if varying else 1.0]
        first = np.nan if start is None else float(start)
        super().__init__(
            "scalar Kalman filter",
            channels=channels,
            state=np.tile([first, *columns], (channels, 1)),
            constants=constants,
            scan=scan,
        )

    @property
    def variance(self) -> Array:
        """Variance of the error of `state`, shape (channels,): before the next sample.

        In the continuous form that of a measurement that is not sampled: what the thesis's equations say.
        """
        return self._state[:, 1].copy()


class PassiveLowpass(StreamingFilter):
    """First-order RC low-pass, x' = (y - x)/τ with τ = 1/(2π corner), discretised exactly; y held over a sample.

    Gives the voltage over the capacitor at the sampling instants, as `ambid.signals.passive_lowpass`. Over
    a missing value it stays where it is.

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    corner_hz : float
        Frequency of -3 dB in Hz, over 0.
    start : float, optional
        Value before the first sample; the first sample by default.
    channels : int

    Raises
    ------
    EstimationError
        If a number is not positive.
    """

    def __init__(self, rate_hz: float, *, corner_hz: float, start: float | None = None, channels: int = 1) -> None:
        check_channels("passive low-pass", rate_hz, channels)
        if not (isfinite(corner_hz) and corner_hz > 0):
            raise EstimationError(f"passive low-pass: the corner is {corner_hz} Hz; it must be positive. Give another")
        self.corner_hz = corner_hz
        step = -2.0 * pi * corner_hz / rate_hz
        super().__init__(
            "passive low-pass",
            channels=channels,
            state=np.full((channels, 1), np.nan if start is None else float(start)),
            constants=np.array([exp(step), -expm1(step), 1.0, 1.0]),
            scan="hold_scan",
        )


def _gain(a: float, c: float, w: float, q: float, r: float, *, varying: bool) -> float:
    """L of the stationary filter; checks the numbers of a varying one, which exists without process noise too."""
    if varying and a == 0.0 and w * w * q == 0.0 and isfinite(w) and isfinite(q):
        kalman_bucy_gain(a=-1.0, c=c, w=w, q=q, r=r)
        return 0.0
    return kalman_bucy_gain(a=a, c=c, w=w, q=q, r=r)


def _held(a: float, c: float, gain: float, period: float) -> Array:
    pole = a - gain * c
    return np.array([exp(pole * period), gain * expm1(pole * period) / pole, exp(a * period), 1.0 / c])


def _riccati(a: float, c: float, w: float, q: float, r: float, period: float) -> Array:
    g, drive = c * c / r, w * w * q
    rate = sqrt(a * a + g * drive)
    if rate * period > _FAST:
        raise EstimationError(
            f"scalar Kalman filter: {rate * period:.3g} time constants of the filter in one sample, so that its "
            "variance has no use of a start. Leave start_variance out"
        )
    z = rate * period
    t = tanh(z) / rate if rate > 0 else period
    area = 2.0 * (sinh(z / 2) / rate) ** 2 / cosh(z) if rate > 0 else period * period / 2
    rho, far = _sampled(a, w, q, period)
    return np.array([a, g, drive, 1.0 / c, t, 1.0 / cosh(z), area, rho, far])


def _sampled(a: float, w: float, q: float, period: float) -> tuple[float, float]:
    """e^(aT) and the variance that the process noise adds over a sample."""
    grown = expm1(2 * a * period) / (2 * a) if a != 0.0 else period
    return exp(a * period), w * w * q * grown


def _stationary(rho: float, c: float, noise: float, r: float) -> float:
    """Positive root of P = ρ² P r/(c² P + r) + noise, without cancellation."""
    half = (noise * c * c + (rho * rho - 1.0) * r) / 2.0
    root = sqrt(half * half + c * c * noise * r)
    return (half + root) / (c * c) if half > 0 else noise * r / (root - half)
