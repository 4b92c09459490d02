"""Filters that run on-line: the scalar Kalman-Bucy filter (thesis eq. 5.3), the passive low-pass, and a notch.

The Kalman-Bucy filter of x' = a x + w·noise of intensity q, measured as y = c x + noise of intensity r, is fed with
held samples. The notch follows a sinusoid whose phase angle is known at every sample and takes it off, as unbalance
through a spin-up: y = a cos φ(t) + b sin φ(t) + offset + noise with a, b and the offset in random walks is a Kalman
filter of three states whose regressors turn with the shaft.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from math import exp, expm1, isfinite, pi, sqrt
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.estimator import Copied, as_block, check_channels, kernels
from ambid.recursive.square_root import covariance_of

_START = 1e6  # variance of each state of the notch before the first sample, over that of the noise
_BATCHES = 16  # in one memory, to see the density of the noise around the rotation
_LONGEST = 4 * _BATCHES  # batches over which that is averaged
_ANY = pi / sqrt(3.0)  # standard deviation of a phase of which nothing is known


class StreamingFilter(Copied):
    """A first-order filter x⁺ = decay x + forward y that runs on each of several channels alone.

    Splitting a stream into samples and blocks in another way does not change any number. A value that is not finite is
    missing: x⁺ = alone x, and `n_missing` counts it. `first` is the state over the first value, where none is given.
    """

    def __init__(
        self,
        name: str,
        *,
        channels: int,
        decay: float,
        forward: float,
        alone: float,
        first: float,
        start: float | None,
    ) -> None:
        self.name, self.channels = name, channels
        self.n_samples = self.n_missing = 0
        self._begun = np.nan if start is None else float(start)
        self._state = np.full(channels, self._begun)
        self._constants = np.array([decay, forward, alone, first])
        self._one = np.empty((2, 1, 1))

    @property
    def state(self) -> Array:
        """A copy of the estimate that is ready for the next sample, shape (channels,)."""
        return self._state.copy()

    def update(self, measurement: ArrayLike) -> Array | float:
        """Take in one sample or a block and return it filtered.

        `measurement`: (channels,), or (n_samples, channels) for a block.
        """
        if isinstance(measurement, float) and self.channels == 1:
            y, out = self._one
            y[0, 0] = measurement
            self.run(y, out)
            return float(out[0, 0])
        given = np.asarray(measurement, dtype=np.float64)
        block = as_block(given, self.channels, self.name)
        out = np.empty(block.shape)
        self.run(block, out)
        return float(out[0, 0]) if given.ndim == 0 else out.reshape(given.shape)

    def run(self, block: Array, out: Array) -> None:
        """Filter a block without looking at its shape or allocating anything.

        `block`, `out`: (n_samples, channels), C order, writeable, measured and, on return, filtered; may be one array.
        """
        self.n_missing += kernels("kalman").hold_scan(block, out, self._state, self._constants)
        self.n_samples += block.shape[0]

    def anew(self, channels: int) -> Self:
        """Return a filter of the same numbers, for another number of channels, that has seen nothing yet."""
        other = deepcopy(self)
        other.channels, other.n_samples, other.n_missing = channels, 0, 0
        other._state = np.full(channels, self._begun)
        return other


def kalman_bucy_gain(*, a: float = 0.0, c: float = 1.0, w: float = 1.0, q: float = 60.0, r: float = 1.0) -> float:
    """Return the stationary gain L = S C/R of the scalar filter.

    S is the positive root of the Riccati equation 2 A S - S² C²/R + W² Q = 0 (thesis 5.3.2, with W Q Wᵀ where it
    prints W Q Cᵀ). The defaults are the thesis's: L = √60 = 7.746 1/s.

    Parameters
    ----------
    a : float
        A in 1/s.
    c : float
        C, unit of the measurement per unit of the state; not 0.
    w : float
        W, unit of the state per second and unit of w.
    q : float
        Intensity (two-sided density) of w, its unit squared times s; at least 0.
    r : float
        Intensity of the measurement noise, its unit squared times s; over 0. White noise of variance σ² sampled at f
        Hz has σ²/f.

    Returns
    -------
    float
        L in state unit per measurement unit and second.

    Raises
    ------
    EstimationError
        If C is 0, Q negative or R not positive, or A and W² Q are both 0 (the stationary gain would be 0).
    """
    numbers = {"A": a, "C": c, "W": w, "Q": q, "R": r}
    for label, value in numbers.items():
        if not isfinite(value):
            raise EstimationError(f"Kalman-Bucy filter: {label} is {value}; it must be finite. Give a number")
    if c == 0.0 or q < 0.0 or r <= 0.0:
        raise EstimationError(
            f"Kalman-Bucy filter: C = {c:g}, Q = {q:g}, R = {r:g}; C must not be 0, Q not negative and R positive. "
            f"Give others"
        )
    if a == 0.0 and w * w * q == 0.0:
        raise EstimationError(
            "Kalman-Bucy filter: A = 0 without process noise has no stationary gain but 0. Give Q > 0"
        )
    s = (a + sqrt(a * a + c * c * w * w * q / r)) * r / (c * c)
    return s * c / r


class ScalarKalman(StreamingFilter):
    """Stationary Kalman-Bucy filter of one or several channels that have nothing to do with each other.

    x̂' = A x̂ + L (y - C x̂) is solved exactly, each sample of y held until the next; what comes out is x̂ at the sampling
    instants, from the samples before. The defaults are the thesis's (5.3.2):
    A = 0, W = C = 1, R = 1, Q = 60, so that L = √60 = 7.746 1/s. `KalmanFilter` has the discrete and the varying form.

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    a, c, w, q, r : float
        As in `kalman_bucy_gain`: intensities, not variances of samples. White noise of variance σ² in
        samples of f Hz has r = σ²/f.
    start : float, optional
        Estimate before the first sample; y/c of the first sample by default.
    channels : int

    Raises
    ------
    EstimationError
        If a number is out of range, or there is no stationary filter.
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
        start: float | None = None,
        channels: int = 1,
    ) -> None:
        check_channels("scalar Kalman filter", rate_hz, channels)
        self.gain = kalman_bucy_gain(a=a, c=c, w=w, q=q, r=r)
        pole = a - self.gain * c
        super().__init__(
            "scalar Kalman filter",
            channels=channels,
            decay=exp(pole / rate_hz),
            forward=self.gain * expm1(pole / rate_hz) / pole,
            alone=exp(a / rate_hz),
            first=1.0 / c,
            start=start,
        )


