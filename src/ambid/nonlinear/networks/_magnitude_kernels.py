"""Compiled recursions of a state-space network whose output is measured without sign, with exact sensitivities.

x1 is what the sensor sees. x_i+ = x_i + step x_(i+1) + .., the last x+ = a' x + .., all + B u + W2 tanh(W1 [x; u]);
z+ = rho z + (1 - rho) m is the sensor, m the mean of |x1| over the sampling interval, x1 being straight in it.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled

_FAR = 1e6  # times the typical size of a signal: a recursion that is beyond has diverged


@compiled(error_model="numpy")
def run_magnitude(a: Array, B: Array, rho: float, W1: Array, W2: Array, step: float, u: Array, X: Array) -> None:
    """Write the states X (n_samples + 1, n + 1), z last, from X[0] on; NaN from a divergence on."""
    n, m, h = a.size, u.shape[1], W1.shape[0]
    for t in range(u.shape[0]):
        for i in range(n):
            s = X[t, i] + step * X[t, i + 1] if i < n - 1 else 0.0
            for j in range(m):
                s += B[i, j] * u[t, j]
            X[t + 1, i] = s
        for j in range(n):
            X[t + 1, n - 1] += a[j] * X[t, j]
        for k in range(h):
            q = 0.0
            for j in range(n):
                q += W1[k, j] * X[t, j]
            for j in range(m):
                q += W1[k, n + j] * u[t, j]
            q = np.tanh(q)
            for i in range(n):
                X[t + 1, i] += W2[i, k] * q
        p, c = X[t, 0], X[t + 1, 0]
        size = abs(p) + abs(c)
        mean = 0.5 * size
        if p * c < 0.0:
            mean = 0.5 * (p * p + c * c) / size
        X[t + 1, n] = rho * X[t, n] + (1.0 - rho) * mean
        for i in range(n + 1):
            if not abs(X[t + 1, i]) < _FAR:
                X[t + 1 :] = np.nan
                return


@compiled(error_model="numpy")
def slope_magnitude(
    a: Array, rho: float, W1: Array, W2: Array, step: float, u: Array, X: Array, s: Array, out: Array
) -> None:
    """Write the slopes of z, out (n_samples, P); s (n + 1, P): slopes of the state, first to last.

    Columns: a, B row by row, rho, W1 row by row, W2 row by row; any more are passed on with s.
    """
    n, m, h, P = a.size, u.shape[1], W1.shape[0], s.shape[1]
    cB, cR = n, n + n * m
    c1 = cR + 1
    c2 = c1 + h * (n + m)
    new, F, th = np.zeros((n + 1, P)), np.zeros((n, n)), np.zeros(h)
    for t in range(u.shape[0]):
        for c in range(P):
            out[t, c] = s[n, c]
        F[:] = 0.0
        for i in range(n - 1):
            F[i, i] = 1.0
            F[i, i + 1] = step
        for j in range(n):
            F[n - 1, j] = a[j]
        for k in range(h):
            q = 0.0
            for j in range(n):
                q += W1[k, j] * X[t, j]
            for j in range(m):
                q += W1[k, n + j] * u[t, j]
            th[k] = np.tanh(q)
            for i in range(n):
                for j in range(n):
                    F[i, j] += W2[i, k] * (1.0 - th[k] * th[k]) * W1[k, j]
        for i in range(n):
            for c in range(P):
                new[i, c] = 0.0
            for j in range(n):
                w = F[i, j]
                if w != 0.0:
                    for c in range(P):
                        new[i, c] += w * s[j, c]
            for j in range(m):
                new[i, cB + i * m + j] += u[t, j]
            for k in range(h):
                new[i, c2 + i * h + k] += th[k]
                g = W2[i, k] * (1.0 - th[k] * th[k])
                for j in range(n):
                    new[i, c1 + k * (n + m) + j] += g * X[t, j]
                for j in range(m):
                    new[i, c1 + k * (n + m) + n + j] += g * u[t, j]
        for j in range(n):
            new[n - 1, j] += X[t, j]
        p, q = X[t, 0], X[t + 1, 0]
        size = abs(p) + abs(q)
        mean, by_p, by_q = 0.5 * size, 0.5 * np.sign(p), 0.5 * np.sign(q)
        if p * q < 0.0:
            mean = 0.5 * (p * p + q * q) / size
            by_p = (p - mean * np.sign(p)) / size
            by_q = (q - mean * np.sign(q)) / size
        for c in range(P):
            new[n, c] = rho * s[n, c] + (1.0 - rho) * (by_p * s[0, c] + by_q * new[0, c])
        new[n, cR] += X[t, n] - mean
        for i in range(n + 1):
            for c in range(P):
                s[i, c] = new[i, c]
