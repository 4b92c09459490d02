"""Compiled recursions of the Kalman filters over the square-root core, one pass over a block; over a missing (not
finite) value the filter predicts. Joint filters have z = [x, o, q], q scaled, o and q carried on; sensor noise is one.
"""

from __future__ import annotations

from math import isfinite, sqrt

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.square_root_kernels import project, propagate, shrink, size, variance, widen

Ints = NDArray[np.int64]

_SAME = 2e-15  # relative change of a root of a covariance that is rounding

# places in `counts`
K, USED, REJECTED, PARTIAL, FILLED, FRESH, DUE, MISSED = range(8)
_ABSURD, _HUGE = 1e3, 1e200  # standard deviations of an innovation beyond which it is no measurement
_FORGET = 1.0 / 1024.0  # weight of a sample in the running level of the innovations
_BLIND = 32  # samples without any output after which the state is taken for lost


@compiled(fastmath={"contract"})
def state_scan(y: Array, u: Array, out: Array, model: Array, memory: Array, work: Array, tally: Array) -> None:
    """Run a Kalman filter output by output, what their noises share taken off first. `model`: A, B, C, G with G Gᵀ = Q,
    and R; `memory`: factors of the covariance, predicted state, what `_correct` keeps; `tally`: whether the covariance
    stands still, values missing.
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
    """Take in what was measured, with the gains of before where steady. A row of `rest` holds one of L with L Lᵀ = R of
    the measured outputs, of H = L⁻¹ C, gain P h, variance of the whitened innovation, whitened output.
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
    """Run one or two states, one output, a constant gain in registers up to the first missing value. Of one state, all
    that belongs to a second is zero and falls on the first before that is written.
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


@compiled
def _walk(F: Array, walk: Array, a: Array) -> None:
    """Let parameters and offsets walk at random, each only while its standard deviation is under its limit."""
    for j in range(walk.shape[1]):
        if walk[0, j] > 0.0 and variance(F, j) < walk[1, j] * walk[1, j]:
            for i in range(j):
                a[i] = 0.0
            a[j] = 1.0
            widen(F, a[: j + 1], walk[0, j] * walk[0, j])


@compiled
def _take(
    u: Array, y: Array, e: Array, z: Array, F: Array, C: Array, io: Array, wide: Array, past: Array, counts: Ints,
    f: Array, b: Array, move: Array,
) -> bool:  # fmt: skip
    """Take in one sample, scaled innovations into `e` (NaN: missing), inputs into `past`; return whether to make a
    step. `io` holds a running mean of squared innovations over what is expected.
    """
    (n_y, n_x), n_u, one = C.shape, u.size, 1.0
    missing = 0
    for o in range(n_y):
        e[o] = (y[o] - io[0, n_u + o]) / io[1, n_u + o]
        if not np.isfinite(e[o]):
            e[o], missing = np.nan, missing + 1
    for i in range(n_u):
        if not np.isfinite(u[i]):
            counts[REJECTED] += 1
            counts[FILLED], counts[FRESH] = 0, 1
            for o in range(n_y):
                e[o] = np.nan
            return False
    for row in range(past.shape[0] - 1, 0, -1):
        for i in range(n_u):
            past[row, i] = past[row - 1, i]
    for i in range(n_u):
        past[0, i] = (u[i] - io[0, i]) / io[1, i]
    counts[FILLED] = min(counts[FILLED] + 1, past.shape[0])
    if counts[FILLED] < past.shape[0]:
        counts[USED if missing < n_y else REJECTED] += 1
        for o in range(n_y):
            e[o] = np.nan
        return False
    if missing == n_y:
        counts[REJECTED] += 1
        counts[MISSED] += 1
        if counts[MISSED] >= _BLIND:
            counts[FRESH] = 1
        return bool(counts[FRESH] == 0)
    fresh, counts[MISSED] = counts[FRESH] == 1, 0
    if fresh:  # forget the plant's state, and what it had to do with the parameters
        for i in range(n_x):
            z[i] = 0.0
            for j in range(z.size):
                F[j, i] = 0.0
            F[i, i] = wide[i] * wide[i]
        counts[FRESH] = 0
    for o in range(n_y):
        for i in range(n_x):
            e[o] -= C[o, i] * z[i]
        move[o] = e[o]
    taken = 0
    for o in range(n_y):  # outputs one by one, each innovation less what those before have moved of x
        if not np.isfinite(e[o]):
            continue
        for j in range(z.size):
            f[j] = C[o, j] if j < n_x else 0.0
            for i in range(min(j, n_x)):
                f[j] += F[j, i] * C[o, i]
        alpha, left = one + size(F, f), move[o]
        if not left * left <= _ABSURD * _ABSURD * alpha < _HUGE:
            e[o] = np.nan
            continue
        io[2, n_u + o] += (left * left / alpha - io[2, n_u + o]) * _FORGET
        gain = left / shrink(F, f, one, b)
        for i in range(z.size):
            z[i] += gain * b[i]
        for later in range(o + 1, n_y):
            for i in range(n_x):
                move[later] -= C[later, i] * (gain * b[i])
        taken += 1
    counts[USED if taken else REJECTED] += 1
    counts[PARTIAL] += 0 < taken < n_y
    if taken == 0:  # an innovation that no noise can make: the state is lost
        counts[FILLED], counts[FRESH] = 0, 1
    if fresh:
        for o in range(n_y):
            e[o] = np.nan
    return taken > 0


@compiled
def ekf_block(
    first: int, u: Array, y: Array, e: Array, z: Array, F: Array, at: Array, M: Array, dM: Array, C: Array, dist: Array,
    walk: Array, io: Array, wide: Array, past: Array, counts: Ints, every: int, amount: float,
) -> int:  # fmt: skip
    """Run the extended filter from sample `first` on; return before which sample the matrices are to be renewed: x+ =
    M(q) [x; u; u late; o], M(q) = M + sum dM_j (q_j - at_j).
    """
    n, p, (n_x, columns) = z.size, dM.shape[0], M.shape
    s, n_u, n_y, n_d = n - p, u.shape[1], y.shape[1], dist.size
    f, b, v, now = np.empty(n), np.empty(n), np.empty(columns), np.empty((n_x, columns))
    J, G = np.empty((n_x, n - n_x)), np.empty((n_x, n_d))
    W, w, move = np.empty((n_x, n_x + n_d)), np.empty(n_x + n_d), np.empty(n_y)
    for k in range(first, u.shape[0]):
        counts[K] += 1
        if _take(u[k], y[k], e[k], z, F, C, io, wide, past, counts, f, b, move):
            for i in range(n_x):
                v[i] = z[i]
                for c in range(columns):
                    now[i, c] = M[i, c]
            for i in range(n_u):
                v[n_x + i] = past[past.shape[0] - 2, i]
                v[n_x + n_u + i] = past[past.shape[0] - 1, i]
            for i in range(n_d):
                v[n_x + 2 * n_u + i] = z[n_x + i]
            for j in range(p):
                moved = z[s + j] - at[j]
                for i in range(n_x):
                    acc = 0.0
                    for c in range(columns):
                        slope = dM[j, i, c]
                        now[i, c] += slope * moved
                        acc += slope * v[c]
                    J[i, n_d + j] = acc
            for i in range(n_x):
                acc = 0.0
                for c in range(columns):
                    acc += now[i, c] * v[c]
                z[i] = acc
                for j in range(n_d):
                    J[i, j] = now[i, columns - n_d + j]
                    G[i, j] = J[i, j] * dist[j]
            propagate(F, now, J, G, W, w)
        for i in range(n_y):
            e[k, i] *= io[1, n_u + i]
        if counts[K] % every == 0:
            _walk(F, walk, f)
            for j in range(p):
                if abs(z[s + j] - at[j]) > amount:
                    counts[DUE] = 1
            if counts[DUE] == 1:
                return k + 1
    return int(u.shape[0])


@compiled
def _fill(q: Array, logs: Ints, place: Ints, scale: Array, power: Ints, D: Array, t: Array) -> None:
    """Evaluate the continuous-time matrices [A, B, E] T at scaled parameters: entries are products of powers."""
    for j in range(logs.size):
        t[j] = np.exp(q[j]) if logs[j] else q[j]
    for i in range(scale.size):
        acc = scale[i]
        for j in range(logs.size):
            for _ in range(abs(power[i, j])):
                acc = acc * t[j] if power[i, j] > 0 else acc / t[j]
        D[place[i, 0], place[i, 1]] = acc


@compiled
def _move(D: Array, x: Array, u: Array, late: Array, o: Array, fraction: float, terms: int, t: Array) -> None:
    """Move x in place over a sample: exp([[A, B, E], [0, 0, 0]] T) applied by its Taylor series."""
    n_x, n_u = x.size, u.size
    for part in range(2):
        h = fraction if part == 0 else 1.0 - fraction
        if h == 0.0:
            continue
        for i in range(n_x):
            acc = 0.0
            for c in range(n_x):
                acc += D[i, c] * x[c]
            for c in range(n_u):
                acc += D[i, n_x + c] * (late[c] if part == 0 else u[c])
            for c in range(o.size):
                acc += D[i, n_x + n_u + c] * o[c]
            t[i] = acc * h
        for i in range(n_x):
            x[i] += t[i]
        for order in range(2, terms + 1):
            for i in range(n_x):
                acc = 0.0
                for c in range(n_x):
                    acc += D[i, c] * t[c]
                t[n_x + i] = acc * (h / order)
            for i in range(n_x):
                t[i] = t[n_x + i]
                x[i] += t[i]


@compiled
def ukf_block(
    u: Array, y: Array, e: Array, z: Array, F: Array, logs: Ints, place: Ints, scale: Array, power: Ints, C: Array,
    dist: Array, walk: Array, io: Array, wide: Array, past: Array, counts: Ints, every: int, terms: int,
    fraction: float,
) -> None:  # fmt: skip
    """Run the unscented filter with points at √n standard deviations, the central one without weight in the mean, and 2
    in the covariance, as a Gaussian needs.
    """
    n, p, n_x, n_d, n_u, n_y = z.size, logs.size, C.shape[1], dist.size, u.shape[1], y.shape[1]
    s = n_x + n_d
    gamma, weight = np.sqrt(float(n)), 0.5 / n
    f, b, t, zero, point = np.empty(n), np.empty(n), np.empty(2 * n_x + p), np.zeros(n_u), np.empty(n)
    up, still, x, o, q = np.empty(n_x), np.empty(n_x), point[:n_x], point[n_x:s], point[s:]
    D, ends, move = np.zeros((n_x, n_x + n_u + n_d)), np.empty((2 * n_x, p)), np.empty(n_y)
    A, J, G = np.empty((n_x, n_x)), np.empty((n_x, n_d)), np.empty((n_x, n_d + p + 1))
    W, w = np.empty((n_x, s + p + 1)), np.empty(s + p + 1)
    # points of the linear columns lie about the moved centre: all share its distance from the mean
    others = 2.0 * weight * (n - p)
    for k in range(u.shape[0]):
        counts[K] += 1
        if _take(u[k], y[k], e[k], z, F, C, io, wide, past, counts, f, b, move):
            now, late = past[past.shape[0] - 2], past[past.shape[0] - 1]
            # the central point, and the matrices there: the step is linear in states, offsets and disturbances
            for i in range(n):
                point[i] = z[i]
            _fill(q, logs, place, scale, power, D, t)
            _move(D, x, now, late, o, fraction, terms, t)
            for i in range(n_x):
                up[i] = x[i]
                still[i] = others * up[i]
            for j in range(s):
                for i in range(s):
                    point[i] = 1.0 if i == j else 0.0
                _move(D, x, zero, zero, o, fraction, terms, t)
                for i in range(n_x):
                    if j < n_x:
                        A[i, j] = x[i]
                    else:
                        J[i, j - n_x] = x[i]
            # points along the parameters' columns, two by two
            for j in range(p):
                away = gamma * np.sqrt(F[s + j, s + j])
                for side in range(2):
                    to = away if side == 0 else -away
                    for i in range(n):
                        point[i] = z[i] + (to * F[s + j, i] if i < s + j else to if i == s + j else 0.0)
                    _fill(q, logs, place, scale, power, D, t)
                    _move(D, x, now, late, o, fraction, terms, t)
                    for i in range(n_x):
                        ends[side * n_x + i, j] = x[i]
                        still[i] += weight * x[i]
            for i in range(n_x):
                for j in range(n_d):
                    G[i, j] = J[i, j] * dist[j]
                for j in range(p):
                    G[i, n_d + j] = np.sqrt(0.5 * weight) * (ends[i, j] + ends[n_x + i, j] - 2.0 * still[i])
                G[i, n_d + p] = np.sqrt(2.0 + others) * (up[i] - still[i])
                z[i] = still[i]
            propagate(F, A, J, G, W, w)
            for j in range(p):
                for i in range(n_x):
                    F[s + j, i] = (ends[i, j] - ends[n_x + i, j]) / (2.0 * gamma * np.sqrt(F[s + j, s + j]))
        for i in range(n_y):
            e[k, i] *= io[1, n_u + i]
        if counts[K] % every == 0:
            _walk(F, walk, f)
