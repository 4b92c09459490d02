"""First weights of a state-space network whose output is measured without sign.

The sign is not in the data, and a search from a wrong one ends in a wrong minimum. So linear models of one to four
poles are laid on a grid, each with the gain that fits the magnitude best, and the best of them are the starts.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.nonlinear.networks.magnitude_problem import FoldedLayout, Parts

MOST_STATES = 4
_REAL = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98)
_RADII = (0.6, 0.8, 0.9, 0.95, 0.98)
_ANGLES = np.linspace(0.1, 1.6, 16)  # rad per sample
_SENSOR = 0.3  # its pole at first
_STEP = 0.4  # of the chain of states: near the size of 1 - pole for a plant that is sampled well


def folded_starts(parts: Parts, n: int, most: int) -> list[tuple[FoldedLayout, Array]]:
    """Return the best linear models of the grid, the best first.

    `n`: states, one to `MOST_STATES`; `most`: so many models. Returns (n_theta,).
    """
    from scipy.signal import lfilter

    m = parts[0][1].shape[1]
    layout = FoldedLayout(n=n, n_inputs=m, neurons=0, step=_STEP)
    y = np.concatenate([p[0] for p in parts])
    scored: list[tuple[float, int, Array, int, float]] = []
    for A in _denominators(n):
        for j in range(m):
            x = np.concatenate([np.abs(lfilter([0.0, 1.0], A, p[1][:, j])) for p in parts])
            size = float(x @ x)
            if np.isfinite(size) and size > 0:
                gain = float(x @ y) / size
                scored.append((float(np.sum((gain * x - y) ** 2)), len(scored), A, j, gain))
    scored.sort(key=lambda found: found[:2])
    return [(layout, _theta(layout, A, j, gain)) for _, _, A, j, gain in scored[:most]]


def _theta(layout: FoldedLayout, A: Array, channel: int, gain: float) -> Array:
    """Weights of the model gain q^-1 / A(q^-1): last row from the polynomial in q - 1, B from the impulse response."""
    n, step = layout.n, layout.step
    shifted = np.poly1d(A)(np.poly1d([1.0, 1.0])).coeffs  # of the powers of q - 1, highest first
    theta = np.zeros(layout.n_theta)
    theta[:n] = -shifted[:0:-1] / step ** np.arange(n - 1, -1, -1)
    theta[n - 1] += 1.0
    M = layout.A(theta)
    seen = np.stack([np.linalg.matrix_power(M, k)[0] for k in range(n)])
    response = np.zeros(n)
    for k in range(n):
        response[k] = gain * (k == 0) - float(A[1 : k + 1] @ response[:k][::-1])
    theta[n + channel : n + n * layout.n_inputs : layout.n_inputs] = np.linalg.solve(seen, response)
    theta[-1] = _SENSOR
    return theta


def _denominators(n: int) -> list[Array]:
    if n == 1:
        return [np.array([1.0, -p]) for p in _REAL]
    pairs = [np.array([1.0, -2 * r * np.cos(w), r * r]) for r in _RADII for w in _ANGLES]
    pairs += [np.convolve([1.0, -p], [1.0, -q]) for p in _REAL for q in _REAL if q >= p]
    for _ in range(n - 2):
        pairs = [np.convolve(p, [1.0, -q]) for p in pairs for q in (_REAL if n == 3 else _REAL[1::2])]
    return pairs
