"""Noise of an estimate by instrumental variables: an autoregressive model of what is left, and what it does to sums.

Solves: given residuals e, find H in e = H w with w white, and Cov(Z' e) for instruments Z that e did not make.
The model is autoregressive by Burg's recursion (Burg 1967): stable by construction, all orders at once, no normal
equations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Autoregression:
    """Noise e with D(q) e = w, w white."""

    D: Array  # (order + 1,), monic, all roots inside the unit circle
    variance: float  # of w

    @property
    def order(self) -> int:
        """Number of coefficients."""
        return self.D.size - 1


def autoregression(residual: Array, highest: int) -> Autoregression:
    """Model a residual as an autoregression, its order by Akaike's criterion with the small-sample term.

    `residual`: (n_samples,).
    """
    n = residual.size
    forward, backward = residual.copy(), residual.copy()
    d, power = np.ones(1), float(residual @ residual) / n
    best, lowest = Autoregression(D=d, variance=power), n * np.log(power + 1e-300)
    for order in range(1, min(highest, n // 4) + 1):
        f, b = forward[1:], backward[:-1]
        size = float(f @ f + b @ b)
        if size <= 0 or power <= 0:
            break
        k = -2.0 * float(f @ b) / size
        forward, backward = f + k * b, b + k * f
        d = np.append(d, 0.0) + k * np.append(d, 0.0)[::-1]
        power *= 1 - k * k
        criterion = n * np.log(power + 1e-300) + 2 * order * n / max(n - order - 1, 1)
        if criterion < lowest:
            best, lowest = Autoregression(D=d, variance=power), criterion
    return best


def score_covariance(instruments: Array, noise: Autoregression) -> Array:
    """Return Cov(Z' e) = variance * (H* Z)' (H* Z), H* running backwards in time (Ljung 1999, eq. 9.83).

    `instruments`: (n_samples, n_instruments), Z, independent of the noise; `noise`: H = 1/D of e. Returns
    (n_instruments, n_instruments).
    """
    from scipy.signal import lfilter

    shaped = instruments if not noise.order else lfilter([1.0], noise.D, instruments[::-1], axis=0)
    return np.asarray(noise.variance * (shaped.T @ shaped), dtype=np.float64)


def noise_covariance(noise: Autoregression, n_samples: int) -> Array:
    """Return the covariance of the coefficients of D, leading one included (Ljung 1999, eq. 9.62).

    Returns (order + 1, order + 1).
    """
    p = noise.order
    out = np.zeros((p + 1, p + 1))
    if not p:
        return out
    a, b = np.zeros((p, p)), np.zeros((p, p))  # Gohberg-Semencul: inverse of the autocovariance matrix of 1/D
    for i in range(p):
        a[i, : i + 1] = noise.D[i::-1]
        b[i, : i + 1] = noise.D[p - i :]
    out[1:, 1:] = (a @ a.T - b @ b.T) / n_samples
    return out
