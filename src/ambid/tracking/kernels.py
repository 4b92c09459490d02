"""Compiled loops of the tracker: predictor with exact sensitivities, folded block by block into a triangle; the filter
of the tracked numbers, on the square-root core of all recursions; and windows of triangles, tested for a change.

x+ = M w, w = [x; inputs at their lags; y; 1; unbalance forcing], s_q+ = F s_q + D_q w for number q. Householder
reflections take rows at fixed counts of samples: numbers do not depend on how the stream is cut into calls.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.square_root_kernels import project, shrink, widen

Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

_MOST = 0.5  # part of a positive number by which one block may lower it


@compiled(error_model="numpy", fastmath={"contract"})
def advance(
    first: int, u: Array, y: Array, forcing: Array, M: Array, D: Array, scale: Array, lags: Integers, history: Array,
    s: Array, rows: Array, counts: Integers, unit: Array, errors: Array, w: Array, f: Array,
) -> int:  # fmt: skip
    """Run from sample `first` until a block is complete, `rows` are full, samples end, or one is not finite; return the
    next. `u`, `y` in SI; `scale` (2, n_u + n_y): operating point and scales. `M` (n_x + n_y, n_l) gives next state and
    weighted innovations, `s` (n_x, p + 1) holds sensitivities, last the state; `errors` (n_samples, n_y) gets
    innovations in SI, the triangle `unit` times weighted ones; `rows` (p + 1, room) are not folded yet. `counts`: place
    of the next input in `history`, rows and samples of the block, samples to settle, samples of a block. `w`, `f` (n_x
    + n_y, p + 1): scratch.
    """
    n_x, n_u, n_y, p = s.shape[0], u.shape[1], y.shape[1], s.shape[1] - 1
    depth, n_f, room, high, n_l = history.shape[0], forcing.shape[1], rows.shape[1], f.shape[0], w.size
    for k in range(first, y.shape[0]):
        now, column, total = counts[0], n_x, 0.0
        for j in range(n_u):
            history[now, j] = (u[k, j] - scale[0, j]) / scale[1, j]
            total += u[k, j]
        for lag in lags:
            for j in range(n_u):
                w[column] = history[(now - lag) % depth, j]
                column += 1
        for j in range(n_y):
            w[column] = (y[k, j] - scale[0, n_u + j]) / scale[1, n_u + j]
            total += y[k, j]
            column += 1
        w[column] = 1.0
        for j in range(n_f):
            w[column + 1 + j] = forcing[k, j]
            total += forcing[k, j]
        if not math.isfinite(total):
            return k
        counts[0] = (now + 1) % depth
        for j in range(n_x):
            w[j] = s[j, p]
        for i in range(high):
            for q in range(p + 1):
                f[i, q] = M[i, 0] * s[0, q]
            for j in range(1, n_x):
                v = M[i, j]
                for q in range(p + 1):
                    f[i, q] += v * s[j, q]
        for c in range(n_l):
            v = w[c]
            for i in range(n_x):
                for q in range(p):
                    f[i, q] += v * D[c, i, q]
            if c >= n_x:
                for i in range(high):
                    f[i, p] += v * M[i, c]
        r, settled = counts[1], counts[3] == 0
        for i in range(n_y):
            v = 0.0
            for j in range(i + 1):
                v += unit[i, j] * f[n_x + j, p]
            errors[k, i] = v
            if settled:
                for q in range(p + 1):
                    rows[q, r + i] = f[n_x + i, q]
        for i in range(n_x):
            for q in range(p + 1):
                s[i, q] = f[i, q]
        if settled:
            counts[1] = r + n_y
            counts[2] += 1
        else:
            counts[3] -= 1
        if counts[1] + n_y > room or counts[2] == counts[4]:
            return k + 1
    return len(y)


@compiled(error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def fold(R: Array, w: Array, n: int, begun: int) -> None:
    """Take `n` rows, columns of `w` (used up), into the triangle R (p, width >= p); entry j of a row is zero in all but
    the first `begun` + j of them: `n` for any rows, 1 for those of a triangle.
    """
    p, width = R.shape
    for j in range(p):
        v = w[j]
        m = min(n, begun + j)
        s = 0.0
        for t in range(m):
            s += v[t] * v[t]
        if s == 0.0:
            continue
        a = R[j, j]
        b = -math.sqrt(a * a + s) if a > 0 else math.sqrt(a * a + s)
        size, tau = 1.0 / (a - b), (b - a) / b
        R[j, j] = b
        for k in range(j + 1, width):
            x = w[k]
            dot = 0.0
            for t in range(m):
                dot += v[t] * x[t]
            g = tau * (R[j, k] + dot * size)
            R[j, k] -= g
            g *= size
            for t in range(m):
                x[t] -= g * v[t]


@compiled(error_model="numpy")
def absorb(
    q: Array, F: Array, J: Array, r: Array, at: Array, active: Flags, positive: Flags, noise: float, K: Array
) -> tuple[float, float]:
    """Update q and its covariance's factors F by rows r + J (q* - at) ~ N(0, noise I), J upper triangular; return rho^T
    V^-1 rho, rho = r + J (q - at), V = noise I + J P J^T, and the part of the step taken. The gain is optimal for
    active numbers, zero for others (Schmidt); where a positive number would lose more than half, gain and step shrink.
    With a gain D K the covariance is K's plus (I - D) K V K^T (I - D) (Joseph's form). `K` (p + 2, p) is scratch.
    """
    p, total, part, schmidt = q.size, 0.0, 1.0, False
    step, f = K[p], K[p + 1]
    for j in range(p):
        step[j] = 0.0
    for i in range(p):
        rho = r[i]
        for j in range(i, p):
            rho += J[i, j] * (q[j] - at[j] + step[j])
        project(F, J[i], f)
        alpha = shrink(F, f, noise, K[i])
        total += rho * rho / alpha
        root = 1.0 / math.sqrt(alpha)
        for j in range(p):
            K[i, j] *= root
            step[j] -= K[i, j] * root * rho
    for j in range(p):
        if not active[j]:
            schmidt = True
        elif positive[j] and -step[j] > _MOST * q[j]:
            part = min(part, -_MOST * q[j] / step[j])
    for j in range(p):
        if active[j]:
            q[j] += part * step[j]
    if schmidt or part < 1.0:
        for i in range(p):
            for j in range(p):
                f[j] = K[i, j] * (1.0 - part) if active[j] else K[i, j]
            widen(F, f, 1.0)
    return total, part


@compiled(error_model="numpy", fastmath={"contract"})
def filter_ring(
    J: Array, r: Array, at: Array, count: int, first: int, q: Array, P: Array, step: Array, noise: float, K: Array
) -> None:
    """Take `q` (p,) and `P` (p, p) from before a ring of `count` blocks to behind it: Kalman filter from block `first`,
    rows one by one, random walk of variance step^2 a block. J (size, p, p) upper triangular; `K` (size, p, p + 2) keeps
    gains, residuals and their variances.
    """
    size, p = r.shape
    for b in range(count):
        block = (first + b) % size
        for i in range(p):
            z, g = J[block, i], K[b, i]
            v, F = r[block, i], noise
            for a in range(p):
                g[a] = z[i] * P[i, a]
            for c in range(i + 1, p):
                w = z[c]
                for a in range(p):
                    g[a] += w * P[c, a]
            for a in range(i, p):
                v += z[a] * (q[a] - at[block, a])
                F += g[a] * z[a]
            g[p], g[p + 1] = v, F
            for a in range(p):
                w = g[a] / F
                q[a] -= w * v
                for c in range(p):
                    P[a, c] -= w * g[c]
        if b < count - 1:
            for a in range(p):
                P[a, a] += step[a] * step[a]


@compiled(error_model="numpy", fastmath={"contract"})
def smooth_ring(J: Array, count: int, first: int, K: Array, sums: Array, N: Array) -> None:
    """Fill `sums` (4, p) with the sums of lambda_j^2 and of N_jj, twice the score their difference, by the disturbance
    smoother over what `filter_ring` kept (Koopman and Shephard 1992; Durbin and Koopman 2012, sec. 4.5, 6.4); `N`:
    scratch.
    """
    size, p, squares, powers, lam, drop = J.shape[0], J.shape[1], sums[0], sums[1], sums[2], sums[3]
    for a in range(p):
        squares[a] = powers[a] = lam[a] = 0.0
        for c in range(p):
            N[a, c] = 0.0
    for b in range(count - 1, -1, -1):
        block = (first + b) % size
        if b < count - 1:
            for a in range(p):
                squares[a] += lam[a] * lam[a]
                powers[a] += N[a, a]
        for i in range(p - 1, -1, -1):
            z, g = J[block, i], K[b, i]
            # L = I - K z / F:  lambda <- -z error / F + L^T lambda,  N <- z z^T / F + L^T N L
            F, dot, twice = g[p + 1], g[p], 0.0
            for a in range(p):
                drop[a] = 0.0
            for c in range(p):
                w = g[c] / F
                dot += g[c] * lam[c]
                for a in range(p):
                    drop[a] += w * N[c, a]
            for a in range(p):
                twice += g[a] * drop[a]
            twice = (1.0 + twice) / F
            for a in range(p):
                w = z[a] if a >= i else 0.0
                lam[a] -= w * dot / F
                for c in range(p):
                    N[a, c] -= w * drop[c]
                for c in range(i, p):
                    N[a, c] += (w * twice - drop[a]) * z[c]


Counts = NDArray[np.int64]


_QUANTILE = 0.03  # share of quiet statistics above the point by which overdispersion is learned
_LARGEST_GAIN = 0.02  # of learning overdispersion
_SETTLE_GAIN = 12.0  # over the number of tests, while settling: one over the density of log chi-squared at that point


@compiled(error_model="numpy", fastmath={"contract"})
def whiten(T: Array, before: Array, drift: Array, blocks: int, M: Array, X: Array) -> None:
    """Fill `X` (p, p + 1) with M^-1/2 [J rho], M = I + J P J^T, rho = r + J q. `T` is [J r], `before` [P q], P grows by
    `drift` (p,) a block, `M` is scratch; pivots of M are at least one, rounding below that is put right.
    """
    p = T.shape[0]
    for i in range(p):
        for j in range(p + 1):
            X[i, j] = T[i, p] if j == p else 0.0
        for k in range(i, p):
            a = T[i, k]
            for j in range(p + 1):
                X[i, j] += a * before[k, j]
            X[i, k] += a * drift[k] * blocks
    for i in range(p):
        for j in range(i + 1):
            total = 1.0 if i == j else 0.0
            for k in range(j, p):
                total += X[i, k] * T[j, k]
            for k in range(j):
                total -= M[i, k] * M[j, k]
            M[i, j] = math.sqrt(max(total, 1.0)) if i == j else total / M[j, j]
    for i in range(p):
        for j in range(p):
            X[i, j] = T[i, j] if j >= i else 0.0
        for k in range(i):
            a = M[i, k]
            for j in range(p + 1):
                X[i, j] -= a * X[k, j]
        a = 1.0 / M[i, i]
        for j in range(p + 1):
            X[i, j] *= a


@compiled(error_model="numpy")
def _test(
    X: Array, rest: float, freedom: float, learned: Array, marks: Array, toward: Array, gain: float, noise: float,
    blur: float, row: Array,
) -> None:  # fmt: skip
    """Test one whitened window, and learn from it if `gain` is positive; see `watch` for `row`."""
    p, joint = X.shape[0], toward.shape[0]
    level = joint + 1
    spread = rest / freedom if freedom >= 1.0 else 0.0
    row[3], row[4] = -1.0, 0.0
    for t in range(level + 1):
        b, v, raw, scale = 0.0, 0.0, 0.0, math.exp(learned[t])
        if t < joint:
            for i in range(p):
                a = 0.0
                for j in range(p):
                    if toward[t, j] != 0.0:
                        a += X[i, j] * toward[t, j]
                b += a * X[i, p]
                v += a * a
            if v > 1e-30:
                raw = b * b / v
        elif t == joint:
            for i in range(p):
                raw += X[i, p] * X[i, p]
        elif freedom >= 1.0:  # a standard normal number for rest/freedom of a chi-squared rest (Wilson, Hilferty 1931)
            v = 2.0 / (9.0 * freedom)
            raw = ((spread / noise) ** (1.0 / 3.0) - (1.0 - v)) ** 2 / v
        if t < level:
            raw /= blur
        if gain > 0.0:  # so that a share `_QUANTILE` lies above the mark times the scale, which is at least one
            step = gain * ((1.0 if raw > marks[1, t] * scale else 0.0) - _QUANTILE)
            learned[t] = max(learned[t] + step, 0.0)
        if t < level:
            scale = max(scale, spread)
        now = raw / scale
        row[10 + t] = now
        if t < joint and now > row[4]:
            row[3], row[4], row[5], row[6] = float(t), now, -b / v, math.sqrt(scale * blur / v)
    row[7], row[8], row[9] = row[10 + joint], row[10 + level], spread / noise
    passed = row[4] > marks[0, 0] or row[7] > marks[0, joint] or row[8] > marks[0, level]
    row[0] = 1.0 if passed else 0.0


@compiled(error_model="numpy", fastmath={"contract"})
def _gather(base: Array, m: int, acc: Array, other: Array) -> None:
    """Put the first triangle [J r] of a window into `acc`, fold the next ones to it."""
    p, width = acc.shape
    for i in range(p):
        for j in range(width):
            if m == 1:
                acc[i, j] = base[i, j]
            else:
                other[j, i] = base[i, j]
    if m > 1:
        fold(acc, other, p, width - p)


@compiled(error_model="numpy")
def watch(
    bases: Array, notes: Array, counts: Counts, history: Array, learned: Array, marks: Array, toward: Array,
    drift: Array, walking: Array, longest: int, gain: float, noise: float, acc: Array, other: Array, M: Array, X: Array,
    tests: Array,
) -> bool:  # fmt: skip
    """Test the windows that end with the newest block, learn how much larger than chance quiet statistics are; return
    whether any passed. `bases` (4 levels, p, p + 1): each level's last four triangles [J r] of 2^level blocks, `counts`
    (levels,) so far; `notes` (4 levels, 4): rest, freedom, first sample, first block. `history` (ring, p, p + 1): [P q]
    before each block, q relative to the triangles' point. `learned` (windows, tests): log of overdispersion; `marks`
    (2, tests): thresholds, and points that few quiet statistics pass; `toward` (hypotheses, p): move of the numbers by
    each; `drift`: variance per block; `walking` (p,): that part of it which blurs a window; `longest` window, blocks;
    `gain` of learning, below 0 while settling; `noise` level. `tests` (windows, 10 + tests): passed, blocks, first
    sample, likeliest hypothesis, its statistic, size, sd, joint, rest, noise; all statistics. `acc` (p, p + 1), `other`
    (p + 1, p), `M` (p, p), `X` (p, p + 1) are scratch.
    """
    levels, alarm = counts.size, False
    for level in range(levels):
        n_bases, rest, freedom, up = counts[level], 0.0, 0.0, 4 * level + 4
        # long windows are looked at less often; while settling, as fast as a quantile can be learned
        speed = min(gain * (1 << level), _LARGEST_GAIN)
        if gain < 0.0:
            speed = _SETTLE_GAIN / (n_bases + 2.0 * _SETTLE_GAIN)
        for m in range(1, min(n_bases, 4) + 1):
            length, slot = m << level, 4 * level + (n_bases - m) % 4
            if length > longest:
                break
            note = notes[slot]
            _gather(bases[slot], m, acc, other)
            rest += note[0]
            freedom += note[1]
            if m == 2 and n_bases % 2 == 0 and level + 1 < levels:
                up += counts[level + 1] % 4
                _gather(acc, m // 2, bases[up], other)  # a plain 1 has a type of its own
                notes[up, 0], notes[up, 1] = rest, freedom
                notes[up, 2], notes[up, 3] = note[2], note[3]
            if level > 0 and m < 3:
                continue
            whiten(acc, history[int(note[3]) % history.shape[0]], drift, length, M, X)
            window = m - 1 if level == 0 else 2 * level + m - 1
            tests[window, 1], tests[window, 2] = length, note[2]
            blur = 1.0  # what walks within a window shows in the other numbers, and not as a jump before it
            for j in range(acc.shape[0]):
                if walking[j] > 0.0:
                    for i in range(j + 1):
                        blur += walking[j] * acc[i, j] * acc[i, j]
            _test(X, rest, freedom, learned[window], marks, toward, speed, noise, blur, tests[window])
            alarm = alarm or tests[window, 0] > 0.0
        if n_bases % 2 == 1 or level + 1 == levels:
            break
        counts[level + 1] += 1
    return alarm
