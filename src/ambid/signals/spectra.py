"""Power spectral density and coherence after Welch, in units per hertz."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.errors import RecordError
from ambid.record.record import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PowerSpectrum:
    """One-sided power spectral density.

    Attributes
    ----------
    frequency_hz : ndarray, shape (n_frequencies,), Hz
        Frequencies from 0 to half the rate.
    density : ndarray, shape (n_frequencies,), signal unit squared per Hz
        Its integral over frequency is the variance.
    n_segments : int
        Half-overlapping segments that were averaged.
    """

    frequency_hz: Array
    density: Array
    n_segments: int


def power_spectrum(x: Array, rate_hz: float, *, segment: int | None = None) -> PowerSpectrum:
    """Estimate the power spectral density by Welch's method (Hann window, half overlap, mean removed).

    Parameters
    ----------
    x : ndarray, shape (n_samples,), any unit
        Samples.
    rate_hz : float
        Sampling rate in Hz.
    segment : int, optional
        Samples of a segment; by default an eighth of the record, at least 256 where there are as many.

    Returns
    -------
    PowerSpectrum
        The density in the unit of `x` squared per Hz.

    Raises
    ------
    RecordError
        If the segment does not fit the record.
    """
    from scipy.signal import welch

    length = _segment(x.size, segment)
    frequency, density = welch(x, fs=rate_hz, nperseg=length)
    return PowerSpectrum(frequency_hz=frequency, density=density, n_segments=_count(x.size, length))


def coherence(u: Array, y: Array, rate_hz: float, *, segment: int | None = None) -> tuple[Array, Array]:
    """Estimate the coherence ``|S_uy|² / (S_uu S_yy)`` by Welch's method.

    Parameters
    ----------
    u, y : ndarray, shape (n_samples,), any units
        Two signals.
    rate_hz : float
        Sampling rate in Hz.
    segment : int, optional
        Samples of a segment, as in `power_spectrum`.

    Returns
    -------
    frequency_hz : ndarray, shape (n_frequencies,), Hz
        Frequencies.
    coherence : ndarray, shape (n_frequencies,), dimensionless
        0 to 1; a value of about 1/n_segments is what independent signals give. 0 where a signal has no power.

    Raises
    ------
    RecordError
        If lengths differ or the segment leaves fewer than two segments, for which coherence is 1 by construction.
    """
    from scipy.signal import csd, welch

    if u.shape != y.shape:
        raise RecordError(f"coherence of signals of {u.size} and {y.size} samples; both must be as long. Cut one")
    length = _segment(u.size, segment)
    if _count(u.size, length) < 2:
        raise RecordError(
            f"coherence of {u.size} samples in segments of {length}; one segment always gives 1. Give a shorter segment"
        )
    frequency, cross = csd(u, y, fs=rate_hz, nperseg=length)
    product = welch(u, fs=rate_hz, nperseg=length)[1] * welch(y, fs=rate_hz, nperseg=length)[1]
    ratio = np.divide(np.abs(cross) ** 2, product, out=np.zeros_like(product), where=product > 0)
    return frequency, ratio


def _segment(n_samples: int, segment: int | None) -> int:
    if segment is None:
        return min(n_samples, max(256, n_samples // 8))
    if not 8 <= segment <= n_samples:
        raise RecordError(f"a segment of {segment} samples; it must have 8 to {n_samples} (the record). Give another")
    return segment


def _count(n_samples: int, segment: int) -> int:
    return (n_samples - segment // 2) // (segment - segment // 2)
