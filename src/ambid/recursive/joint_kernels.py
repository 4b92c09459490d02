"""Compiled loops of the joint filters over the square-root core: measurement and time updates, sample by sample.

The augmented state is z = [x, o, q]: plant states, offsets, scaled parameters. Parameters and offsets stand last: they
are carried on unchanged, so that a time update touches the leading states alone. Sensor noise is one in scaled units.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.square_root_kernels import propagate, shrink, size, variance, widen

Ints = NDArray[np.int64]

# places in `counts`
K, USED, REJECTED, PARTIAL, FILLED, FRESH, DUE, MISSED = range(8)
_ABSURD, _HUGE = 1e3, 1e200  # standard deviations of an innovation beyond which it is no measurement
_FORGET = 1.0 / 1024.0  # weight of a sample in the running level of the innovations
_BLIND = 32  # samples without any output after which the state is taken for lost


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
    """Take in one sample; leave scaled innovations in `e`, inputs in `past`; return whether there is a step to make.

    A missing output is NaN in `e`; `io` holds a running mean of the squared innovations over what is expected of them.
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
    """Run the extended filter from sample `first` on; return before which sample the matrices are to be renewed.

    x+ = M(q) [x; u; u late; o], M(q) = M + sum dM_j (q_j - at_j).
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
    """Run the unscented filter with points at √n standard deviations.

    The central one has no weight in the mean, and 2 in the covariance, as a Gaussian needs.
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
