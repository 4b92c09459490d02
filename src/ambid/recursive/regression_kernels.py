"""Compiled recursions of linear regressions over the square-root core: least squares, LMS, and delay lines.

A recursion is one array, since a call from Python costs by the number of arrays: head | estimate p | factors of P p p |
factors of its companion p p | both at the start | walk p | prior variance p | scratch 3 p. The companion is the
information of squared weights for least squares, else the covariance of the error. Least squares of four coefficients
stay in registers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.square_root_kernels import project, shrink, size, solve, variance, widen

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
    RESET_EVERY,  # samples; 0 for never
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
) = range(21)
HEAD = 24

LEAST_SQUARES, DIRECTIONAL, WALK, LMS, NLMS = range(5)

# A sample that leads there is rejected; variance over the best one, in place of a prior; least noise over the unit.
_HUGE, _WORSE, _SILENT = 1e200, 1e9, 1e-12


@compiled(error_model="numpy")
def _views(s: Array, p: int) -> tuple[Array, Array, Array, Array]:
    """Return estimate, factors of P, factors of its companion, and the rows walk, prior and three to work with."""
    a, q = HEAD + p, p * p
    return (
        s[HEAD:a],
        s[a : a + q].reshape(p, p),
        s[a + q : a + 2 * q].reshape(p, p),
        s[a + 4 * q :].reshape(5, p),
    )


@compiled(error_model="numpy")
def _add_noise(s: Array, e: float, spread: float, leverage: float) -> None:
    """Track σ² = E e² / (1 + φᵀCφ). A sample that says little of the estimate says little of its noise."""
    w = 1.0 / (1.0 + spread)
    share = leverage / (leverage + s[TYPICAL])
    keep = 1.0 - s[NOISE_RATE] * share
    s[NOISE_SUM] = keep * s[NOISE_SUM] + share * (w * e) ** 2
    s[NOISE_WEIGHT] = keep * s[NOISE_WEIGHT] + share * w


@compiled(error_model="numpy")
def noise_of_now(s: Array) -> float:
    """Return the noise variance over the unit of C: a calm later on makes old samples no better."""
    return max(s[NOISE_SUM] / s[NOISE_WEIGHT] / s[UNIT], _SILENT) if s[UNIT] > 0 else 1.0


@compiled(error_model="numpy")
def _four(s: Array, phi: Array, y: Array, out: Array, t: int, until: float) -> int:
    """Least squares of four coefficients, all in registers: d, u are the factors of P; g, w those of its companion."""
    theta, F, G, _ = _views(s, 4)
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
def _joseph(G: Array, K: Array, phi: Array, f: Array, k: Array, r: float) -> float:
    """C becomes (I - Kφᵀ) C (I - Kφᵀ)ᵀ + r K Kᵀ for any gain: the best gain's, and a square of what K differs from it.

    Returns φᵀCφ of before; K is used up.
    """
    project(G, phi, f)
    alpha = shrink(G, f, r, k)
    root = np.sqrt(alpha)
    for j in range(K.size):
        K[j] = root * K[j] - k[j] / root
    widen(G, K, 1.0)
    return alpha - r


@compiled(error_model="numpy")
def _widen(s: Array, F: Array, walk: Array, phi: Array, a: Array) -> None:
    """Widen P before a sample: by a random walk, or so that the information that φ meets is forgotten (Cao-Schwartz).

    The latter is P + (1/λ - 1) φ φᵀ / (φᵀ P⁻¹ φ).
    """
    p = phi.size
    if s[KIND] == WALK:
        for i in range(p):
            if walk[i] > 0.0:
                a[:] = 0.0
                a[i] = 1.0
                widen(F, a[: i + 1], walk[i])
        return
    a[:] = phi
    solve(F, a)
    met = 0.0
    for j in range(p):
        met += a[j] / F[j, j] * a[j]
    if 0.0 < met < _HUGE:
        a[:] = phi
        widen(F, a, (1.0 / s[FACTOR_NOW] - 1.0) / met)


@compiled(error_model="numpy")
def _by_least_squares(s: Array, theta: Array, F: Array, G: Array, rest: Array, phi: Array, e: float) -> None:
    """Take in one sample: P and its companion, the estimate, the noise."""
    walk, f, k, a = rest[0], rest[2], rest[3], rest[4]
    p, kind, now = theta.size, s[KIND], s[NOW]
    if kind == LEAST_SQUARES:
        grow, drop = 1.0 / s[FACTOR_NOW], s[FACTOR_NOW] * s[FACTOR_NOW]
        for j in range(p):
            F[j, j] *= grow
            G[j, j] *= drop
    else:
        _widen(s, F, walk, phi, a)
        project(F, phi, f)
    alpha = shrink(F, f, 1.0, k)
    for j in range(p):
        theta[j] += k[j] * (e / alpha)
        a[j] = k[j] / alpha
    spread = alpha - 1.0  # not less than what C says, but where the noise has just fallen
    if kind == LEAST_SQUARES:
        project(G, k, f)
        spread = min(size(G, f) / now, spread)
    elif kind == DIRECTIONAL:
        now = noise_of_now(s)
        project(G, phi, f)
        spread = min(size(G, f) / now, spread)
    _add_noise(s, e, spread, alpha - 1.0)
    if kind == LEAST_SQUARES:
        a[:] = phi
        widen(G, a, now)
    elif kind == DIRECTIONAL:
        _joseph(G, a, phi, f, k, noise_of_now(s))


@compiled(error_model="numpy")
def _by_gradient(s: Array, theta: Array, G: Array, rest: Array, phi: Array, e: float, power: float) -> None:
    """Take in one sample: a step along the regressor, with the exact covariance of what it leaves."""
    f, k, a, step = rest[2], rest[3], rest[4], s[STEP]
    if s[KIND] == NLMS:
        step /= s[SMALL] + power
    elif step * power > 1.0:
        step = 1.0 / power
        s[LIMITED] += 1.0
    for j in range(theta.size):
        a[j] = step * phi[j]
        theta[j] += a[j] * e
    spread, leverage = _joseph(G, a, phi, f, k, 1.0), step * power
    if leverage > 0.0:
        if s[TYPICAL] == 0.0:
            s[TYPICAL] = 0.1 * leverage
        _add_noise(s, e, spread, leverage)
        s[TYPICAL] += s[NOISE_RATE] * leverage / (leverage + s[TYPICAL]) * (0.1 * leverage - s[TYPICAL])


@compiled(error_model="numpy")
def _any(s: Array, p: int, phi: Array, y: Array, out: Array, t: int, until: float) -> int:
    """Take in samples t, ... until so many have been used; return the first that was not taken."""
    theta, F, G, rest = _views(s, p)
    f, gradient = rest[2], s[KIND] >= LMS
    while t < y.size and s[USED] < until:
        row, e, power = phi[t], y[t], 0.0
        for j in range(p):
            e -= row[j] * theta[j]
            power += row[j] * row[j]
        seen = G if gradient else F
        project(seen, row, f)
        if size(seen, f) + power + e * e < _HUGE:
            if gradient:
                _by_gradient(s, theta, G, rest, row, e, power)
            else:
                _by_least_squares(s, theta, F, G, rest, row, e)
            s[USED] += 1.0
            out[t] = e
        else:
            out[t] = np.nan
            s[REJECTED] += 1.0
        t += 1
    return t


@compiled(error_model="numpy")
def _govern(s: Array, p: int) -> None:
    """Reset where it is due, and choose the factor with which P cannot pass its limit before the next look."""
    a, q = HEAD + p, 2 * p * p
    if s[RESET_EVERY] > 0 and s[USED] > 0 and s[USED] % s[RESET_EVERY] == 0:
        s[a : a + q] = s[a + q : a + 2 * q]
        s[UNIT] *= max(1.0, noise_of_now(s))
    if s[UNIT] == 0 and s[NOISE_WEIGHT] > s[SETTLED]:
        s[UNIT] = s[NOISE_SUM] / s[NOISE_WEIGHT]
    s[NOW] = noise_of_now(s)
    _, F, _, rest = _views(s, p)
    prior, total = rest[1], 0.0
    for i in range(p):
        now = variance(F, i)
        if s[VAGUE] > 0:
            prior[i] = min(prior[i], _WORSE * now)
        total += now / (prior[i] * p * s[LIMIT])
    s[FACTOR_NOW] = min(1.0, total ** (1.0 / s[EVERY])) if total > s[FACTOR] ** s[EVERY] else s[FACTOR]
    s[TYPICAL] = 0.1 * p / min(s[USED] + 1.0, s[MEMORY])


@compiled(error_model="numpy")
def regress(s: Array, phi: Array, y: Array, out: Array) -> None:
    """Take in rows of phi (n, p) and y (n,); write errors of prediction into out (n,), NaN where one is rejected."""
    p, t = int(s[SIZE]), 0
    four = p == 4 and s[KIND] == LEAST_SQUARES
    while t < y.size:
        until = np.inf
        if s[KIND] < LMS:
            until = (np.floor(s[USED] / s[EVERY]) + 1.0) * s[EVERY]
            if s[RESET_EVERY] > 0:
                until = min(until, (np.floor(s[USED] / s[RESET_EVERY]) + 1.0) * s[RESET_EVERY])
        t = _four(s, phi, y, out, t, until) if four else _any(s, p, phi, y, out, t, until)
        if s[USED] == until:
            _govern(s, p)


@compiled(error_model="numpy")
def tapped(past: Array, table: Table, x: Array, rows: Array, theta: Array, first: int) -> None:
    """Fill rows (n, n_columns) from signals x (n, n_channels) and from what came before, past (n_lags, n_channels).

    `table` holds a channel, a lag and a sign for each column; channel -1 is the constant 1. With `theta` (p,), the last
    channel of x is made here: the output of a model without noise, from columns `first`, ... and these coefficients.
    The row of a sample that holds a number that is not finite begins with NaN.
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
