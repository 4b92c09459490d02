"""Compiled recursions of a NARX network in scaled signals: free run with its exact sensitivities."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Table = NDArray[np.int64]

_FAR = 1e6  # times the typical size of a signal: a recursion that is beyond has diverged


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
