"""Compiled loops over samples: free run of a radial basis network with its slopes, and its two recursive trainings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Table = NDArray[np.int64]

_FAR = 1e6  # times the typical size of a signal: a recursion that is beyond has diverged
_NONE = 1e-300  # as in units.py


@compiled(error_model="numpy")
def _units(x: Array, C: Array, s: Array, unit: int, phi: Array, by_q: Array, q: Array) -> None:
    """Write value, slope by the squared distance, and squared distance of every unit."""
    for k in range(s.size):
        r = 0.0
        for j in range(x.size):
            r += (x[j] - C[k, j]) ** 2
        r *= np.exp(-2.0 * s[k])
        q[k] = r
        if unit == 0:
            phi[k] = np.exp(-0.5 * r)
            by_q[k] = -0.5 * phi[k]
        elif unit == 1:
            phi[k] = 1.0 / np.sqrt(1.0 + r)
            by_q[k] = -0.5 * phi[k] ** 3
        elif r > _NONE:
            phi[k] = 0.5 * r * np.log(r)
            by_q[k] = 0.5 * (np.log(r) + 1.0)
        else:
            phi[k], by_q[k] = 0.0, 0.0


@compiled(error_model="numpy")
def run_rbf(
    L: Array, c: Array, W: Array, C: Array, s: Array, M: Array, unit: int, column: Table, back: Table, lag: int,
    z: Array,
) -> None:  # fmt: skip
    """Run freely: z (n_samples, p + m) holds outputs, then inputs; outputs from `lag` on are written.

    Regressor d is column `column[d]` of z, `back[d]` samples ago. NaN from a divergence on.
    """
    N, p, h, D, Q = z.shape[0], c.size, s.size, column.size, M.shape[0]
    r, x, phi, by_q, q = np.zeros(D), np.zeros(Q), np.zeros(h), np.zeros(h), np.zeros(h)
    for t in range(lag, N):
        for d in range(D):
            r[d] = z[t - back[d], column[d]]
        for j in range(Q):
            x[j] = 0.0
            for d in range(D):
                x[j] += M[j, d] * r[d]
        _units(x, C, s, unit, phi, by_q, q)
        for o in range(p):
            f = c[o]
            for d in range(D):
                f += L[o, d] * r[d]
            for k in range(h):
                f += W[o, k] * phi[k]
            z[t, o] = f
        for o in range(p):
            if not abs(z[t, o]) < _FAR:
                z[t:, :p] = np.nan
                return


@compiled(error_model="numpy")
def slope_rbf(
    L: Array, c: Array, W: Array, C: Array, s: Array, M: Array, unit: int, linear: int, column: Table, back: Table,
    lag: int, z: Array, out: Array,
) -> None:  # fmt: skip
    """Write the slopes of a free run, out (n_samples, p, P), by the first P numbers; z as `run_rbf` left it."""
    N, p, h, D, Q, P = z.shape[0], c.size, s.size, column.size, M.shape[0], out.shape[2]
    r, x, phi, by_q, q = np.zeros(D), np.zeros(Q), np.zeros(h), np.zeros(h), np.zeros(h)
    J, G = np.zeros((p, D)), np.zeros((p, Q))
    out[:lag] = 0.0
    for t in range(lag, N):
        for d in range(D):
            r[d] = z[t - back[d], column[d]]
        for j in range(Q):
            x[j] = 0.0
            for d in range(D):
                x[j] += M[j, d] * r[d]
        _units(x, C, s, unit, phi, by_q, q)
        for o in range(p):
            _gradient(o, r, x, W, C, s, phi, by_q, q, p, linear, out[t, o])
            for j in range(Q):
                G[o, j] = 0.0
                for k in range(h):
                    G[o, j] += W[o, k] * by_q[k] * 2.0 * (x[j] - C[k, j]) * np.exp(-2.0 * s[k])
            for d in range(D):
                J[o, d] = L[o, d]
                for j in range(Q):
                    J[o, d] += G[o, j] * M[j, d]
        for d in range(D):
            if column[d] < p:
                for o in range(p):
                    w = J[o, d]
                    for i in range(P):
                        out[t, o, i] += w * out[t - back[d], column[d], i]


@compiled(error_model="numpy")
def _gradient(
    o: int, r: Array, x: Array, W: Array, C: Array, s: Array, phi: Array, by_q: Array, q: Array, p: int, linear: int,
    g: Array,
) -> None:  # fmt: skip
    """Write the slope of output o by the first numbers of theta: all weights, and centres and widths if g is longer."""
    D, Q, h = r.size, x.size, s.size
    for i in range(g.size):
        g[i] = 0.0
    c0 = p * D if linear == 1 else 0
    if linear == 1:
        for d in range(D):
            g[o * D + d] = r[d]
    g[c0 + o] = 1.0
    for k in range(h):
        g[c0 + p + o * h + k] = phi[k]
    b = c0 + p + p * h
    if g.size > b:
        for k in range(h):
            w = -2.0 * W[o, k] * by_q[k]
            e = np.exp(-2.0 * s[k])
            for j in range(Q):
                g[b + k * Q + j] = w * (x[j] - C[k, j]) * e
            g[b + h * Q + k] = w * q[k]


@compiled(error_model="numpy")
def _predicted(
    o: int, r: Array, x: Array, theta: Array, W: Array, C: Array, s: Array, unit: int, linear: int, p: int, phi: Array,
    by_q: Array, q: Array,
) -> float:  # fmt: skip
    D, h = r.size, s.size
    c0 = p * D if linear == 1 else 0
    _units(x, C, s, unit, phi, by_q, q)
    f = float(theta[c0 + o])
    if linear == 1:
        for d in range(D):
            f += theta[o * D + d] * r[d]
    for k in range(h):
        f += W[o, k] * phi[k]
    return f


@compiled(error_model="numpy")
def recursive_pass(
    Z: Array, X: Array, Y: Array, weight: Array, gain: Array, bounded: int, unit: int, linear: int, h: int,
    mean: Array, precision: Array, turn: int, theta: Array, S: Array,
) -> int:  # fmt: skip
    """One run of recursive Gauss-Newton over the samples; theta and S (P, P), S'S = R, are changed in place.

    Every sample comes with one row of the prior, precision (mean - theta), in turn from `turn` on; there are none where
    `precision` is empty. Returns the sample at which it diverged, or -1.
    """
    N, p, D, Q, P = Z.shape[0], Y.shape[1], Z.shape[1], X.shape[1], S.shape[0]
    a = (p * D if linear == 1 else 0) + p
    W, C = theta[a : a + p * h].reshape(p, h), theta[a + p * h : a + p * h + h * Q].reshape(h, Q)
    s = theta[a + p * h + h * Q :]
    phi, by_q, q, g, row, b = np.zeros(h), np.zeros(h), np.zeros(h), np.zeros(P), np.zeros(P), np.zeros(P)
    for t in range(N):
        mu, root = gain[t], np.sqrt(gain[t])
        if bounded == 1:
            _shrink(S, np.sqrt(1.0 - mu))
        for o in range(p):
            e = weight[o] * (Y[t, o] - _predicted(o, Z[t], X[t], theta, W, C, s, unit, linear, p, phi, by_q, q))
            _gradient(o, Z[t], X[t], W, C, s, phi, by_q, q, p, linear, g)
            for i in range(P):
                row[i] = root * weight[o] * g[i]
            if bounded == 1:
                _rotate(S, row, root * e, b)
            else:
                for i in range(P):
                    b[i] = root * e * row[i]
                _forward(S, b)
            _back(S, b)
            for i in range(P):
                theta[i] += b[i]
                if not abs(theta[i]) < 1e12:
                    return t
            if bounded == 0:
                if o == 0:
                    _shrink(S, np.sqrt(1.0 - mu))
                _rotate(S, row, 0.0, b)
        if precision.size > 0:
            k = (turn + t) % P
            for i in range(P):
                row[i] = 0.0
            row[k] = root * precision[k]
            _rotate(S, row, root * precision[k] * (mean[k] - theta[k]), b)
            _back(S, b)
            for i in range(P):
                theta[i] += b[i]
    return -1


@compiled(error_model="numpy")
def _shrink(S: Array, by: float) -> None:
    for i in range(S.shape[0]):
        for j in range(i, S.shape[0]):
            S[i, j] *= by


@compiled(error_model="numpy")
def _rotate(S: Array, row: Array, right: float, b: Array) -> None:
    """Rotate [row | right] into the triangle [S | 0] (Givens), which leaves [S | b]; the row is spent."""
    P = S.shape[0]
    for i in range(P):
        b[i] = 0.0
        if row[i] != 0.0:
            r = np.hypot(S[i, i], row[i])
            c, d = S[i, i] / r, row[i] / r
            S[i, i] = r
            for j in range(i + 1, P):
                w = S[i, j]
                S[i, j] = c * w + d * row[j]
                row[j] = c * row[j] - d * w
            b[i] = d * right
            right *= c


@compiled(error_model="numpy")
def _forward(S: Array, b: Array) -> None:
    """Write S'^-1 b over b."""
    for i in range(S.shape[0]):
        b[i] /= S[i, i]
        if b[i] != 0.0:
            for j in range(i + 1, S.shape[0]):
                b[j] -= S[i, j] * b[i]


