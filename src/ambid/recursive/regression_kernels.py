"""Compiled recursions of linear regressions, each one array: head | estimate p | factors of P p p | companion p p |
prior p | scratch 4 p, the companion information of squared weights (least squares) or covariance of the error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.square_root_kernels import project, shrink, size, variance, widen

Table = NDArray[np.int64]

# Places in the head of the one array of a recursion.
(
    SIZE,  # p
    USED,
    REJECTED,
    KIND,
    FACTOR,  # of forgetting, as asked for
    FACTOR_NOW,  # the same, nearer to 1 where P is about to pass its limit
    EVERY,  # samples between two looks at the limit
    LIMIT,  # of the mean of P_ii over prior variance
    MEMORY,  # of the estimate, samples
    NOISE_RATE,  # of forgetting of the noise variance
    NOISE_SUM,
    NOISE_WEIGHT,
    TYPICAL,  # a tenth of the usual φᵀPφ
    STEP,
    SMALL,
    LIMITED,  # samples whose step was limited
    VAGUE,  # 1: no prior was given; the limit is counted from the best variances so far
    SETTLED,  # weight of the noise variance from which it is the unit of the covariance; infinite where it is known
    UNIT,  # variance in which C is counted; 0: that of the moment
    NOW,  # noise variance of the last look over the unit
    INSTRUMENTS,  # m
    LAGS,
    SUM_OF_SQUARES,  # of the weights of the samples
    PRIOR_LEFT,  # squared weight that the prior still has
) = range(24)
HEAD = 24

LEAST_SQUARES, DIRECTIONAL, LMS, NLMS = range(4)

# A sample that leads there is rejected; variance over the best one, in place of a prior; least noise over the unit.
_HUGE, _WORSE, _SILENT = 1e200, 1e9, 1e-12
_SINGULAR = 1e-12
_LITTLE = 0.1  # of the usual leverage, at which a sample counts half


@compiled(error_model="numpy")
def noise_of_now(s: Array) -> float:
    """Return the noise variance over the unit of C: a calm later on makes old samples no better."""
    return max(s[NOISE_SUM] / s[NOISE_WEIGHT] / s[UNIT], _SILENT) if s[UNIT] > 0 else 1.0


@compiled(error_model="numpy")
def _four(s: Array, phi: Array, y: Array, out: Array, t: int, until: float) -> int:
    """Least squares of four coefficients, all in registers: d, u are the factors of P; g, w those of its companion."""
    theta, F, G = s[HEAD : HEAD + 4], s[HEAD + 4 : HEAD + 20].reshape(4, 4), s[HEAD + 20 : HEAD + 36].reshape(4, 4)
    th0, th1, th2, th3 = theta[0], theta[1], theta[2], theta[3]
    d0, d1, d2, d3 = F[0, 0], F[1, 1], F[2, 2], F[3, 3]
    u10, u20, u21, u30, u31, u32 = F[1, 0], F[2, 0], F[2, 1], F[3, 0], F[3, 1], F[3, 2]
    g0, g1, g2, g3 = G[0, 0], G[1, 1], G[2, 2], G[3, 3]
    w10, w20, w21, w30, w31, w32 = G[1, 0], G[2, 0], G[2, 1], G[3, 0], G[3, 1], G[3, 2]
    noise, weight, rate, typical = s[NOISE_SUM], s[NOISE_WEIGHT], s[NOISE_RATE], s[TYPICAL]
    grow, shrink, now = 1.0 / s[FACTOR_NOW], s[FACTOR_NOW] * s[FACTOR_NOW], 1.0 / s[NOW]
    used, rejected, root = s[USED], s[REJECTED], 1.0 / np.sqrt(now)
    while t < y.size and used < until:
        x0, x1, x2, x3 = phi[t, 0], phi[t, 1], phi[t, 2], phi[t, 3]
        e = y[t] - (x0 * th0 + x1 * th1) - (x2 * th2 + x3 * th3)
        f1 = x1 + u10 * x0
        f2 = x2 + (u20 * x0 + u21 * x1)
        f3 = x3 + u30 * x0 + (u31 * x1 + u32 * x2)
        v0, v1, v2, v3 = d0 * grow * x0, d1 * grow * f1, d2 * grow * f2, d3 * grow * f3
        a0 = 1.0 + v0 * x0
        a1 = a0 + v1 * f1
        a2 = a1 + v2 * f2
        a3 = a2 + v3 * f3
        if not (a3 + e * e < _HUGE):
            out[t] = np.nan
            rejected += 1.0
            t += 1
            continue
        r0, r1, r2, r3 = 1.0 / a0, 1.0 / a1, 1.0 / a2, 1.0 / a3
        d0, d1, d2, d3 = d0 * grow * r0, d1 * grow * (a0 * r1), d2 * grow * (a1 * r2), d3 * grow * (a2 * r3)
        b1, b2, b3 = f1 * r0, f2 * r1, f3 * r2
        k0 = v0
        u10, k0 = u10 - b1 * k0, k0 + v1 * u10
        k1 = v1
        u20, k0 = u20 - b2 * k0, k0 + v2 * u20
        u21, k1 = u21 - b2 * k1, k1 + v2 * u21
        k2 = v2
        u30, k0 = u30 - b3 * k0, k0 + v3 * u30
        u31, k1 = u31 - b3 * k1, k1 + v3 * u31
        u32, k2 = u32 - b3 * k2, k2 + v3 * u32
        g0, g1, g2, g3 = g0 * shrink, g1 * shrink, g2 * shrink, g3 * shrink
        h1 = k1 + w10 * k0
        h2 = k2 + (w20 * k0 + w21 * k1)
        h3 = v3 + w30 * k0 + (w31 * k1 + w32 * k2)
        c = now * ((g0 * k0 * k0 + g1 * h1 * h1) + (g2 * h2 * h2 + g3 * h3 * h3))
        c = 1.0 / (1.0 + min(c, a3 - 1.0))
        share = (a3 - 1.0) / (a3 - 1.0 + typical)
        keep = 1.0 - rate * share
        noise = keep * noise + share * (c * e) * (c * e)
        weight = keep * weight + share * c
        gain = e * r3
        th0, th1, th2, th3 = th0 + k0 * gain, th1 + k1 * gain, th2 + k2 * gain, th3 + v3 * gain
        x0, x1, x2, x3 = root * x0, root * x1, root * x2, root * x3
        q = x3 / g3
        a3 = 1.0 + q * x3
        r3, g3 = 1.0 / a3, g3 * a3
        q, x0, x1, x2 = q * r3, x0 - x3 * w30, x1 - x3 * w31, x2 - x3 * w32
        w30, w31, w32 = w30 + q * x0, w31 + q * x1, w32 + q * x2
        q = x2 / g2
        a2 = a3 + q * x2
        r2, g2 = 1.0 / a2, g2 * a2 * r3
        q, x0, x1 = q * r2, x0 - x2 * w20, x1 - x2 * w21
        w20, w21 = w20 + q * x0, w21 + q * x1
        q = x1 / g1
        a1 = a2 + q * x1
        r1, g1 = 1.0 / a1, g1 * a1 * r2
        x0 -= x1 * w10
        w10 += q * r1 * x0
        g0 *= (a1 + x0 / g0 * x0) * r1
        used += 1.0
        out[t] = e
        t += 1
    theta[0], theta[1], theta[2], theta[3] = th0, th1, th2, th3
    F[0, 0], F[1, 1], F[2, 2], F[3, 3] = d0, d1, d2, d3
    F[1, 0], F[2, 0], F[2, 1], F[3, 0], F[3, 1], F[3, 2] = u10, u20, u21, u30, u31, u32
    G[0, 0], G[1, 1], G[2, 2], G[3, 3] = g0, g1, g2, g3
    G[1, 0], G[2, 0], G[2, 1], G[3, 0], G[3, 1], G[3, 2] = w10, w20, w21, w30, w31, w32
    s[NOISE_SUM], s[NOISE_WEIGHT], s[USED], s[REJECTED] = noise, weight, used, rejected
    return t


@compiled(error_model="numpy")
def _forget(s: Array, F: Array, x: Array, a: Array) -> None:
    """Widen P before a sample so that the information that x meets is forgotten (Cao and Schwartz 2000): P becomes P +
    (1/λ - 1) x xᵀ / (xᵀ P⁻¹ x).
    """
    p = x.size
    for j in range(p):
        a[j] = x[j]
    met = 0.0
    for j in range(p - 1, -1, -1):  # xᵀ P⁻¹ x by U⁻¹ x
        met += a[j] / F[j, j] * a[j]
        for i in range(j):
            a[i] -= a[j] * F[j, i]
    if 0.0 < met < _HUGE:
        for j in range(p):
            a[j] = x[j]
        widen(F, a, (1.0 / s[FACTOR_NOW] - 1.0) / met)


@compiled(error_model="numpy")
def _any(s: Array, p: int, phi: Array, y: Array, out: Array, t: int, until: float) -> int:
    """Take in samples t, ... until so many have been used; return the first that was not taken."""
    first, q = HEAD + p, p * p
    theta, F, G = s[HEAD:first], s[first : first + q].reshape(p, p), s[first + q : first + 2 * q].reshape(p, p)
    rest = s[first + 2 * q :].reshape(5, p)
    f, k, a, x = rest[1], rest[2], rest[3], rest[4]  # views here: in the loop they would be counted
    kind, gradient, now = s[KIND], s[KIND] >= LMS, s[NOW]
    grow, drop, one = 1.0 / s[FACTOR_NOW], s[FACTOR_NOW] * s[FACTOR_NOW], 1.0
    seen = G if gradient else F
    while t < y.size and s[USED] < until:
        e, power = y[t], 0.0
        for j in range(p):
            x[j] = phi[t, j]
            e -= x[j] * theta[j]
            power += x[j] * x[j]
        project(seen, x, f)
        if not (size(seen, f) + power + e * e < _HUGE):
            out[t] = np.nan
            s[REJECTED] += 1.0
            t += 1
            continue
        if gradient:  # a step along the regressor
            step = s[STEP]
            if kind == NLMS:
                step /= s[SMALL] + power
            elif step * power > 1.0:
                step = 1.0 / power
                s[LIMITED] += 1.0
            for j in range(p):
                a[j] = step * x[j]
                theta[j] += a[j] * e
            leverage = step * power
            if s[TYPICAL] == 0.0:
                s[TYPICAL] = 0.1 * leverage
            spread = size(G, f)
        else:
            if kind == LEAST_SQUARES:
                for j in range(p):
                    F[j, j] *= grow
                    G[j, j] *= drop
            else:
                _forget(s, F, x, a)
                project(F, x, f)
            alpha = shrink(F, f, one, k)
            leverage = spread = alpha - 1.0
            for j in range(p):
                theta[j] += k[j] * (e / alpha)
                a[j] = k[j] / alpha
            if kind == DIRECTIONAL:
                now = noise_of_now(s)
            project(G, k if kind == LEAST_SQUARES else x, f)
            spread = min(size(G, f) / now, spread)  # not more than P says, but where the noise has just fallen
        if leverage > 0.0:  # σ² = E e² / (1 + φᵀCφ): a sample that says little of the estimate says little of its noise
            w, share = 1.0 / (1.0 + spread), leverage / (leverage + s[TYPICAL])
            keep = 1.0 - s[NOISE_RATE] * share
            s[NOISE_SUM] = keep * s[NOISE_SUM] + share * (w * e) ** 2
            s[NOISE_WEIGHT] = keep * s[NOISE_WEIGHT] + share * w
            if gradient:
                s[TYPICAL] += s[NOISE_RATE] * share * (0.1 * leverage - s[TYPICAL])
        if kind == LEAST_SQUARES:
            widen(G, x, now)
        else:
            # C becomes (I - Kφᵀ) C (I - Kφᵀ)ᵀ + r K Kᵀ: the best gain's, and a square of what K differs from it
            alpha = shrink(G, f, one if gradient else noise_of_now(s), k)
            root = np.sqrt(alpha)
            for j in range(p):
                a[j] = root * a[j] - k[j] / root
            widen(G, a, one)
        s[USED] += 1.0
        out[t] = e
        t += 1
    return t


@compiled(error_model="numpy")
def regress(s: Array, phi: Array, y: Array, out: Array) -> None:
    """Take in rows of phi (n, p) and y (n,); write errors of prediction into out (n,), NaN where one is rejected. At
    fixed counts the factor is chosen with which P cannot pass its limit before the next look.
    """
    p, t = int(s[SIZE]), int(0.0)  # a plain 0 has a type of its own: what takes it would be compiled twice
    four, a, q = p == 4 and s[KIND] == LEAST_SQUARES, HEAD + p, p * p
    while t < y.size:
        until = (np.floor(s[USED] / s[EVERY]) + 1.0) * s[EVERY] if s[KIND] < LMS else np.inf
        t = _four(s, phi, y, out, t, until) if four else _any(s, p, phi, y, out, t, until)
        if s[USED] < until:
            continue
        if s[UNIT] == 0 and s[NOISE_WEIGHT] > s[SETTLED]:
            s[UNIT] = s[NOISE_SUM] / s[NOISE_WEIGHT]
        s[NOW] = noise_of_now(s)
        F, prior, total = s[a : a + q].reshape(p, p), s[a + 2 * q :], 0.0
        for i in range(p):
            now = variance(F, i)
            if s[VAGUE] > 0:
                prior[i] = min(prior[i], _WORSE * now)
            total += now / (prior[i] * p * s[LIMIT])
        s[FACTOR_NOW] = min(1.0, total ** (1.0 / s[EVERY])) if total > s[FACTOR] ** s[EVERY] else s[FACTOR]
        s[TYPICAL] = 0.1 * p / min(s[USED] + 1.0, s[MEMORY])


@compiled(error_model="numpy")
def _solve(R: Array, T: Array, work: Array, theta: Array, m: int, p: int) -> None:
    """Least squares of the columns of φ on that of y: triangle into T, solution into theta unless it is singular."""
    for i in range(m):
        for j in range(p + 1):
            work[i, j] = R[i, m + j]
    sound = True
    for k in range(p):
        size, all_of_it = 0.0, 0.0
        for i in range(m):
            all_of_it += work[i, k] ** 2
            if i >= k:
                size += work[i, k] ** 2
        sound = sound and size > _SINGULAR**2 * all_of_it
        length = -np.sqrt(size) if work[k, k] > 0 else np.sqrt(size)
        head = work[k, k] - length
        if head != 0.0:
            for j in range(k + 1, p + 1):
                dot = head * work[k, j]
                for i in range(k + 1, m):
                    dot += work[i, k] * work[i, j]
                dot /= length * head
                work[k, j] += dot * head
                for i in range(k + 1, m):
                    work[i, j] += dot * work[i, k]
        work[k, k] = length
    if not sound:
        return
    for i in range(p):
        for j in range(i, p):
            T[i, j] = work[i, j]
    for i in range(p - 1, -1, -1):
        x = work[i, p]
        for j in range(i + 1, p):
            x -= T[i, j] * theta[j]
        theta[i] = x / T[i, i]


@compiled(error_model="numpy")
def _length(T: Array, x: Array, solved: Array) -> float:
    """Return xᵀ (TᵀT)⁻¹ x for an upper triangle."""
    total = 0.0
    for i in range(x.size):
        v = x[i]
        for j in range(i):
            v -= T[j, i] * solved[j]
        solved[i] = v / T[i, i]
        total += solved[i] ** 2
    return total


@compiled(error_model="numpy")
def instrumental(s: Array, rows: Array, y: Array, out: Array) -> None:
    """Take in rows [φ, ζ] (n, p + m) and y (n,); errors of prediction into out (n,).

    `s`: head | estimate p | R m (m + p + 1), the triangle of weighted rows [ζᵀ φᵀ y], not squared | T p p, that of its
    φ | long-run covariance m m | ring lags m | its sum m | prior p | size of the instruments m | work.
    """
    p, m, lags = int(s[SIZE]), int(s[INSTRUMENTS]), int(s[LAGS])
    a = HEAD
    theta = s[a : a + p]
    a += p
    R = s[a : a + m * (m + p + 1)].reshape(m, m + p + 1)
    a += m * (m + p + 1)
    T = s[a : a + p * p].reshape(p, p)
    a += p * p
    omega = s[a : a + m * m].reshape(m, m)
    a += m * m
    ring = s[a : a + lags * m].reshape(lags, m)
    a += lags * m
    total, prior = s[a : a + m], s[a + m : a + m + p]
    a += m + p + m
    work = s[a : a + m * (p + 1)].reshape(m, p + 1)
    a += m * (p + 1)
    new = s[a : a + m + p + 1]
    a += m + p + 1
    unit, solved = s[a : a + p], s[a + p : a + p + m]
    for t in range(y.size):
        e, power = y[t], y[t] ** 2
        for j in range(p):
            e -= rows[t, j] * theta[j]
        for j in range(p + m):
            power += rows[t, j] ** 2
        if not (power + e * e < _HUGE):
            out[t] = np.nan
            s[REJECTED] += 1.0
            continue
        for j in range(m):
            new[j] = rows[t, p + j]
        for j in range(p):
            unit[j] = new[m + j] = rows[t, j]
        new[m + p] = y[t]
        factor = s[FACTOR_NOW]
        root, spread = np.sqrt(factor), _length(T, unit, solved) / (1.0 + factor)
        for i in range(m):  # rotate the row into the weighted rows of before; what remains of it is dropped
            r, x = root * R[i, i], new[i]
            length = np.hypot(r, x)
            c, d = (r / length, x / length) if length > 0 else (1.0, 0.0)
            R[i, i] = length
            for j in range(i + 1, new.size):
                b, x = root * R[i, j], new[j]
                R[i, j] = c * b + d * x
                new[j] = c * x - d * b
        _solve(R, T, work, theta, m, p)
        for j in range(m):
            new[j] = rows[t, p + j]
        _account(s, R, omega, ring, total, new[:m], e, 1.0 / (1.0 + spread), solved)
        s[USED] += 1.0
        if s[USED] % s[EVERY] == 0:  # the factor that keeps the mean of the variances over the prior's below its limit
            mean = 0.0
            for i in range(p):
                for j in range(p):
                    unit[j] = 1.0 if j == i else 0.0
                now = _length(T, unit, solved)
                prior[i] = min(prior[i], _WORSE * now)
                mean += now / (prior[i] * p * s[LIMIT])
            s[FACTOR_NOW] = min(1.0, mean ** (1.0 / s[EVERY])) if mean > s[FACTOR] ** s[EVERY] else s[FACTOR]
        out[t] = e


@compiled(error_model="numpy")
def _account(
    s: Array, R: Array, omega: Array, ring: Array, total: Array, zeta: Array, e: float, w: float, solved: Array
) -> None:
    """Track noise and weights, a sample by what its instruments add to those before. The long-run covariance of ζ e has
    Bartlett's weights: the mean square of its sums over `lags` samples.
    """
    m, lags, factor = zeta.size, ring.shape[0], s[FACTOR_NOW]
    leverage = _length(R, zeta, solved)
    share = leverage / (leverage + _LITTLE * m / min(s[USED] + 1.0, s[MEMORY]))
    keep, weighted = 1.0 - s[NOISE_RATE] * share, w * e
    place = int(s[USED] % lags)
    for i in range(m):
        total[i] -= ring[place, i]
        ring[place, i] = zeta[i] * weighted
        total[i] += ring[place, i]
        if place == lags - 1:  # afresh, or rounding adds up
            total[i] = 0.0
            for k in range(lags):
                total[i] += ring[k, i]
    for i in range(m):
        for j in range(i + 1):
            omega[i, j] = keep * omega[i, j] + share / lags * total[i] * total[j]
            omega[j, i] = omega[i, j]
    s[NOISE_SUM] = keep * s[NOISE_SUM] + share * weighted * weighted
    s[NOISE_WEIGHT] = keep * s[NOISE_WEIGHT] + share * w
    s[SUM_OF_SQUARES] = factor * factor * s[SUM_OF_SQUARES] + (1.0 + _LITTLE) * share
    s[PRIOR_LEFT] *= factor * factor


@compiled(error_model="numpy")
def tapped(past: Array, table: Table, x: Array, rows: Array, theta: Array, first: int) -> None:
    """Fill rows (n, n_columns) from signals x (n, n_channels) and those before, past (n_lags, n_channels), by `table`:
    channel (-1: 1), lag, sign. With `theta` (p,), the last channel is made here: a model's output without noise, from
    columns `first`, .... The row of a sample that is not finite begins with NaN.
    """
    lags, last = past.shape[0], x.shape[1] - 1
    for t in range(x.shape[0]):
        finite = True
        for c in range(x.shape[1]):
            if theta.size == 0 or c < last:
                finite = finite and np.isfinite(x[t, c])
        for j in range(table.shape[0]):
            c, k = table[j, 0], t - table[j, 1]
            if c < 0:
                rows[t, j] = 1.0
            else:
                rows[t, j] = table[j, 2] * (x[k, c] if k >= 0 else past[lags + k, c])
        if theta.size > 0:
            made = 0.0
            for j in range(theta.size):
                made += rows[t, first + j] * theta[j]
            x[t, last] = made if np.isfinite(made) else 0.0
        if not finite:
            rows[t, 0] = np.nan
    n = x.shape[0]
    for k in range(lags):
        for c in range(last + 1):
            past[k, c] = past[k + n, c] if k + n < lags else x[k + n - lags, c]
