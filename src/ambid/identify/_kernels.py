"""Compiled recursions of the innovations-form predictor and its exact sensitivities.

One step of the predictor is x+ = F x + G z; its derivative by estimated number q is s_q+ = F s_q + f_q, with a forcing
f_q that is linear in x and z. Drive and forcing of a whole block are matrix products; only the recursion itself is
compiled.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True, fastmath={"contract"})
def state_scan(F: Array, x: Array) -> None:
    """Turn a drive into states in place.

    `x` (block + 1, n) holds the first state in x[0] and the drive of sample k in x[k + 1]; on return x[k + 1] = F x[k]
    + drive. Three states, the one-axis plant, are spelled out: they stay in registers.
    """
    n = x.shape[1]
    if n == 3:
        f00, f01, f02 = F[0, 0], F[0, 1], F[0, 2]
        f10, f11, f12 = F[1, 0], F[1, 1], F[1, 2]
        f20, f21, f22 = F[2, 0], F[2, 1], F[2, 2]
        a, b, c = x[0, 0], x[0, 1], x[0, 2]
        for k in range(1, x.shape[0]):
            p = (x[k, 0] + f00 * a) + (f01 * b + f02 * c)
            q = (x[k, 1] + f10 * a) + (f11 * b + f12 * c)
            r = (x[k, 2] + f20 * a) + (f21 * b + f22 * c)
            x[k, 0], x[k, 1], x[k, 2] = p, q, r
            a, b, c = p, q, r
        return
    for k in range(1, x.shape[0]):
        for i in range(n):
            acc = x[k, i]
            for j in range(n):
                acc += F[i, j] * x[k - 1, j]
            x[k, i] = acc


@njit(cache=True, nogil=True, fastmath={"contract"})
def sensitivity_scan(F: Array, s: Array) -> None:
    """Turn forcings into sensitivities in place, many at once.

    `s` (block + 1, n, p) holds the sensitivities at the first sample in s[0] and the forcing of sample k in s[k + 1];
    on return s[k + 1] = F s[k] + forcing. Estimated numbers run along the last axis, so that vector instructions serve
    them.
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
