"""Prediction several steps ahead with any innovations form: its errors, and what the model says they should be.

From x+ = A x + B u + K e, y = C x + D u + e the error k steps ahead, inputs known, is the sum of the innovations since,
e(t) + C K e(t-1) + ... + C A^(k-2) K e(t-k+1) (Ljung 1999, sec. 3.2).
"""

from __future__ import annotations

from ambid.arrays import Array


def errors_ahead(e: Array, A: Array, K: Array, C: Array, steps: int) -> Array:
    """Return the prediction errors `steps` samples ahead.

    `e`: (n_samples, n_outputs), innovations; `A`: (n, n); `K`: (n, n_outputs); `C`: (n_outputs, n); `steps`: at least
    1. Returns (n_samples - steps + 1, n_outputs), row k is the error at sample k + steps - 1, predicted from outputs
    before sample k.
    """
    n, out, power = e.shape[0], e[steps - 1 :].copy(), K
    for j in range(1, steps):
        out += e[steps - 1 - j : n - j] @ (C @ power).T
        power = A @ power
    return out


def covariance_ahead(innovation: Array, A: Array, K: Array, C: Array, steps: int) -> Array:
    """Return the covariance that the model gives its own errors `steps` samples ahead.

    `innovation`: (n_outputs, n_outputs), covariance of the innovations; `A`: (n, n); `K`: (n, n_outputs); `C`:
    (n_outputs, n); `steps`: at least 1. Returns (n_outputs, n_outputs).
    """
    total, power = innovation.copy(), K
    for _ in range(1, steps):
        h = C @ power
        total += h @ innovation @ h.T
        power = A @ power
    return total
