"""Compiled recursions of the innovations-form predictor, x+ = F x + G z, and its exact sensitivities s_q+ = F s_q +
f_q, forcing f_q linear in x and z. Drive and forcing of a block are matrix products; only recursions are compiled.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled


@compiled(fastmath={"contract"})
def state_scan(M: Array, w: Array, x: Array) -> None:
    """Run the predictor over one block: `w` (block, n + n_z) holds z in its last columns and gets the state before each
    sample in its first n; `x` (n,) moves along in place; M = [F G]. Three states, the one-axis plant, stay in
    registers.
    """
    n, n_l = M.shape
    if n == 3:
        f00, f01, f02 = M[0, 0], M[0, 1], M[0, 2]
        f10, f11, f12 = M[1, 0], M[1, 1], M[1, 2]
        f20, f21, f22 = M[2, 0], M[2, 1], M[2, 2]
        a, b, c = x[0], x[1], x[2]
        for k in range(w.shape[0]):
            d, e, f = 0.0, 0.0, 0.0
            for j in range(3, n_l):
                v = w[k, j]
                d += M[0, j] * v
                e += M[1, j] * v
                f += M[2, j] * v
            w[k, 0], w[k, 1], w[k, 2] = a, b, c
            p = (d + f00 * a) + (f01 * b + f02 * c)
            q = (e + f10 * a) + (f11 * b + f12 * c)
            r = (f + f20 * a) + (f21 * b + f22 * c)
            a, b, c = p, q, r
        x[0], x[1], x[2] = a, b, c
        return
    new = np.empty(n)
    for k in range(w.shape[0]):
        for i in range(n):
            w[k, i] = x[i]
        for i in range(n):
            acc = 0.0
            for j in range(n_l):
                acc += M[i, j] * w[k, j]
            new[i] = acc
        for i in range(n):
            x[i] = new[i]


@compiled(fastmath={"contract"})
def sensitivity_scan(F: Array, w: Array, y: Array, s: Array, rows: Array, last: int) -> None:
    """Turn forcings into sensitivities in place, and put the residual beside them.

    `s` (n, width) holds the sensitivities at the first sample and moves along. `rows` (n, block, width) holds the
    forcing, s[k + 1] = F s[k] + rows[:, k], and gets s[k] of the outputs, the first states; its column `last` gets y[k,
    o] + w[k, o]. Estimated numbers run along the last axis, for vector instructions: results go where their forcing
    was.
    """
    (n, width), n_y = s.shape, y.shape[1]
    if n == 3 and n_y == 2:
        f00, f01, f02 = F[0, 0], F[0, 1], F[0, 2]
        f10, f11, f12 = F[1, 0], F[1, 1], F[1, 2]
        f20, f21, f22 = F[2, 0], F[2, 1], F[2, 2]
        s0, s1, s2 = s[0], s[1], s[2]
        r0, r1, r2 = rows[0], rows[1], rows[2]
        for k in range(y.shape[0]):
            for q in range(width):
                a, b, c = s0[q], s1[q], s2[q]
                d, e, f = r0[k, q], r1[k, q], r2[k, q]
                r0[k, q], r1[k, q] = a, b
                s0[q] = d + f00 * a + f01 * b + f02 * c
                s1[q] = e + f10 * a + f11 * b + f12 * c
                s2[q] = f + f20 * a + f21 * b + f22 * c
            r0[k, last], r1[k, last] = y[k, 0] + w[k, 0], y[k, 1] + w[k, 1]
        return
    new = np.empty((n, width))
    for k in range(y.shape[0]):
        for i in range(n):
            for q in range(width):
                new[i, q] = rows[i, k, q]
            for j in range(n):
                f = F[i, j]
                for q in range(width):
                    new[i, q] += f * s[j, q]
        for o in range(n_y):
            for q in range(width):
                rows[o, k, q] = s[o, q]
            rows[o, k, last] = y[k, o] + w[k, o]
        for i in range(n):
            for q in range(width):
                s[i, q] = new[i, q]


@compiled
def play(x: Array, width: float) -> Array:
    """Return what follows x (n,) through a slack of a width."""
    out, at = np.empty_like(x), x[0]
    for k in range(x.size):
        at = min(max(at, x[k] - 0.5 * width), x[k] + 0.5 * width)
        out[k] = at
    return out
