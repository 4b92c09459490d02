"""Compiled loops of lagged models: a run sample by sample, and what earlier samples pass on to later ones; descent of
the weights of radial units; functions of a scheduling signal, and the free run whose own set point it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Table = NDArray[np.int64]

_FAR = 1e6  # times the typical size of a signal: a recursion that is beyond has diverged


@compiled(error_model="numpy")
def propagate(out: Array, gain: Array, source: Table, back: Table, first: int) -> None:
    """Add to each row of `out` (first + n, p, k) from `first` on what earlier rows pass on to it.

    out[t, o] += sum over d of gain[t - first, o, d] out[t - back[d], source[d]]; rows before the array are zero. One
    row of `gain` stands for all.
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
    """Run a sum of blocks over z (n, outputs + inputs + innovations) from sample `lag` on.

    `shape` = (lag, n_outputs, first column of the innovations, free, folded). A block that is not there has arrays of
    length zero. A row of `terms` names regressors, -1 behind the last; `place` its output, and 1 for a denominator.
    Predicts from measured outputs and writes innovations into z, or with `free` its own outputs. `out` (n, n_outputs)
    is NaN where nothing is computed, and from a divergence on. With `folded` the sign of the output is not measured: it
    gets that of the prediction, and `out` is its magnitude.
    """
    lag, p, n_e, free, folded = shape[0], shape[1], shape[2], shape[3], shape[4]
    n, D, h, Q = z.shape[0], column.size, b1.size, M.shape[0]
    x, f, num, den = np.zeros(D), np.zeros(p), np.zeros(p), np.ones(p)
    seen = np.zeros(Q)
    innovations = z.shape[1] > n_e
    recursive = free == 1
    for d in range(D):
        recursive = recursive or column[d] >= n_e
    out[:] = np.nan
    for t in range(lag, n):
        for d in range(D):
            x[d] = z[t - back[d], column[d]]
        num[:] = 0.0
        den[:] = 1.0
        for k in range(place.shape[0]):
            v = theta[k]
            for j in range(terms.shape[1]):
                if terms[k, j] < 0:
                    break
                v *= x[terms[k, j]]
            if place[k, 1] == 1:
                den[place[k, 0]] += v
            else:
                num[place[k, 0]] += v
        for o in range(p):
            f[o] = num[o] / den[o]
        for i in range(h):
            v = b1[i]
            for d in range(W1.shape[1]):
                v += W1[i, d] * x[d]
            v = np.tanh(v)
            for o in range(p):
                f[o] += W2[o, i] * v
        if s.size > 0:
            for j in range(Q):
                seen[j] = 0.0
                for d in range(D):
                    seen[j] += M[j, d] * x[d]
            for k in range(s.size):
                v = 0.0
                for j in range(Q):
                    v += (seen[j] - C[k, j]) ** 2
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
            if folded == 1:
                out[t, o] = abs(f[o])
            if free == 1:
                z[t, o] = f[o]
            else:
                if folded > 0:
                    z[t, o] = np.copysign(z[t, o], f[o])
                if innovations:
                    z[t, n_e + o] = z[t, o] - f[o]


@compiled(error_model="numpy")
def descent_pass(F: Array, Y: Array, rate: float, W: Array) -> None:
    """Take one step W <- W + eta e f' for each row f of F (n, d); W (p, d) changes.

    eta is `rate`, or one over the squared slope of all errors where that is less, with which none of them grows.
    """
    (n, d), p = F.shape, Y.shape[1]
    e = np.zeros(p)
    for t in range(n):
        size = 0.0
        for j in range(d):
            size += p * F[t, j] * F[t, j]
        eta = min(rate, 1.0 / size) if size > 0.0 else rate
        for o in range(p):
            e[o] = Y[t, o]
            for j in range(d):
                e[o] -= W[o, j] * F[t, j]
        for o in range(p):
            for j in range(d):
                W[o, j] += eta * e[o] * F[t, j]


@compiled(error_model="numpy")
def scheduled_run(
    y: Array, W: Array, s: Array, first: int, a: Array, b: Array, share: float, middle: float, half: float,
) -> None:  # fmt: skip
    """Write the free run into y from sample `first` on; NaN from a divergence on.

    y(t) = -a(p(t)) y(t-k) + b(p(t)) W(t), with a (na, K) and b (n_w, K) by Legendre polynomial of p, which
    is s or, with `share` > 0, the set point of the run itself: (level - middle) / half.
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
