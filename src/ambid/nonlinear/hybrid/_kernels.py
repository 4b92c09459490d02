"""Compiled recursions of a hybrid model in scaled signals: innovations, their sensitivities, free runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Table = NDArray[np.int64]

_FAR = 1e6  # times the typical size of the output: a recursion that is beyond has diverged


@compiled(error_model="numpy")
def innovations(left: Array, a: Array, W2: Array, We: Array, C: Array, E: Array, T: Array) -> None:
    """Write e(t) = left(t) - C v(t) - W2 T(t), T(t) = tanh(a(t) + We v(t)), v(t) = [e(t-1), e(t-2), ..].

    `left` (n, p) is the output less the polynomial, `a` (n, h) what measured signals bring to the units; e is zero
    before the first row. E (n, p) is NaN from a divergence on.
    """
    n, p, h, m, k = left.shape[0], left.shape[1], a.shape[1], C.shape[1], We.shape[1]
    v = np.zeros(max(m, k))
    for t in range(n):
        for j in range(v.size):
            back = 1 + j // p
            v[j] = E[t - back, j % p] if t >= back else 0.0
        for i in range(h):
            s = a[t, i]
            for j in range(k):
                s += We[i, j] * v[j]
            T[t, i] = np.tanh(s)
        for o in range(p):
            s = left[t, o]
            for j in range(m):
                s -= C[o, j] * v[j]
            for i in range(h):
                s -= W2[o, i] * T[t, i]
            if not abs(s) < _FAR:
                for later in range(t, n):
                    for q in range(p):
                        E[later, q] = np.nan
                return
            E[t, o] = s


@compiled(error_model="numpy")
def passed_on(D: Array, first: int, T: Array, W2: Array, We: Array, C: Array) -> None:
    """Turn direct slopes of the predictions D (first + n, p, P) into whole ones: innovations hang on theta as well.

    The first rows hold the slopes before, and stay. T (n, h) belongs to the others.
    """
    p, P, h, m, k = D.shape[1], D.shape[2], W2.shape[1], C.shape[1], We.shape[1]
    for t in range(first, D.shape[0]):
        for o in range(p):
            for j in range(max(m, k)):
                back = 1 + j // p
                g = C[o, j] if j < m else 0.0
                if j < k:
                    for i in range(h):
                        g += W2[o, i] * (1.0 - T[t - first, i] ** 2) * We[i, j]
                if t >= back and g != 0.0:
                    for q in range(P):
                        D[t, o, q] -= g * D[t - back, j % p, q]


@compiled(error_model="numpy")
def free_run(
    column: Table, back: Table, terms: Table, place: Table, theta: Array,
    z_column: Table, z_back: Table, W1: Array, b1: Array, W2: Array, lag: int, z: Array,
) -> None:  # fmt: skip
    """Run freely: z (n, p + m) holds outputs, then inputs; outputs from `lag` on are written, NaN from a divergence on.

    A factor is a column of z and a lag; a term a row of factor numbers, -1 behind the last, that belongs to output
    `place`. Regressor d of the units is column `z_column[d]`, `z_back[d]` samples ago.
    """
    n, p, h, d = z.shape[0], W2.shape[0], W1.shape[0], z_column.size
    out = np.empty(p)
    for t in range(lag, n):
        for o in range(p):
            out[o] = 0.0
        for k in range(terms.shape[0]):
            s = theta[k]
            for j in range(terms.shape[1]):
                f = terms[k, j]
                if f < 0:
                    break
                s *= z[t - back[f], column[f]]
            out[place[k]] += s
        for i in range(h):
            s = b1[i]
            for j in range(d):
                s += W1[i, j] * z[t - z_back[j], z_column[j]]
            s = np.tanh(s)
            for o in range(p):
                out[o] += W2[o, i] * s
        for o in range(p):
            if not abs(out[o]) < _FAR:
                for later in range(t, n):
                    for q in range(p):
                        z[later, q] = np.nan
                return
        for o in range(p):
            z[t, o] = out[o]
