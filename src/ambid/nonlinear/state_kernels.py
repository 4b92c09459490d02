"""Compiled recursions of state-space networks in scaled signals: predictor and free run with exact sensitivities.

e = y - x[heads], x+ = M [x; u; f; e], f = W2 phi(W1 [x; u] + b1); the last column of u is 1 and does not enter the
hidden layer. Units are anchored, phi(a + b) = tanh(a + b) - tanh(b) - (1 - tanh(b)^2) a: no value and no slope at the
operating point. A sensor without sign adds a last state, z+ = rho z + (1 - rho) m, with m the mean of |x1| over the
sampling interval, x1 being straight in it; units behind it are plain ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Table = NDArray[np.int64]

_FAR = 1e6  # times the typical size of a signal: a recursion that is beyond has diverged


@compiled(error_model="numpy")
def mean_magnitude(a: float, b: float) -> float:
    """Return the mean of |x| along a straight line from `a` to `b`."""
    size = abs(a) + abs(b)
    return 0.5 * (a * a + b * b) / size if a * b < 0.0 else 0.5 * size


@compiled(error_model="numpy")
def _fill_step(
    heads: Table, W1: Array, b1: Array, W2: Array, sensor: bool, x: Array, u: Array, e: Array, v: Array, phi: Array,
    by_a: Array, by_b: Array,
) -> None:  # fmt: skip
    """Write v = [x; u; f; e] of one sample, the units' values, and their slopes by a and b."""
    m, p, (q, h) = u.size, heads.size, W2.shape
    n = v.size - m - p - q
    for i in range(n):
        v[i] = x[i]
    for i in range(m):
        v[n + i] = u[i]
    for i in range(p):
        v[n + m + q + i] = e[i]
    v[n + m : n + m + q] = 0.0
    for k in range(h):
        a = 0.0
        for i in range(n + m - 1):
            a += W1[k, i] * v[i]
        th = np.tanh(a + b1[k])
        phi[k], by_a[k], by_b[k] = th, 1.0 - th * th, 1.0 - th * th
        if not sensor:
            tb = np.tanh(b1[k])
            db = 1.0 - tb * tb
            phi[k] -= tb + db * a
            by_a[k] -= db
            by_b[k] += 2.0 * tb * db * a - db
        for j in range(q):
            v[n + m + j] += W2[j, k] * phi[k]


@compiled(error_model="numpy")
def run_states(
    M: Array, heads: Table, W1: Array, b1: Array, W2: Array, rho: float, u: Array, y: Array, X: Array, E: Array,
) -> None:  # fmt: skip
    """Write predicted states X (n_samples + 1, n or n + 1), of which the first is given, and innovations E
    (n_samples, p); NaN from a divergence on.
    """
    N, n, p, sensor = u.shape[0], M.shape[0], heads.size, X.shape[1] > M.shape[0]
    v, units = np.empty(M.shape[1]), np.empty((3, b1.size))
    for t in range(N):
        for i in range(p):
            E[t, i] = y[t, i] - X[t, heads[i]]
        for i in range(n):
            if not abs(X[t, i]) < _FAR:
                X[t:] = np.nan
                E[t:] = np.nan
                return
        _fill_step(heads, W1, b1, W2, sensor, X[t], u[t], E[t], v, units[0], units[1], units[2])
        for i in range(n):
            s = 0.0
            for j in range(v.size):
                s += M[i, j] * v[j]
            X[t + 1, i] = s
        if sensor:
            X[t + 1, n] = rho * X[t, n] + (1.0 - rho) * mean_magnitude(X[t, 0], X[t + 1, 0])


@compiled(error_model="numpy")
def slope_states(
    M: Array, heads: Table, W1: Array, b1: Array, W2: Array, rho: float, D: Array, used: Table, u: Array, X: Array,
    E: Array, s: Array, out: Array,
) -> None:  # fmt: skip
    """Write the slopes of the predictions, out (n_samples, p, P); s (n or n + 1, P): of the state, first to last.

    Columns: directions D (n, n + m + q + p, P1) of M, the last of them that of rho where there is a sensor, W1 row by
    row, b1 (not with a sensor), W2 row by row; any more are passed on with s. `used` (n, n + m + q + p) is 0 where no
    direction changes an entry.
    """
    N, m, n, p, (q, h) = u.shape[0], u.shape[1], M.shape[0], heads.size, W2.shape
    P1, P, nz, sensor = D.shape[2], s.shape[1], n + m - 1, X.shape[1] > n
    c_b, first_f = P1 + h * nz, n + m
    c_W2 = c_b if sensor else c_b + h
    F, new = np.empty((n, n)), np.zeros((X.shape[1], P))
    phi, by_a, by_b, v = np.empty(h), np.empty(h), np.empty(h), np.empty(M.shape[1])
    for t in range(N):
        for i in range(p):
            for c in range(P):
                out[t, i, c] = s[heads[i], c]
        _fill_step(heads, W1, b1, W2, sensor, X[t], u[t], E[t], v, phi, by_a, by_b)
        for i in range(n):
            for j in range(n):
                F[i, j] = M[i, j]
            if not sensor:
                for j in range(p):
                    F[i, heads[j]] -= M[i, n + m + q + j]
            new[i] = 0.0
            for k in range(h):
                g = 0.0
                for j in range(q):
                    g += M[i, first_f + j] * W2[j, k]
                    new[i, c_W2 + j * h + k] = M[i, first_f + j] * phi[k]
                for j in range(n):
                    F[i, j] += g * by_a[k] * W1[k, j]
                for j in range(nz):
                    new[i, P1 + k * nz + j] = g * by_a[k] * v[j]
                if not sensor:
                    new[i, c_b + k] = g * by_b[k]
            for j in range(n):
                w = F[i, j]
                if w != 0.0:
                    for c in range(P):
                        new[i, c] += w * s[j, c]
            for j in range(v.size):
                if used[i, j] == 1:
                    w = v[j]
                    for c in range(P1):
                        new[i, c] += D[i, j, c] * w
        if sensor:
            a, b = X[t, 0], X[t + 1, 0]
            mean = mean_magnitude(a, b)
            by_first, by_last = 0.5 * np.sign(a), 0.5 * np.sign(b)
            if a * b < 0.0:
                by_first = (a - mean * np.sign(a)) / (abs(a) + abs(b))
                by_last = (b - mean * np.sign(b)) / (abs(a) + abs(b))
            for c in range(P):
                new[n, c] = rho * s[n, c] + (1.0 - rho) * (by_first * s[0, c] + by_last * new[0, c])
            new[n, P1 - 1] += X[t, n] - mean
        for i in range(X.shape[1]):
            for c in range(P):
                s[i, c] = new[i, c]
