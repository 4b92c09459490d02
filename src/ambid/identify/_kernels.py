"""Compiled loops of the innovations-form predictor and its exact sensitivities.

One step of the predictor is x+ = F x + G z; its derivative by estimated number q is s_q+ = F s_q + f_q, with forcing f_q linear in
x and z (one matrix product for a whole block). Only the recursions themselves are compiled.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True, fastmath={"contract"})
def innovations_block(M: Array, C: Array, y: Array, w: Array, x: Array, e: Array) -> None:
    """Run the predictor over one block.

    `w` (block, n + n_z) holds z in its last columns and gets the state before each step in its first n; `e` (block, n_y) gets
    the innovations y - C x; `x` (n,) moves along in place. M = [F G] is (n, n + n_z).
    """
    n, n_l, n_y = M.shape[0], M.shape[1], y.shape[1]
    new = np.empty(n)
    for k in range(y.shape[0]):
        for i in range(n):
            w[k, i] = x[i]
        for o in range(n_y):
            acc = y[k, o]
            for i in range(n):
                acc -= C[o, i] * x[i]
            e[k, o] = acc
        for i in range(n):
            acc = 0.0
            for j in range(n_l):
                acc += M[i, j] * w[k, j]
            new[i] = acc
        for i in range(n):
            x[i] = new[i]


@njit(cache=True, nogil=True, fastmath={"contract"})
def sensitivity_scan(F: Array, s: Array) -> None:
    """Turn forcing into sensitivities in place.

    `s` (block + 1, n, p) holds the sensitivities at the first sample in s[0] and the forcing of sample k in s[k + 1]; on return
    s[k + 1] = F s[k] + forcing. Three states, the one-axis plant, are spelled out: they stay in registers.
    """
    n, p = s.shape[1], s.shape[2]
    if n == 3:
        f00, f01, f02 = F[0, 0], F[0, 1], F[0, 2]
        f10, f11, f12 = F[1, 0], F[1, 1], F[1, 2]
        f20, f21, f22 = F[2, 0], F[2, 1], F[2, 2]
        for k in range(1, s.shape[0]):
            for q in range(p):
                a, b, c = s[k - 1, 0, q], s[k - 1, 1, q], s[k - 1, 2, q]
                s[k, 0, q] += f00 * a + f01 * b + f02 * c
                s[k, 1, q] += f10 * a + f11 * b + f12 * c
                s[k, 2, q] += f20 * a + f21 * b + f22 * c
        return
    for k in range(1, s.shape[0]):
        for i in range(n):
            for j in range(n):
                f = F[i, j]
                for q in range(p):
                    s[k, i, q] += f * s[k - 1, j, q]
