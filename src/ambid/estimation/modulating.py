"""Fourier modulating functions phi_k(t) = w(t) exp(-j w_k t): the weak form over all frequencies at once.

The window w spans the record and vanishes with three derivatives at both ends, so that integration by parts leaves no
boundary terms and no measured signal is differentiated (thesis eq. 3.8; Shinbrot 1957; Pearson and Lee 1985). All
moments come from a few FFTs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array

Spectrum = NDArray[np.complexfloating]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moments:
    """Spectra of the signals and of their first and second derivatives, by modulating functions."""

    omega: Array  # (n_lines,), rad/s
    # role -> (value, first derivative, second derivative), each (n_lines,), complex
    signals: Mapping[str, tuple[Spectrum, Spectrum, Spectrum]]


def moments(signals: Mapping[str, Array], held: tuple[str, ...], rate_hz: float) -> Moments:
    """Take the modulating-function moments of all signals.

    `signals`: role -> samples, shape (n_samples,), SI, deviations from the operating point.
    """
    n = len(next(iter(signals.values())))
    period, length = 1.0 / rate_hz, n / rate_hz
    t = np.arange(n) / n
    w = (3 - 4 * np.cos(2 * np.pi * t) + np.cos(4 * np.pi * t)) / 8
    w1 = (8 * np.pi * np.sin(2 * np.pi * t) - 4 * np.pi * np.sin(4 * np.pi * t)) / (8 * length)
    w2 = (16 * np.pi**2 * np.cos(2 * np.pi * t) - 16 * np.pi**2 * np.cos(4 * np.pi * t)) / (8 * length**2)
    omega = 2 * np.pi * np.fft.rfftfreq(n, period)
    jw = 1j * omega
    result = {}
    for role, x in signals.items():
        m0, m1, m2 = np.fft.rfft(w * x), np.fft.rfft(w1 * x), np.fft.rfft(w2 * x)
        value = m0 * np.sinc(omega * period / (2 * np.pi)) * np.exp(-0.5j * omega * period) if role in held else m0
        # integration by parts: int phi x' = -int phi' x with phi' = (w' - jw w) e, and again for x''
        result[role] = (value, jw * m0 - m1, m2 - 2 * jw * m1 - omega**2 * m0)
    return Moments(omega=np.asarray(omega, dtype=np.float64), signals=result)
