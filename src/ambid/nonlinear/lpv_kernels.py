"""Compiled loops of LPV models in scaled signals: functions of p, and the free run whose own set point is p."""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled

_FAR = 1e6  # times the typical size of the output: a recursion that is beyond has diverged


@compiled(error_model="numpy")
def basis_at(s: float, hats: int, out: Array) -> None:
    """Basis functions at s, -1 to 1 in training: Legendre polynomials, or hats (linear beyond the last knots)."""
    n = out.size
    out[0] = 1.0
    if n == 1:
        return
    if hats == 0:
        out[1] = s
        for k in range(2, n):
            out[k] = ((2 * k - 1) * s * out[k - 1] - (k - 1) * out[k - 2]) / k
        return
    out[:] = 0.0
    at = 0.5 * (s + 1.0) * (n - 1)
    first = 0 if not at > 0.0 else min(int(min(at, 1e6)), n - 2)
    out[first + 1] = at - first
    out[first] = 1.0 - out[first + 1]


@compiled(error_model="numpy")
def basis_rows(s: Array, hats: int, out: Array) -> None:
    """Basis functions at each of s."""
    for t in range(s.size):
        basis_at(s[t], hats, out[t])


@compiled(error_model="numpy")
def free_run(
    y: Array, W: Array, s: Array, hats: int, first: int, a: Array, b: Array, share: float, middle: float, half: float,
) -> None:  # fmt: skip
    """Write the free run into y from sample `first` on; NaN from a divergence on.

    y(t) = -a(p(t)) y(t-k) + b(p(t)) W(t), with a (na, K) and b (n_w, K) by function of p. p is s or, with `share` > 0,
    the set point of the run itself: (level - middle) / half.
    """
    phi, level = np.empty(b.shape[1]), 0.0
    for t in range(y.size):
        if t >= first:
            basis_at((level - middle) / half if share > 0.0 else s[t], hats, phi)
            x = 0.0
            for j in range(phi.size):
                p = 0.0
                for k in range(a.shape[0]):
                    p -= a[k, j] * y[t - 1 - k]
                for i in range(b.shape[0]):
                    p += b[i, j] * W[t, i]
                x += p * phi[j]
            if not abs(x) < _FAR:
                y[t:] = np.nan
                return
            y[t] = x
        level += max(share, 1.0 / (t + 1)) * (y[t] - level)
