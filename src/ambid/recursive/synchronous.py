"""A sinusoid whose phase angle is known at every sample, followed and taken off: unbalance through a spin-up.

y = a cos φ(t) + b sin φ(t) + offset + noise, with a, b and the offset in random walks: a Kalman filter of three states
whose regressors turn with the shaft. What it leaves of y is y through a notch that follows the speed.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from math import isfinite, pi, sqrt
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.estimator import as_block, check_channels
from ambid.recursive.square_root import covariance_of

_START = 1e6  # variance of each state before the first sample, over that of the noise
_BATCHES = 16  # in one memory, to see the density of the noise around the rotation
_LONGEST = 4 * _BATCHES  # batches over which that is averaged
_ANY = pi / sqrt(3.0)  # standard deviation of a phase of which nothing is known


@dataclass(frozen=True, slots=True, kw_only=True)
class Sinusoid:
    """amplitude·cos(φ + phase), as it is now."""

    amplitude: float  # in the unit of the signal. Under about two standard deviations the amplitude leans upward.
    amplitude_sd: float
    phase: float  # in rad, -π to π; 1.81 rad is the spread of a phase of which nothing is known
    phase_sd: float


class SynchronousFilter:
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
        from ambid.recursive.kalman_kernels import synchronous_scan

        check_channels("synchronous filter", rate_hz, channels)
        n = memory_s * rate_hz
        if not (isfinite(n) and n >= 2 * _BATCHES):
            raise EstimationError(
                f"synchronous filter: a memory of {memory_s} s is {n:.3g} samples; at least {2 * _BATCHES} are wanted. "
                "Give a longer one"
            )
        self.channels, self.memory_s = channels, memory_s
        self.n_samples = self.n_missing = 0
        self._state = np.zeros((channels, 18))
        # a walk of variance q a sample is followed with the gain √(q/2) a sample where cos² is 1/2 on average
        size = int(n / _BATCHES)
        taper = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
        taper /= np.sqrt(np.mean(taper**2))
        self._constants = np.array([2.0 / n**2, 3 * _START, _LONGEST, _START, *taper])
        self._scan = synchronous_scan
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
            self.n_missing += self._scan(y, angle, out, self._state, self._constants)
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
        self.n_missing += self._scan(y, np.ascontiguousarray(angle), out, self._state, self._constants)
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

    def copy(self) -> Self:
        """Return an independent filter in the same state.

        Returns
        -------
        SynchronousFilter
        """
        other = copy(self)
        other._state = self._state.copy()
        other._one = (self._one[0].copy(), self._one[1].copy(), self._one[2].copy())
        return other
