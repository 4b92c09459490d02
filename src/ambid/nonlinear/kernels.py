"""Compiled loops of lagged models and of state-space networks, on scaled signals.

Lagged models: a run, what earlier samples pass on, a free run whose own set point schedules it. Networks, with exact
sensitivities: e = y - x[heads], x+ = M [x; u; f; e], f = W2 phi(W1 [x; u] + b1), u's last column 1 outside the hidden
layer; units are anchored, phi(a + b) = tanh(a + b) - tanh(b) - (1 - tanh(b)^2) a: no value or slope at the operating
point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Table = NDArray[np.int64]

_FAR = 1e6  # times the typical size of a signal: a recursion that is beyond has diverged


@compiled(error_model="numpy")
def propagate(out: Array, gain: Array, source: Table, back: Table, first: int) -> None:
    """Add to each row of `out` (first + n, p, k) from `first` on: out[t, o] += sum over d of gain[t - first, o, d]
    out[t - back[d], source[d]]; rows before the array are zero, one row of `gain` stands for all.
    """
    last, p, k = gain.shape[0] - 1, out.shape[1], out.shape[2]
    for t in range(first, out.shape[0]):
        now = min(t - first, last)
        for d in range(source.size):
            before = t - back[d]
            if before < 0:
                continue
            for o in range(p):
                w = gain[now, o, d]
                if w != 0.0:
                    for q in range(k):
                        out[t, o, q] += w * out[before, source[d], q]


@compiled(error_model="numpy")
def run(
    z: Array, column: Table, back: Table, shape: Table, out: Array,
    terms: Table, place: Table, theta: Array, W2: Array, W1: Array, b1: Array,
    W: Array, M: Array, C: Array, s: Array,
) -> None:  # fmt: skip
    """Run a sum of blocks over z (n, outputs + inputs + innovations) from sample `lag` on: predict and write
    innovations into z, or if `free` own outputs; `out` (n, n_outputs) is NaN elsewhere, and from a divergence on.
    `shape` = (lag, n_outputs, first innovations column, free); absent blocks have length zero. `terms`: regressors,
    -1 behind the last; `place`: output.
    """
    lag, p, n_e, free = shape[0], shape[1], shape[2], shape[3]
    n, D, h, Q = z.shape[0], column.size, b1.size, M.shape[0]
    x, f = np.zeros(D), np.zeros(p)
    projected = np.zeros(Q)
    innovations = z.shape[1] > n_e
    recursive = free == 1
    for d in range(D):
        recursive = recursive or column[d] >= n_e
    out[:] = np.nan
    for t in range(lag, n):
        for d in range(D):
            x[d] = z[t - back[d], column[d]]
        f[:] = 0.0
        for k in range(place.shape[0]):
            v = theta[k]
            for j in range(terms.shape[1]):
                if terms[k, j] < 0:
                    break
                v *= x[terms[k, j]]
            f[place[k]] += v
        for i in range(h):
            v = b1[i]
            for d in range(W1.shape[1]):
                v += W1[i, d] * x[d]
            v = np.tanh(v)
            for o in range(p):
                f[o] += W2[o, i] * v
        if s.size > 0:
            for j in range(Q):
                projected[j] = 0.0
                for d in range(D):
                    projected[j] += M[j, d] * x[d]
            for k in range(s.size):
                v = 0.0
                for j in range(Q):
                    v += (projected[j] - C[k, j]) ** 2
                v = np.exp(-0.5 * v * np.exp(-2.0 * s[k]))
                for o in range(p):
                    f[o] += W[o, k] * v
        for o in range(p):
            if recursive and not abs(f[o]) < _FAR:
                out[t:] = np.nan
                if free == 1:
                    z[t:, :p] = np.nan
                return
        for o in range(p):
            out[t, o] = f[o]
            if free == 1:
                z[t, o] = f[o]
            elif innovations:
                z[t, n_e + o] = z[t, o] - f[o]


@compiled(error_model="numpy")
def scheduled_run(
    y: Array, W: Array, s: Array, first: int, a: Array, b: Array, share: float, middle: float, half: float,
) -> None:  # fmt: skip
    """Write the free run y(t) = -a(p(t)) y(t-k) + b(p(t)) W(t) into y from `first` on, NaN from a divergence on; a (na,
    K) and b (n_w, K) by Legendre polynomial of p: s, or with `share` > 0 the run's own set point, (level - middle) /
    half.
    """
    level = 0.0
    for t in range(y.size):
        if t >= first:
            at = (level - middle) / half if share > 0.0 else s[t]
            x, phi, before = 0.0, 1.0, 0.0
            for j in range(b.shape[1]):
                p = 0.0
                for k in range(a.shape[0]):
                    p -= a[k, j] * y[t - 1 - k]
                for i in range(b.shape[0]):
                    p += b[i, j] * W[t, i]
                x += p * phi
                phi, before = ((2 * j + 1) * at * phi - j * before) / (j + 1), phi
            if not abs(x) < _FAR:
                y[t:] = np.nan
                return
            y[t] = x
        level += max(share, 1.0 / (t + 1)) * (y[t] - level)


@compiled(error_model="numpy")
def _fill_step(
    heads: Table, W1: Array, b1: Array, W2: Array, x: Array, u: Array, e: Array, v: Array, phi: Array, by_a: Array,
    by_b: Array,
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
        tb = np.tanh(b1[k])
        db = 1.0 - tb * tb
        phi[k] -= tb + db * a
        by_a[k] -= db
        by_b[k] += 2.0 * tb * db * a - db
        for j in range(q):
            v[n + m + j] += W2[j, k] * phi[k]


@compiled(error_model="numpy")
def run_states(
    M: Array, heads: Table, W1: Array, b1: Array, W2: Array, u: Array, y: Array, X: Array, E: Array,
) -> None:  # fmt: skip
    """Write predicted states X (n_samples + 1, n), of which the first is given, and innovations E
    (n_samples, p); NaN from a divergence on.
    """
    N, n, p = u.shape[0], M.shape[0], heads.size
    v, units = np.empty(M.shape[1]), np.empty((3, b1.size))
    for t in range(N):
        for i in range(p):
            E[t, i] = y[t, i] - X[t, heads[i]]
        for i in range(n):
            if not abs(X[t, i]) < _FAR:
                X[t:] = np.nan
                E[t:] = np.nan
                return
        _fill_step(heads, W1, b1, W2, X[t], u[t], E[t], v, units[0], units[1], units[2])
        for i in range(n):
            s = 0.0
            for j in range(v.size):
                s += M[i, j] * v[j]
            X[t + 1, i] = s


@compiled(error_model="numpy")
def slope_states(
    M: Array, heads: Table, W1: Array, b1: Array, W2: Array, D: Array, changed: Table, u: Array, X: Array, E: Array,
    s: Array, out: Array,
) -> None:  # fmt: skip
    """Write the predictions' slopes, out (n_samples, p, P); s (n, P): the state's, first to last. Columns:
    directions D (n, n + m + q + p, P1) of M, W1 row by row, b1, W2,
    others passed on with s; `changed` (n, n + m + q + p) is 0 where no direction changes an entry.
    """
    N, m, n, p, (q, h) = u.shape[0], u.shape[1], M.shape[0], heads.size, W2.shape
    P1, P, nz = D.shape[2], s.shape[1], n + m - 1
    c_b, first_f = P1 + h * nz, n + m
    c_W2 = c_b + h
    F, new = np.empty((n, n)), np.zeros((n, P))
    phi, by_a, by_b, v = np.empty(h), np.empty(h), np.empty(h), np.empty(M.shape[1])
    for t in range(N):
        for i in range(p):
            for c in range(P):
                out[t, i, c] = s[heads[i], c]
        _fill_step(heads, W1, b1, W2, X[t], u[t], E[t], v, phi, by_a, by_b)
        for i in range(n):
            for j in range(n):
                F[i, j] = M[i, j]
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
                new[i, c_b + k] = g * by_b[k]
            for j in range(n):
                w = F[i, j]
                if w != 0.0:
                    for c in range(P):
                        new[i, c] += w * s[j, c]
            for j in range(v.size):
                if changed[i, j] == 1:
                    w = v[j]
                    for c in range(P1):
                        new[i, c] += D[i, j, c] * w
        for i in range(n):
            for c in range(P):
                s[i, c] = new[i, c]
