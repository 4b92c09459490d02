"""Covariance of instrumental sums under noise of any spectrum, taken from the residuals' own smoothed spectrum.

An autoregression of moderate order misses a slow part that is hidden under white noise; the instruments of a slow plant
see just that part. The periodogram, averaged over a width that grows with frequency, has it, and holds what the noises
of several equations have in common.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array

Complex = NDArray[np.complex128]

_LEAST, _WIDTH = 2, 0.15  # lines to either side: at least, and as a part of the line number


def score_covariance_of(instruments: Sequence[Array], residuals: Sequence[Array]) -> Array:
    """Return the covariance of Z_k' e_k of several equations, stacked.

    `instruments`: (n_samples, n_k); `residuals`: (n_samples,), one for each. Returns (sum of n_k, sum of n_k).
    """
    n = residuals[0].size
    S = _smoothed(np.stack(residuals, axis=1))  # at the lines of n samples
    size = 1 << int(np.ceil(np.log2(2 * n)))
    lines = np.arange(size // 2 + 1) * (n / size)
    weight = np.full(lines.size, 2.0)
    weight[[0, -1]] = 1.0
    F = [np.fft.rfft(z, size, axis=0) for z in instruments]
    k_all = range(len(residuals))
    grid = np.arange(S.shape[0])

    def block(k: int, m: int) -> Array:
        s = np.interp(lines, grid, S[:, k, m].real) + 1j * np.interp(lines, grid, S[:, k, m].imag)
        return np.asarray((np.conj(F[k]).T @ (F[m] * (weight * s)[:, None])).real / size)

    out = np.block([[block(k, m) for m in k_all] for k in k_all])
    return np.asarray((out + out.T) / 2)


def _smoothed(e: Array) -> Complex:
    """Cross spectra of the columns, shape (n // 2 + 1, m, m), a taper against leakage of slow noise."""
    n, m = e.shape
    taper = np.sin(np.pi * (np.arange(n) + 0.5) / n)
    X = np.fft.rfft(e * taper[:, None] / np.sqrt(np.mean(taper**2)), axis=0) / np.sqrt(n)
    raw = X[:, :, None] * np.conj(X[:, None, :])
    total = np.concatenate([np.zeros((1, m, m)), np.cumsum(raw, axis=0)])
    k = np.arange(raw.shape[0])
    half = np.maximum(_LEAST, (_WIDTH * k).astype(int))
    low, high = np.maximum(k - half, 0), np.minimum(k + half + 1, k.size)
    return np.asarray((total[high] - total[low]) / (high - low)[:, None, None])
