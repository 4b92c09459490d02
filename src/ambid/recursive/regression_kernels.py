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
) = range(20)
HEAD = 20

LEAST_SQUARES, LMS, NLMS = range(3)

# A sample that leads there is rejected; variance over the best one, in place of a prior; least noise over the unit.
_HUGE, _WORSE, _SILENT = 1e200, 1e9, 1e-12


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
            for j in range(p):
                F[j, j] *= grow
                G[j, j] *= drop
            alpha = shrink(F, f, one, k)
            leverage = spread = alpha - 1.0
            for j in range(p):
                theta[j] += k[j] * (e / alpha)
                a[j] = k[j] / alpha
            project(G, k, f)
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
            alpha = shrink(G, f, one, k)
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
def tapped(past: Array, table: Table, x: Array, rows: Array) -> None:
    """Fill rows (n, n_columns) from signals x (n, n_channels) and those before, past (n_lags, n_channels), by `table`:
    channel (-1: 1), lag, sign. The row of a sample that is not finite begins with NaN.
    """
    lags = past.shape[0]
    for t in range(x.shape[0]):
        finite = True
        for c in range(x.shape[1]):
            finite = finite and np.isfinite(x[t, c])
        for j in range(table.shape[0]):
            c, k = table[j, 0], t - table[j, 1]
            if c < 0:
                rows[t, j] = 1.0
            else:
                rows[t, j] = table[j, 2] * (x[k, c] if k >= 0 else past[lags + k, c])
        if not finite:
            rows[t, 0] = np.nan
    n = x.shape[0]
    for k in range(lags):
        for c in range(x.shape[1]):
            past[k, c] = past[k + n, c] if k + n < lags else x[k + n - lags, c]
