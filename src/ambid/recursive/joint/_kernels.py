"""Compiled loops of the joint filters: square-root measurement and time updates, sample by sample.

The augmented state is z = [q, o, x]: scaled parameters, offsets, plant states. Its covariance is S S^T with S lower
triangular; `T` holds S transposed, so that a column of S lies together in memory. Parameters and offsets stand first:
they are carried on unchanged, so that a time update touches the rows of x only and leaves S triangular but for its
last block. Sensor noise is one in scaled units.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.joint._square_root import carry, rank_one, rank_one_down, shrink, triangle

Ints = NDArray[np.int64]

# places in `counts`
K, USED, REJECTED, PARTIAL, FILLED, FRESH, DUE, REFUSED, MISSED = range(9)
_ABSURD, _HUGE = 1e3, 1e200  # standard deviations of an innovation beyond which it is no measurement
_FORGET = 1.0 / 1024.0  # weight of a sample in the running level of the innovations
_BLIND = 32  # samples without any output after which the state is taken for lost


@compiled
def _measure(z: Array, T: Array, C: Array, e: Array, level: Array, f: Array, b: Array) -> int:
    """Take in outputs one by one, `e` their innovations (NaN: missing), `level` a running mean; return how many."""
    n, taken, (n_y, n_x) = z.size, 0, C.shape
    s = n - n_x
    for o in range(n_y):
        if not np.isfinite(e[o]):
            continue
        left = e[o]
        for i in range(n_x):
            left -= C[o, i] * f[n + i]  # what the outputs before have moved of x
        alpha = 1.0
        for j in range(n):
            acc = 0.0
            for i in range(n_x):
                acc += T[j, s + i] * C[o, i]
            f[j] = acc
            alpha += acc * acc
        if not left * left <= _ABSURD * _ABSURD * alpha < _HUGE:
            e[o] = np.nan
            continue
        level[o] += (left * left / alpha - level[o]) * _FORGET
        shrink(T, f[:n], 1.0, b)
        gain = left / alpha
        for i in range(n):
            z[i] += gain * b[i]
        for i in range(n_x):
            f[n + i] += gain * b[s + i]
        taken += 1
    return taken


@compiled
def _spread(T: Array, walk: Array, w: Array) -> None:
    """Let parameters and offsets walk at random, each only while its standard deviation is under its limit."""
    for j in range(walk.shape[1]):
        if walk[0, j] > 0.0:
            variance = 0.0
            for i in range(j + 1):
                variance += T[i, j] * T[i, j]
            if variance < walk[1, j] * walk[1, j]:
                for i in range(w.size):
                    w[i] = 0.0
                w[j] = walk[0, j]
                rank_one(T, w, j)


@compiled
def _restart(z: Array, T: Array, wide: Array) -> None:
    """Forget the plant's state, and what it had to do with the parameters."""
    n, n_x = z.size, wide.size
    s = n - n_x
    for i in range(s, n):
        z[i] = 0.0
        for j in range(n):
            T[j, i] = 0.0
        T[i, i] = wide[i - s]


@compiled
def _blank(e: Array) -> None:
    for o in range(e.size):
        e[o] = np.nan


@compiled
def _take(
    u: Array, y: Array, e: Array, z: Array, T: Array, C: Array, io: Array, wide: Array, past: Array, counts: Ints,
    f: Array, b: Array,
) -> bool:  # fmt: skip
    """Take in one sample; leave scaled innovations in `e`, inputs in `past`; return whether there is a step to make."""
    n, (n_y, n_x) = z.size, C.shape
    s, n_u = n - n_x, u.size
    missing = 0
    for o in range(n_y):
        e[o] = (y[o] - io[0, n_u + o]) / io[1, n_u + o]
        if not np.isfinite(e[o]):
            e[o], missing = np.nan, missing + 1
    for i in range(n_u):
        if not np.isfinite(u[i]):
            counts[REJECTED] += 1
            counts[FILLED], counts[FRESH] = 0, 1
            _blank(e)
            return False
    for row in range(past.shape[0] - 1, 0, -1):
        for i in range(n_u):
            past[row, i] = past[row - 1, i]
    for i in range(n_u):
        past[0, i] = (u[i] - io[0, i]) / io[1, i]
    counts[FILLED] = min(counts[FILLED] + 1, past.shape[0])
    if counts[FILLED] < past.shape[0]:
        counts[USED if missing < n_y else REJECTED] += 1
        _blank(e)
        return False
    if missing == n_y:
        counts[REJECTED] += 1
        counts[MISSED] += 1
        if counts[MISSED] >= _BLIND:
            counts[FRESH] = 1
        return bool(counts[FRESH] == 0)
    fresh, counts[MISSED] = counts[FRESH] == 1, 0
    if fresh:
        _restart(z, T, wide)
        counts[FRESH] = 0
    for o in range(n_y):
        for i in range(n_x):
            e[o] -= C[o, i] * z[s + i]
    for i in range(n, n + n_x):
        f[i] = 0.0
    taken = _measure(z, T, C, e, io[2, n_u:], f, b)
    counts[USED if taken else REJECTED] += 1
    counts[PARTIAL] += 0 < taken < n_y
    if taken == 0:  # an innovation that no noise can make: the state is lost
        counts[FILLED], counts[FRESH] = 0, 1
    if fresh:
        _blank(e)
    return bool(taken > 0)


