"""Compiled loops over samples: the two recursive trainings of a radial basis network."""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.nonlinear.lagged_kernels import radial_units


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
    radial_units(x, C, s, unit, phi, by_q, q)
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
