"""Plants, excitations and loops whose frequency response is known exactly, for the tests of its estimates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import freqz, lfilter

B, A = np.array([0.0, 0.5, 0.2]), np.array([1.0, -0.8, 0.3])
MIMO_B = (([0.0, 0.5], [0.0, 0.2, 0.1]), ([0.3, 0.1], [0.0, 0.4]))
MIMO_A = [1.0, -0.6]


def response(b, a, frequency_hz):
    """Return B/A on the unit circle at a rate of 1 Hz."""
    return freqz(b, a, 2 * np.pi * np.asarray(frequency_hz))[1]


def mimo_response(frequency_hz):
    return np.stack([np.stack([response(b, MIMO_A, frequency_hz) for b in row], axis=1) for row in MIMO_B], axis=1)


def mimo(u):
    return np.stack([sum(lfilter(b, MIMO_A, x) for b, x in zip(row, u.T, strict=True)) for row in MIMO_B], axis=1)


def one_period(rng, lines, n, rms=1.0):
    """Return a period of a random-phase multisine of equal amplitudes."""
    spectrum = np.zeros(n // 2 + 1, dtype=complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(len(lines)))
    return rms * np.fft.irfft(spectrum, n) * n / np.sqrt(2 * len(lines))


def steady(filtered, x, periods=1):
    """Return `periods` periods of the steady answer of `filtered` to the period `x`."""
    last = filtered(np.concatenate([x] * 6))[-len(x) :]
    return np.concatenate([last] * periods)


@dataclass(frozen=True)
class Loop:
    """y = B/A u + v, u = r - k y, with an open-loop pole at 1.1."""

    b = np.array([0.0, 0.5])
    a = np.array([1.0, -1.7, 0.66])
    k = 1.6

    def run(self, r, v):
        b = np.array([*self.b, 0.0])
        closed = self.a + self.k * b
        y = lfilter(b, closed, r) + lfilter(self.a, closed, v)
        return r - self.k * y, y


def mimo_loop(r, v, gain=((0.5, 0.2), (-0.3, 0.4))):
    """Return inputs and outputs of the plant of `mimo` under u(t) = r(t) - K y(t-1), y = plant + v."""
    K, b = np.array(gain), np.zeros((3, 2, 2))
    for i, row in enumerate(MIMO_B):
        for j, c in enumerate(row):
            b[: len(c), i, j] = c
    u, y, free = np.zeros(r.shape), np.zeros(r.shape), np.zeros(r.shape)
    for t in range(len(r)):
        u[t] = r[t] - (K @ y[t - 1] if t else 0.0)
        free[t] = sum(b[k] @ u[t - k] for k in range(min(3, t + 1))) - (MIMO_A[1] * free[t - 1] if t else 0.0)
        y[t] = free[t] + v[t]
    return u, y


def inside(frf, truth, level=0.95):
    """Return the share of the entries whose confidence circle holds the truth."""
    return float(np.mean(np.abs(frf.G - truth) < frf.confidence_radius(level)))