class PassiveLowpass(StreamingFilter):
    """First-order RC low-pass, x' = (y - x)/τ with τ = 1/(2π corner), discretised exactly; y held over a sample.

    Gives the voltage over the capacitor at the sampling instants. Over a missing value it stays where it is.

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
            decay=exp(step),
            forward=-expm1(step),
            alone=1.0,
            first=1.0,
            start=start,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Sinusoid:
    """amplitude·cos(φ + phase), as it is now."""

    amplitude: float  # in the unit of the signal. Under about two standard deviations the amplitude leans upward.
    amplitude_sd: float
    phase: float  # in rad, -π to π; 1.81 rad is the spread of a phase of which nothing is known
    phase_sd: float


class SynchronousFilter(Copied):
    """Known-frequency regressor and notch.

    Cosine and sine parts and the offset are followed with a memory that is fixed in time, so that the notch is
    2/(2π memory) Hz wide at any speed. Standard deviations come from the random walk and from the density of the noise
    around the rotation, which is estimated beside: coloured noise is allowed for. Parts that stand still have smaller
    errors than they say, by √2. At standstill sine and cosine cannot be told from the offset: the covariance grows to
    its start and no further.

    Under feedback the controller answers the rotation too: what is found is the synchronous part of this signal, not
    the force of the unbalance.

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    memory_s : float
        Time constant of the estimates, s; at least 32 samples.
    channels : int
        Signals that share the angle.

    Attributes
    ----------
    n_samples, n_missing : int
        Samples taken in, and single values that were missing.

    Raises
    ------
    EstimationError
        If the rate is not positive or the memory too short.
    """

    def __init__(self, rate_hz: float, *, memory_s: float, channels: int = 1) -> None:
        check_channels("synchronous filter", rate_hz, channels)
        n = memory_s * rate_hz
        if not (isfinite(n) and n >= 2 * _BATCHES):
            raise EstimationError(
                f"synchronous filter: a memory of {memory_s} s is {n:.3g} samples; at least {2 * _BATCHES} are "
                "needed. Give a longer one"
            )
        self.channels, self.memory_s = channels, memory_s
        self.n_samples = self.n_missing = 0
        self._state = np.zeros((channels, 18))
        # a walk of variance q a sample is followed with the gain √(q/2) a sample where cos² is 1/2 on average
        size = int(n / _BATCHES)
        taper = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
        taper /= np.sqrt(np.mean(taper**2))
        self._constants = np.array([2.0 / n**2, 3 * _START, _LONGEST, _START, *taper])
        self._one = (np.empty((1, channels)), np.empty(1), np.empty((1, channels)))

    def update(self, signal: ArrayLike, phase: ArrayLike) -> Array | float:
        """Take in one sample or a block and return it without the rotation.

        Parameters
        ----------
        signal : array_like, shape (channels,), or (n_samples, channels) for a block
            A number, or (n_samples,), where there is one channel. NaN where a value is missing.
        phase : array_like, shape () or (n_samples,)
            Angle φ of the shaft in rad; may be wrapped or not. NaN where it is missing.

        Returns
        -------
        ndarray or float, shape of `signal`
            signal - a cos φ - b sin φ with a and b from the samples before; NaN where something is missing.

        Raises
        ------
        EstimationError
            If shapes do not fit.
        """
        if isinstance(signal, float) and isinstance(phase, float) and self.channels == 1:
            y, angle, out = self._one
            y[0, 0], angle[0] = signal, phase
            self.n_missing += kernels("kalman").synchronous_scan(y, angle, out, self._state, self._constants)
            self.n_samples += 1
            return float(out[0, 0])
        given = np.asarray(signal, dtype=np.float64)
        y = as_block(given, self.channels, "synchronous filter")
        angle = as_block(np.asarray(phase, dtype=np.float64), 1, "synchronous filter")[:, 0]
        if angle.size != y.shape[0]:
            raise EstimationError(
                f"synchronous filter: {angle.size} angles for {y.shape[0]} samples; give one for each sample"
            )
        out = np.empty(y.shape)
        self.n_missing += kernels("kalman").synchronous_scan(
            y, np.ascontiguousarray(angle), out, self._state, self._constants
        )
        self.n_samples += y.shape[0]
        return float(out[0, 0]) if given.ndim == 0 else out.reshape(given.shape)

    @property
    def parts(self) -> Array:
        """Cosine part, sine part and offset of each channel, shape (channels, 3)."""
        return self._state[:, :3].copy()

    @property
    def covariance(self) -> Array:
        """Of the parts of each channel, shape (channels, 3, 3); infinite before the noise is known."""
        out = np.empty((self.channels, 3, 3))
        for j, s in enumerate(self._state):
            out[j] = covariance_of(s[3:12].reshape(3, 3)) * s[15] if s[16] > 0 else np.diag(np.full(3, np.inf))
        return out

    def sinusoid(self, channel: int = 0) -> Sinusoid:
        """Return amplitude and phase of one channel, with standard deviations by the delta method.

        Parameters
        ----------
        channel : int

        Returns
        -------
        Sinusoid
        """
        a, b = (float(x) for x in self._state[channel, :2])
        size = float(np.hypot(a, b))
        P = self.covariance[channel][:2, :2]
        if not np.isfinite(P).all() or size == 0.0:
            return Sinusoid(amplitude=size, amplitude_sd=float("inf"), phase=0.0, phase_sd=_ANY)
        along, across = np.array([a, b]) / size, np.array([-b, a]) / size
        return Sinusoid(
            amplitude=size,
            amplitude_sd=float(np.sqrt(along @ P @ along)),
            phase=float(np.arctan2(-b, a)),
            phase_sd=float(min(np.sqrt(across @ P @ across) / size, _ANY)),
        )
