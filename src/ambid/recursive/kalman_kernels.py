"""Compiled recursions of the filters: one pass over a block, state moved along in place.

A value that is not finite is missing: the filter predicts over it.
"""

from __future__ import annotations

from math import isfinite, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.square_root_kernels import project, propagate, shrink, variance

_SAME = 2e-15  # relative change of a root of a covariance that is rounding


@compiled(fastmath={"contract"})
def hold_scan(y: Array, out: Array, state: Array, constants: Array) -> int:
    """x+ = decay x + forward y, output x before y; over a missing y, x+ = alone x. Returns how many were missing.

    `state` (m,) is NaN where none is given: the first value then gives it.
    """
    decay, forward, alone, first = constants
    missing = 0
    for j in range(y.shape[1]):
        x = state[j]
        begun = isfinite(x)
        for k in range(y.shape[0]):
            v = y[k, j]  # before out, which may be the same array
            seen = isfinite(v)
            if seen and not begun:
                x, begun = first * v, True
            out[k, j] = x
            if seen:
                x = decay * x + forward * v
            else:
                x *= alone
                missing += 1
        state[j] = x
    return missing


@compiled(fastmath={"contract"})
def state_scan(y: Array, u: Array, out: Array, model: Array, memory: Array, work: Array, tally: Array) -> None:
    """Kalman filter over the square-root core: outputs one by one, what their noises have in common taken off first.

    `model`: A, B, C, G with G Gᵀ = Q, and R, one behind the other. `memory`: factors of the covariance, predicted
    state, and what `_correct` keeps. `tally`: whether the covariance has stopped changing, values missing.
    """
    (n_samples, m), n, n_u = y.shape, out.shape[1], u.shape[1]
    A, at = model[: n * n].reshape(n, n), n * n
    B, at = model[at : at + n * n_u].reshape(n, n_u), at + n * n_u
    C, at = model[at : at + m * n].reshape(m, n), at + m * n
    G, R = model[at : at + n * n].reshape(n, n), model[at + n * n :].reshape(m, m)
    F, x = memory[: n * n].reshape(n, n), memory[n * n : n * n + n]
    rest = memory[n * n + n :].reshape(m, 2 * n + m + 2)
    W, w = work[: 2 * n * n].reshape(n, 2 * n), work[2 * n * n : 2 * n * n + 2 * n]
    f, before = work[2 * n * n + 2 * n :][:n], work[2 * n * n + 3 * n :].reshape(n, n)
    J, settled, k = np.empty((n, 0)), tally[0] > 0.0, int(0.0)
    while k < n_samples:
        if settled and n <= 2 and m == 1 and n_u == 0:
            k = _steady(k, y, out, A, C, x, rest)
            if k == n_samples:
                break
        seen = 0
        for i in range(m):
            seen += isfinite(y[k, i])
        tally[1] += m - seen
        steady = settled and seen == m
        _correct(y[k], C, R, F, x, rest, f, steady)
        for i in range(n):
            out[k, i] = x[i]
            f[i] = 0.0
            for j in range(n):
                f[i] += A[i, j] * x[j]
            for j in range(n_u):
                f[i] += B[i, j] * u[k, j]
        for i in range(n):
            x[i] = f[i]
        if not steady:
            propagate(F, A, J, G, W, w)
            settled = seen == m
            for j in range(n):
                settled = settled and abs(F[j, j] - before[j, j]) <= 2.0 * _SAME * F[j, j]
                before[j, j] = F[j, j]
                for i in range(j):
                    change = F[j, i] - before[j, i]
                    settled = settled and F[j, j] * change * change <= _SAME * _SAME * variance(F, i)
                    before[j, i] = F[j, i]
        k += 1
    tally[0] = 1.0 if settled else 0.0


@compiled(fastmath={"contract"})
def _correct(y: Array, C: Array, R: Array, F: Array, x: Array, rest: Array, f: Array, steady: bool) -> None:
    """Take in what was measured, with the gains of before where these are steady.

    A row of `rest` holds one of L with L Lᵀ = R of the measured outputs, one of H = L⁻¹ C, the gain P h and the
    variance of its whitened innovation, and the whitened output.
    """
    (m, n), row, one = C.shape, 0, 1.0
    for i in range(m):
        if not isfinite(y[i]):
            continue
        own = rest[row]
        h, gain = own[m : m + n], own[m + n : m + 2 * n]
        if not steady:
            for c in range(n):
                h[c] = C[i, c]
            before, left = 0, R[i, i]
            for j in range(i):
                if isfinite(y[j]):
                    v = R[i, j]
                    for c in range(before):
                        v -= own[c] * rest[before, c]
                    own[before] = v / rest[before, before]
                    left -= own[before] * own[before]
                    for c in range(n):
                        h[c] -= own[before] * rest[before, m + c]
                    before += 1
            own[row] = sqrt(left)
            for c in range(n):
                h[c] /= own[row]
            project(F, h, f)
            own[m + 2 * n] = shrink(F, f, one, gain)
        v = y[i]
        for c in range(row):
            v -= own[c] * rest[c, m + 2 * n + 1]
        v /= own[row]
        own[m + 2 * n + 1] = v
        for c in range(n):
            v -= h[c] * x[c]
        v /= own[m + 2 * n]
        for c in range(n):
            x[c] += gain[c] * v
        row += 1


@compiled(fastmath={"contract"})
def _steady(k: int, y: Array, out: Array, A: Array, C: Array, x: Array, rest: Array) -> int:
    """One or two states, one output, a constant gain: a linear recursion in registers, up to the first missing value.

    Where there is one state, all that belongs to a second is zero and falls on the first before that is written.
    """
    last = x.size - 1
    two = 1.0 if last > 0 else 0.0
    a00, a01, a10, a11 = A[0, 0], two * A[0, last], two * A[last, 0], two * A[last, last]
    c0, c1, part = C[0, 0], two * C[0, last], 1.0 / (rest[0, 0] * rest[0, 2 * x.size + 1])
    k0, k1 = rest[0, 1 + x.size] * part, two * rest[0, 1 + x.size + last] * part
    l0, l1 = a00 * k0 + a01 * k1, a10 * k0 + a11 * k1
    b00, b01, b10, b11 = a00 - l0 * c0, a01 - l0 * c1, a10 - l1 * c0, a11 - l1 * c1
    p0, p1 = x[0], two * x[last]
    while k < y.shape[0] and isfinite(y[k, 0]):
        v = y[k, 0]
        e = v - (c0 * p0 + c1 * p1)
        out[k, last] = p1 + k1 * e
        out[k, 0] = p0 + k0 * e
        p0, p1 = l0 * v + (b00 * p0 + b01 * p1), l1 * v + (b10 * p0 + b11 * p1)
        k += 1
    x[last] = p1
    x[0] = p0
    return k
