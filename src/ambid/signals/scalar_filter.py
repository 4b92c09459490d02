"""The scalar Kalman-Bucy filter (thesis eq. 5.3) and the passive low-pass it is compared with (figs 5.10 to 5.12).

x' = A x + W w, y = C x + n with white w of intensity Q and n of intensity R gives x̂' = A x̂ + L (y - C x̂).
With A = 0 the filter is itself a first-order low-pass of corner L C rad/s: what it has over a passive one is the
corner, which follows from the noise instead of being chosen.
"""

from __future__ import annotations

from math import exp, expm1, isfinite, pi, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError


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


def kalman_bucy(
    y: Array,
    rate_hz: float,
    *,
    a: float = 0.0,
    c: float = 1.0,
    w: float = 1.0,
    q: float = 60.0,
    r: float = 1.0,
    start: float | None = None,
) -> Array:
    """Filter samples with the stationary scalar Kalman-Bucy filter, discretised exactly.

    x̂' = (A - L C) x̂ + L y (thesis eq. 5.3) with each sample of y held from its instant to the next.

    Parameters
    ----------
    y : ndarray, shape (n_samples,)
        Measurement.
    rate_hz : float
        Sampling rate in Hz.
    a, c, w, q, r : float
        As in `kalman_bucy_gain`.
    start : float, optional
        x̂ at the first sample, in the unit of the state; y[0]/C by default.

    Returns
    -------
    ndarray, shape (n_samples,)
        x̂ at the sampling instants, in the unit of the state; each uses the samples before it, so it can run on-line.

    Raises
    ------
    EstimationError
        If there is no stationary filter, the rate is not positive or a sample is not finite.
    """
    gain = kalman_bucy_gain(a=a, c=c, w=w, q=q, r=r)
    values = _samples(y, rate_hz)
    return _first_order(values, rate_hz, a - gain * c, gain, values[0] / c if start is None else start)


def passive_lowpass(y: Array, rate_hz: float, *, corner_hz: float, start: float | None = None) -> Array:
    """Filter samples with a first-order RC low-pass, x' = (y - x)/τ with τ = 1/(2π corner), discretised exactly.

    Parameters
    ----------
    y : ndarray, shape (n_samples,), any unit
        Measurement, held from each sample to the next.
    rate_hz : float
        Sampling rate in Hz.
    corner_hz : float
        Frequency of -3 dB in Hz, over 0.
    start : float, optional
        Value at the first sample; y[0] by default.

    Returns
    -------
    ndarray, shape (n_samples,), unit of `y`
        Voltage over the capacitor at the sampling instants.

    Raises
    ------
    EstimationError
        If the corner or the rate is not positive or a sample is not finite.
    """
    if not (isfinite(corner_hz) and corner_hz > 0):
        raise EstimationError(f"passive low-pass: the corner is {corner_hz} Hz; it must be positive. Give another")
    values = _samples(y, rate_hz)
    omega = 2.0 * pi * corner_hz
    return _first_order(values, rate_hz, -omega, omega, float(values[0]) if start is None else start)


def _samples(y: Array, rate_hz: float) -> Array:
    values = np.ascontiguousarray(y, dtype=np.float64)
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise EstimationError(
            f"filter input has shape {values.shape}; it must be finite samples (n_samples,). Pass one column"
        )
    if not (isfinite(rate_hz) and rate_hz > 0):
        raise EstimationError(f"filter rate is {rate_hz} Hz; it must be positive. Give the sampling rate")
    return values


def _first_order(y: Array, rate_hz: float, pole: float, gain: float, start: float) -> Array:
    """Solve x' = pole·x + gain·y for held y: x[k+1] = e^(pole T) x[k] + gain (e^(pole T) - 1)/pole y[k]."""
    from scipy.signal import lfilter

    decay, forward = exp(pole / rate_hz), gain * expm1(pole / rate_hz) / pole
    # Direct form II transposed: its state before the first sample is what the first output adds to b0·y = 0.
    filtered: Array = lfilter([0.0, forward], [1.0, -decay], y, zi=np.array([start]))[0]
    return filtered