@compiled
def ekf_block(
    first: int, u: Array, y: Array, e: Array, z: Array, T: Array, at: Array, M: Array, dM: Array, dG: Array, C: Array,
    dist: Array, walk: Array, io: Array, wide: Array, past: Array, counts: Ints, every: int, amount: float, work: Array,
) -> int:  # fmt: skip
    """Run the extended filter from sample `first` on; return before which sample the matrices are to be renewed.

    x+ = M(q) [x; u; u late; o], M(q) = M + sum dM_j (q_j - at_j); dG holds what the stationary gain's dependence on q
    adds to the sensitivity of x to q for a unit innovation (Ljung 1979).
    """
    n, p, (n_x, wide_m) = z.size, dM.shape[0], M.shape
    s, n_u, n_y, n_d = n - n_x, u.shape[1], y.shape[1], dist.size
    f, b, v, now = work[0, : n + n_x], work[1, :n], work[2, :wide_m], work[3 : 3 + n_x, :wide_m]
    J, W = work[3 + n_x : 3 + 2 * n_x, :s], work[3 + 2 * n_x : 3 + 3 * n_x, : n_x + n_d]
    whole = 0  # a variable: of a constant the compiler would make one more version of `carry`
    for k in range(first, u.shape[0]):
        counts[K] += 1
        if _take(u[k], y[k], e[k], z, T, C, io, wide, past, counts, f, b):
            for i in range(n_x):
                v[i] = z[s + i]
                for c in range(wide_m):
                    now[i, c] = M[i, c]
            for i in range(n_u):
                v[n_x + i] = past[past.shape[0] - 2, i]
                v[n_x + n_u + i] = past[past.shape[0] - 1, i]
            for i in range(n_d):
                v[n_x + 2 * n_u + i] = z[p + i]
            for j in range(p):
                moved = z[j] - at[j]
                for i in range(n_x):
                    acc = 0.0
                    for c in range(wide_m):
                        slope = dM[j, i, c]
                        now[i, c] += slope * moved
                        acc += slope * v[c]
                    for o in range(n_y):
                        if np.isfinite(e[k, o]):
                            acc += dG[j, i, o] * e[k, o]
                    J[i, j] = acc
            for i in range(n_x):
                acc = 0.0
                for c in range(wide_m):
                    acc += now[i, c] * v[c]
                z[s + i] = acc
                for j in range(n_d):
                    J[i, p + j] = now[i, wide_m - n_d + j]
                    W[i, n_x + j] = now[i, wide_m - n_d + j] * dist[j]
            carry(T, whole, s, now, J, W)
            triangle(T, s, W)
        for i in range(y.shape[1]):
            e[k, i] *= io[1, n_u + i]
        if counts[K] % every == 0:
            _spread(T, walk, f[:n])
            for j in range(p):
                if abs(z[j] - at[j]) > amount:
                    counts[DUE] = 1
            if counts[DUE] == 1:
                return k + 1
    return int(u.shape[0])


