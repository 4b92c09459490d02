"""Power spectral density after Blackman and Tukey: the correlation function under a window, transformed.

Beside Welch's averages (`ambid.signals.spectra`): smooth, with the resolution set by the number of lags alone.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.signals.spectra import PowerSpectrum


def blackman_tukey(x: Array, rate_hz: float, *, lags: int | None = None) -> PowerSpectrum:
    """Estimate the power spectral density from the correlation function under a Hann window (Ljung 1999, sec. 6.4).

    `x`: (n_samples,), any unit, samples; their mean is removed; `rate_hz`: sampling rate in Hz. Returns the density in
    the unit of `x` squared per Hz, with its standard deviation and confidence bounds; no segments.
    """
    from scipy.fft import irfft, next_fast_len, rfft

    n = x.size
    used = min(n // 10, 30 + n // 100) if lags is None else lags
    if not 2 <= used < n // 2:
        raise RecordError(
            f"{used} lags of a record of {n} samples; 2 to {n // 2 - 1} are possible. Give another number"
        )
    size = next_fast_len(n + used)
    correlation = irfft(np.abs(rfft(x - np.mean(x), size)) ** 2, size)[: used + 1] / n
    window = 0.5 * (1.0 + np.cos(np.pi * np.arange(used + 1) / used))
    points = 2 * next_fast_len(2 * used)
    even = np.zeros(points)
    even[: used + 1] = correlation * window
    even[-used:] = even[used:0:-1]
    # a Hann window has small negative side lobes: where nothing is, the estimate may dip below zero
    density = 2.0 * np.maximum(rfft(even).real, 0.0) / rate_hz
    density[[0, -1]] *= 0.5
    return PowerSpectrum(
        frequency_hz=np.arange(density.size) * rate_hz / points,
        density=density,
        n_segments=0,
        n_effective=float(n / (1.0 + 2.0 * np.sum(window[1:] ** 2))),
    )
