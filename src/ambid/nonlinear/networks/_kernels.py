"""Compiled recursions of networks in scaled signals: predictor and free run with their exact sensitivities.

State-space network: e = y - x[heads], x+ = A x + B u + K e + G W2 f(W1 [x; u] + b1); the last column of u is 1 and does
not enter the hidden layer. Anchored units have f(a) = tanh(a) - tanh(b) - (1 - tanh(b)^2)(a - b): no value and no slope
at the operating point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Table = NDArray[np.int64]

_FAR = 1e6  # times the typical size of a signal: a recursion that is beyond has diverged


@compiled(error_model="numpy")
def run_states(
    A: Array, B: Array, K: Array, heads: Table, G: Array, W1: Array, b1: Array, W2: Array, anchored: int,
    u: Array, y: Array, x0: Array, X: Array, E: Array,
) -> None:  # fmt: skip
    """Write predicted states X (n_samples + 1, n) and innovations E (n_samples, p); NaN from a divergence on."""
    N, m, n, p, h, q = u.shape[0], u.shape[1], x0.size, heads.size, W1.shape[0], G.shape[1]
    f = np.zeros(q)
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


@compiled(error_model="numpy")
def slope_states(
    A: Array, K: Array, heads: Table, G: Array, W1: Array, b1: Array, W2: Array, anchored: int,
    D: Array, used: Table, u: Array, X: Array, E: Array, s: Array, out: Array,
) -> None:  # fmt: skip
    """Write the slopes of the predictions, out (n_samples, p, P); s (n, P): slopes of the state, first to last.

    Columns: directions D (n, n + m + p + q, P1) of [A | B | K | G], W1 row by row, b1,
    W2 row by row; any more are passed on with s. `used` (n, n + m + p + q) is 0 where no direction changes an entry.
    """
    N, m, n, p, h, q = u.shape[0], u.shape[1], X.shape[1], heads.size, W1.shape[0], G.shape[1]
    P1, P, nz = D.shape[2], s.shape[1], X.shape[1] + u.shape[1] - 1
    F, new = np.empty((n, n)), np.zeros((n, P))
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
                    new[i, P1 + h * (nz + 1) + j * h + k] += G[i, j] * phi[k]
                for j in range(n):
                    new[i, P1 + k * nz + j] += g * by_a[k] * X[t, j]
                for j in range(m - 1):
                    new[i, P1 + k * nz + n + j] += g * by_a[k] * u[t, j]
                new[i, P1 + h * nz + k] += g * by_b[k]
        for i in range(n):
            for c in range(P):
                s[i, c] = new[i, c]


@compiled(error_model="numpy")
def run_narx(
    L: Array, c: Array, W2: Array, W1: Array, b1: Array, column: Table, back: Table, lag: int, z: Array
) -> None:
    """Run a NARX network freely: z (n_samples, p + m) holds outputs, then inputs; outputs from `lag` on are written.

    Regressor d is column `column[d]` of z, `back[d]` samples ago. NaN from a divergence on.
    """
    N, p, h, D = z.shape[0], L.shape[0], W1.shape[0], column.size
    x = np.zeros(D)
    for t in range(lag, N):
        for d in range(D):
            x[d] = z[t - back[d], column[d]]
        for o in range(p):
            s = c[o]
            for d in range(D):
                s += L[o, d] * x[d]
            z[t, o] = s
        for k in range(h):
            a = b1[k]
            for d in range(D):
                a += W1[k, d] * x[d]
            a = np.tanh(a)
            for o in range(p):
                z[t, o] += W2[o, k] * a
        for o in range(p):
            if not abs(z[t, o]) < _FAR:
                z[t:, :p] = np.nan
                return


@compiled(error_model="numpy")
def slope_narx(
    L: Array, W2: Array, W1: Array, b1: Array, column: Table, back: Table, lag: int, z: Array, out: Array
) -> None:
    """Write the slopes of a free run, out (n_samples, p, P); z as `run_narx` left it.

    Columns: L row by row, c, W2 row by row, W1 row by row, b1.
    """
    N, p, h, D, P = z.shape[0], L.shape[0], W1.shape[0], column.size, out.shape[2]
    x, T, J = np.zeros(D), np.zeros(h), np.zeros((p, D))
    c0, w2, w1, b0 = p * D, p * D + p, p * D + p + p * h, p * D + p + p * h + h * D
    out[:lag] = 0.0
    for t in range(lag, N):
        for d in range(D):
            x[d] = z[t - back[d], column[d]]
        for o in range(p):
            for d in range(D):
                J[o, d] = L[o, d]
            for q in range(P):
                out[t, o, q] = 0.0
        for k in range(h):
            a = b1[k]
            for d in range(D):
                a += W1[k, d] * x[d]
            T[k] = np.tanh(a)
        for o in range(p):
            for d in range(D):
                out[t, o, o * D + d] = x[d]
            out[t, o, c0 + o] = 1.0
            for k in range(h):
                g = W2[o, k] * (1.0 - T[k] * T[k])
                out[t, o, w2 + o * h + k] = T[k]
                out[t, o, b0 + k] = g
                for d in range(D):
                    out[t, o, w1 + k * D + d] = g * x[d]
                    J[o, d] += g * W1[k, d]
        for d in range(D):
            if column[d] < p:
                for o in range(p):
                    w = J[o, d]
                    for q in range(P):
                        out[t, o, q] += w * out[t - back[d], column[d], q]