@compiled
def _fill(q: Array, logs: Ints, place: Ints, size: Array, start: Ints, factor: Ints, D: Array, t: Array) -> None:
    """Evaluate the continuous-time matrices [A, B, E] T at scaled parameters: entries are products of powers."""
    for j in range(logs.size):
        t[j] = np.exp(q[j]) if logs[j] else q[j]
    for i in range(size.size):
        acc = size[i]
        for c in range(start[i], start[i + 1]):
            g, power = t[factor[c, 0]], factor[c, 1]
            for _ in range(abs(power)):
                acc = acc * g if power > 0 else acc / g
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
    u: Array, y: Array, e: Array, z: Array, T: Array, logs: Ints, place: Ints, size: Array, start: Ints, factor: Ints,
    C: Array, dist: Array, walk: Array, io: Array, wide: Array, past: Array, counts: Ints, every: int, terms: int,
    scaled: Array, work: Array,
) -> None:  # fmt: skip
    """Run the unscented filter; `scaled` holds gamma^2, the weights W0 of mean and covariance, and the fraction."""
    n, p, n_x, n_d = z.size, logs.size, C.shape[1], dist.size
    s, n_u, wide_w = n - n_x, u.shape[1], n_x + n_d + p + 1
    square, mean_0, cov_0, fraction = scaled[0], scaled[1], scaled[2], scaled[3]
    gamma, other = np.sqrt(square), 0.5 / square
    f, b, t, zero, point = work[0, : n + n_x], work[1, :n], work[2, : 2 * n_x + p], work[3, :n_u], work[4, :n]
    up, still, q, o, x = work[5, :n_x], work[6, :n_x], point[:p], point[p:s], point[s:]
    D, ends = work[7 : 7 + n_x, : n_x + n_u + n_d], work[7 + n_x : 7 + 3 * n_x, :p]
    A, J = work[7 + 3 * n_x : 7 + 4 * n_x, :n_x], work[7 + 4 * n_x : 7 + 5 * n_x, :s]
    W = work[7 + 5 * n_x : 7 + 6 * n_x, :wide_w]
    for i in range(n_u):
        zero[i] = 0.0
    # points of the linear columns lie about the moved centre: all share its distance from the mean
    centre = cov_0 + 2.0 * other * (n - p)
    for k in range(u.shape[0]):
        counts[K] += 1
        if _take(u[k], y[k], e[k], z, T, C, io, wide, past, counts, f, b):
            now, late = past[past.shape[0] - 2], past[past.shape[0] - 1]
            # the central point, and the matrices there: the step is linear in states, offsets and disturbances
            for i in range(n):
                point[i] = z[i]
            _fill(q, logs, place, size, start, factor, D, t)
            _move(D, x, now, late, o, fraction, terms, t)
            for i in range(n_x):
                up[i] = x[i]
            for j in range(n_x + n_d):
                for i in range(n_x):
                    x[i] = 1.0 if i == j else 0.0
                for i in range(n_d):
                    o[i] = 1.0 if i == j - n_x else 0.0
                _move(D, x, zero, zero, o, fraction, terms, t)
                for i in range(n_x):
                    if j < n_x:
                        A[i, j] = x[i]
                    else:
                        J[i, p + j - n_x], W[i, j] = x[i], x[i] * dist[j - n_x]
            # points along the parameters' columns, two by two
            for i in range(n_x):
                still[i] = (mean_0 + 2.0 * other * (n - p)) * up[i]
            for j in range(p):
                for side in range(2):
                    for i in range(n):
                        point[i] = z[i] + (gamma if side == 0 else -gamma) * T[j, i]
                    _fill(q, logs, place, size, start, factor, D, t)
                    _move(D, x, now, late, o, fraction, terms, t)
                    for i in range(n_x):
                        ends[side * n_x + i, j] = x[i]
                        still[i] += other * x[i]
            carry(T, p, s, A, J, W)
            for i in range(n_x):
                for j in range(p):
                    plus, minus = ends[i, j], ends[n_x + i, j]
                    T[j, s + i] = (plus - minus) / (2.0 * gamma)
                    W[i, n_x + n_d + j] = np.sqrt(0.5 * other) * (plus + minus - 2.0 * still[i])
                x[i] = np.sqrt(abs(centre)) * (up[i] - still[i])
                W[i, wide_w - 1] = x[i] if centre > 0.0 else 0.0
                z[s + i] = still[i]
            triangle(T, s, W)
            if centre < 0.0 and not rank_one_down(T[s:, s:], x, b[:n_x]):
                counts[REFUSED] += 1
        for i in range(y.shape[1]):
            e[k, i] *= io[1, n_u + i]
        if counts[K] % every == 0:
            _spread(T, walk, f[:n])
