"""Multisine: a periodic sum of sines with chosen amplitudes, and phases that keep its peaks low."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError
from ambid.signals.waveforms import AmplitudeIs, checked, checked_band, scaled


def multisine(
    n_samples: int,
    rate_hz: float,
    *,
    amplitude: float,
    band: tuple[float, float],
    periods: int = 1,
    phases: Literal["random", "schroeder"] = "random",
    shape: Literal["flat", "pink"] = "flat",
    lines: Literal["all", "odd"] = "all",
    crest_iterations: int = 0,
    seed: int | np.random.Generator = 0,
    amplitude_is: AmplitudeIs = "peak",
) -> Array:
    """Return a whole number of periods of a multisine.

    It has a line at each multiple of rate/(n_samples/periods) in the band (0 and half the rate left out). Schroeder
    phases φ_k = -2π Σ_{j<k} (k - j) p_j, with p_j the share of line j in the power, give a crest factor of about 1.7
    for a flat spectrum of many lines (Schroeder 1970). `crest_iterations` lowers it by clipping the peaks and putting
    the amplitudes back, from the given phases (van der Ouderaa, Schoukens and Renneboog 1988); the best iteration is
    kept.

    Parameters
    ----------
    n_samples : int
        Samples, a multiple of `periods`.
    rate_hz : float
        Sampling rate in Hz.
    amplitude : float
        Largest absolute value, or rms, in the unit of the result.
    band : (float, float)
        Band in Hz.
    periods : int
        Whole periods in the signal, at least 1.
    phases : {"random", "schroeder"}
        Phases of the lines.
    shape : {"flat", "pink"}
        Amplitude of the lines: all equal, or falling with 1/√f (equal power per octave).
    lines : {"all", "odd"}
        All multiples, or the odd ones only, whose even neighbours then show nonlinearity.
    crest_iterations : int
        Iterations that lower the crest factor; some 100 go far.
    seed : int or numpy.random.Generator
        Source of random phases.
    amplitude_is : {"peak", "rms"}
        What `amplitude` means.

    Returns
    -------
    ndarray, shape (n_samples,), unit of `amplitude`
        The multisine.

    Raises
    ------
    AmbidError
        If a setting is out of range, or no line falls into the band.
    """
    checked(n_samples, rate_hz)
    low, high = checked_band(band, rate_hz)
    if periods < 1 or n_samples % periods or crest_iterations < 0:
        raise AmbidError(
            f"multisine of {n_samples} samples in {periods} periods with {crest_iterations} iterations; periods "
            f"must divide the samples and "
            "iterations not be negative. Give other numbers"
        )
    period = n_samples // periods
    numbers = _line_numbers(period, rate_hz, low, high, lines)
    size = _amplitudes(numbers, shape)
    if phases == "random":
        angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, numbers.size)
    elif phases == "schroeder":
        angle = schroeder_phases(size)
    else:
        raise AmbidError(f"multisine phases {phases!r}; they must be 'random' or 'schroeder'. Give one of them")
    x = _flattened(period, numbers, size, angle, crest_iterations)
    return np.tile(scaled(x, amplitude, amplitude_is), periods)


def schroeder_phases(size: Array) -> Array:
    """Return Schroeder's phases for lines of the given amplitudes (equally spaced in frequency).

    Parameters
    ----------
    size : ndarray, shape (n_lines,), any unit
        Amplitudes of the lines, in order of frequency.

    Returns
    -------
    ndarray, shape (n_lines,), rad
        φ_k = -2π Σ_{j<k} (k - j) p_j with p_j = size_j²/Σ size² (Schroeder 1970).
    """
    share = size**2 / np.sum(size**2)
    # Σ_{j<k} (k - j) p_j is the running sum of the running sum of p, one line late.
    twice = np.cumsum(np.cumsum(share))
    phases: Array = -2.0 * np.pi * np.concatenate(([0.0], twice[:-1]))
    return phases


def crest_factor(x: Array) -> float:
    """Return the crest factor max|x|/rms(x).

    Parameters
    ----------
    x : ndarray, shape (n_samples,), any unit
        Samples, not all zero.

    Returns
    -------
    float
        Dimensionless, at least 1; √2 for a sine.

    Raises
    ------
    AmbidError
        If all samples are zero.
    """
    rms = float(np.sqrt(np.mean(np.square(x))))
    if rms == 0.0:
        raise AmbidError("the crest factor of a signal that is zero throughout does not exist. Pass an excitation")
    return float(np.max(np.abs(x))) / rms


def _line_numbers(period: int, rate_hz: float, low: float, high: float, lines: str) -> np.ndarray:
    spacing = rate_hz / period
    # A band end that is meant to be a line (1 Hz at 1 Hz spacing) must not miss it by round-off.
    first = max(1, int(np.ceil(low / spacing - 1e-9)))
    last = min((period - 1) // 2, int(np.floor(high / spacing + 1e-9)))
    if lines not in ("all", "odd"):
        raise AmbidError(f"multisine lines {lines!r}; they must be 'all' or 'odd'. Give one of them")
    numbers = np.arange(first, last + 1)
    numbers = numbers if lines == "all" else numbers[numbers % 2 == 1]
    if not numbers.size:
        raise AmbidError(
            f"a multisine with lines every {spacing:g} Hz has none ({lines}) between {low:g} and {high:g} Hz. "
            "Widen the band, or make the period longer"
        )
    return numbers


def _amplitudes(numbers: np.ndarray, shape: str) -> Array:
    if shape == "flat":
        return np.ones(numbers.size)
    if shape == "pink":
        return 1.0 / np.sqrt(numbers.astype(np.float64))
    raise AmbidError(f"multisine shape {shape!r}; it must be 'flat' or 'pink'. Give one of them")


def _flattened(period: int, numbers: np.ndarray, size: Array, angle: Array, iterations: int) -> Array:
    """Return one period with the phases `angle`, after `iterations` rounds of clipping that change the phases only."""

    def wave(phases: Array) -> Array:
        spectrum = np.zeros(period // 2 + 1, dtype=complex)
        spectrum[numbers] = size * np.exp(1j * phases)
        return np.asarray(np.fft.irfft(spectrum, period), dtype=np.float64)

    x: Array = wave(angle)
    best: Array = x
    for k in range(iterations):
        # Clip little at first and less later: hard clipping moves the phases too far to settle.
        limit = (0.85 + 0.14 * k / iterations) * np.max(np.abs(x))
        angle = np.angle(np.fft.rfft(np.clip(x, -limit, limit))[numbers])
        x = wave(angle)
        if np.max(np.abs(x)) < np.max(np.abs(best)):
            best = x
    return best