@compiled(error_model="numpy")
def _back(S: Array, b: Array) -> None:
    """Write S^-1 b over b."""
    P = S.shape[0]
    for i in range(P - 1, -1, -1):
        w = b[i]
        for j in range(i + 1, P):
            w -= S[i, j] * b[j]
        b[i] = w / S[i, i]


@compiled(error_model="numpy")
def descent_pass(
    Z: Array, X: Array, Y: Array, rate: float, bounded: int, unit: int, linear: int, h: int, n_active: int,
    theta: Array,
) -> int:  # fmt: skip
    """One run of steepest descent over the samples; theta is changed in place. Returns where it diverged, or -1."""
    N, p, D, Q = Z.shape[0], Y.shape[1], Z.shape[1], X.shape[1]
    a = (p * D if linear == 1 else 0) + p
    W, C = theta[a : a + p * h].reshape(p, h), theta[a + p * h : a + p * h + h * Q].reshape(h, Q)
    s = theta[a + p * h + h * Q :]
    phi, by_q, q = np.zeros(h), np.zeros(h), np.zeros(h)
    g, step = np.zeros(n_active), np.zeros(n_active)
    for t in range(N):
        for i in range(n_active):
            step[i] = 0.0
        size = 0.0
        for o in range(p):
            e = Y[t, o] - _predicted(o, Z[t], X[t], theta, W, C, s, unit, linear, p, phi, by_q, q)
            _gradient(o, Z[t], X[t], W, C, s, phi, by_q, q, p, linear, g)
            for i in range(n_active):
                size += g[i] * g[i]
                step[i] += g[i] * e
        eta = rate
        if bounded == 1 and size > 0.0:
            eta = min(rate, 1.0 / size)
        for i in range(n_active):
            theta[i] += eta * step[i]
            if not abs(theta[i]) < 1e12:
                return t
    return -1
