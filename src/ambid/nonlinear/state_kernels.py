"""Compiled recursions of state-space networks in scaled signals: predictor and free run with exact sensitivities.

e = y - x[heads], x+ = A x + B u + K e + G W2 f(W1 [x; u] + b1); the last column of u is 1 and does not enter the hidden
layer. Anchored units have f(a) = tanh(a) - tanh(b) - (1 - tanh(b)^2)(a - b): no value and no slope at the operating
point. A sensor without sign adds a last state, z+ = rho z + (1 - rho) m, with m the mean of |x1| over the sampling
interval, x1 being straight in it; rho < 0 says that there is no such sensor.
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
def run_states(
    A: Array, B: Array, K: Array, heads: Table, G: Array, W1: Array, b1: Array, W2: Array, anchored: int, rho: float,
    u: Array, y: Array, x0: Array, X: Array, E: Array,
) -> None:  # fmt: skip
    """Write predicted states X (n_samples + 1, n or n + 1), innovations E (n_samples, p); NaN from a divergence on."""
    N, m, n, p, h, q = u.shape[0], u.shape[1], A.shape[0], heads.size, W1.shape[0], G.shape[1]
    sensor, f = x0.size > n, np.zeros(q)
    X[0] = x0
    for t in range(N):
        for i in range(p):
            E[t, i] = y[t, i] - X[t, heads[i]]
        for i in range(n):
            if not abs(X[t, i]) < _FAR:
                X[t:] = np.nan
                E[t:] = np.nan
                return
        f[:] = 0.0
        for k in range(h):
            a = 0.0
            for i in range(n):
                a += W1[k, i] * X[t, i]
            for j in range(m - 1):
                a += W1[k, n + j] * u[t, j]
            phi = np.tanh(a + b1[k])
            if anchored == 1:
                tb = np.tanh(b1[k])
                phi -= tb + (1.0 - tb * tb) * a
            for j in range(q):
                f[j] += W2[j, k] * phi
        for i in range(n):
            s = 0.0
            for j in range(n):
                s += A[i, j] * X[t, j]
            for j in range(m):
                s += B[i, j] * u[t, j]
            for j in range(p):
                s += K[i, j] * E[t, j]
            for j in range(q):
                s += G[i, j] * f[j]
            X[t + 1, i] = s
        if sensor:
            X[t + 1, n] = rho * X[t, n] + (1.0 - rho) * mean_magnitude(X[t, 0], X[t + 1, 0])


@compiled(error_model="numpy")
def slope_states(
    A: Array, K: Array, heads: Table, G: Array, W1: Array, b1: Array, W2: Array, anchored: int, rho: float,
    D: Array, used: Table, u: Array, X: Array, E: Array, s: Array, out: Array,
) -> None:  # fmt: skip
    """Write the slopes of the predictions, out (n_samples, p, P); s (n or n + 1, P): of the state, first to last.

    Columns: directions D (n, n + m + p + q, P1) of [A | B | K | G], the last of them that of rho where there is a
    sensor, W1 row by row, b1 (not with a sensor), W2 row by row; any more are passed on with s. `used`
    (n, n + m + p + q) is 0 where no direction changes an entry.
    """
    N, m, n, p, h, q = u.shape[0], u.shape[1], A.shape[0], heads.size, W1.shape[0], G.shape[1]
    P1, P, nz, sensor = D.shape[2], s.shape[1], n + m - 1, X.shape[1] > n
    c_b = P1 + h * nz
    c_W2 = c_b if sensor else c_b + h
    F, new = np.empty((n, n)), np.zeros((X.shape[1], P))
    phi, by_a, by_b, f = np.zeros(h), np.zeros(h), np.zeros(h), np.zeros(q)
    v = np.zeros(n + m + p + q)
    for t in range(N):
        for i in range(p):
            for c in range(P):
                out[t, i, c] = s[heads[i], c]
        f[:] = 0.0
        for i in range(n):
            for j in range(n):
                F[i, j] = A[i, j]
            if not sensor:
                for j in range(p):
                    F[i, heads[j]] -= K[i, j]
        for k in range(h):
            a = 0.0
            for i in range(n):
                a += W1[k, i] * X[t, i]
            for j in range(m - 1):
                a += W1[k, n + j] * u[t, j]
            th = np.tanh(a + b1[k])
            phi[k], by_a[k], by_b[k] = th, 1.0 - th * th, 1.0 - th * th
            if anchored == 1:
                tb = np.tanh(b1[k])
                db = 1.0 - tb * tb
                phi[k] -= tb + db * a
                by_a[k] -= db
                by_b[k] += 2.0 * tb * db * a - db
            for j in range(q):
                f[j] += W2[j, k] * phi[k]
            for i in range(n):
                g = 0.0
                for j in range(q):
                    g += G[i, j] * W2[j, k]
                for j in range(n):
                    F[i, j] += g * by_a[k] * W1[k, j]
        for j in range(n):
            v[j] = X[t, j]
        for j in range(m):
            v[n + j] = u[t, j]
        for j in range(p):
            v[n + m + j] = E[t, j]
        for j in range(q):
            v[n + m + p + j] = f[j]
        for i in range(n):
            for c in range(P):
                new[i, c] = 0.0
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
            for k in range(h):
                g = 0.0
                for j in range(q):
                    g += G[i, j] * W2[j, k]
                    new[i, c_W2 + j * h + k] += G[i, j] * phi[k]
                for j in range(n):
                    new[i, P1 + k * nz + j] += g * by_a[k] * X[t, j]
                for j in range(m - 1):
                    new[i, P1 + k * nz + n + j] += g * by_a[k] * u[t, j]
                if not sensor:
                    new[i, c_b + k] += g * by_b[k]
        if sensor:
            a, b = X[t, 0], X[t + 1, 0]
            mean = mean_magnitude(a, b)
            by_a0, by_b0 = 0.5 * np.sign(a), 0.5 * np.sign(b)
            if a * b < 0.0:
                by_a0 = (a - mean * np.sign(a)) / (abs(a) + abs(b))
                by_b0 = (b - mean * np.sign(b)) / (abs(a) + abs(b))
            for c in range(P):
                new[n, c] = rho * s[n, c] + (1.0 - rho) * (by_a0 * s[0, c] + by_b0 * new[0, c])
            new[n, P1 - 1] += X[t, n] - mean
        for i in range(X.shape[1]):
            for c in range(P):
                s[i, c] = new[i, c]
