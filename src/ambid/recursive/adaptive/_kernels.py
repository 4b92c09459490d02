"""Compiled recursions in U-D factors, P = V^T diag(D) V with V the transposed unit triangle.

Two rank-one steps make them all: Bierman's measurement update (Bierman 1977, ch. V.3) and the positive update of Agee
and Turner. Both keep D positive whatever is rounded. With four coefficients all state stays in registers.

A recursion is one array, since a call from Python costs by the number of arrays: head | estimate p | factors | factors
at the start | walk p | prior variance p | work 3 p. The factors are those of P, D p and V p p, and of its companion,
E p and W p p: the information of squared weights for least squares, else the covariance of the error.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled

# Places in the head of the one array of a recursion. They stand in this file because compiled code is cached by it.
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
def _views(s: Array, p: int) -> tuple[Array, Array, Array, Array, Array]:
    """Return estimate, D, V (flat), E, W (flat)."""
    a, q = HEAD + p, p * p
    b = a + p + q
    return s[HEAD:a], s[a : a + p], s[a + p : b], s[b : b + p], s[b + p : b + p + q]


@compiled(error_model="numpy")
def _rest(s: Array, p: int) -> tuple[Array, Array, Array, Array, Array]:
    """Return variances of the walk, prior variances and three vectors to work with."""
    rest = s[HEAD + p + 4 * (p + p * p) :].reshape(5, p)
    return rest[0], rest[1], rest[2], rest[3], rest[4]


@compiled(error_model="numpy")
def _down(p: int, D: Array, V: Array, phi: Array, f: Array, k: Array, r: float) -> float:
    """P - P φ φᵀ P / α, α = r + φᵀ P φ; leaves P φ in k and returns α (Bierman 1977, p. 100)."""
    for j in range(p):
        x = phi[j]
        for i in range(j):
            x += V[j * p + i] * phi[i]
        f[j] = x
    alpha = r
    for j in range(p):
        before = alpha
        v = D[j] * f[j]
        alpha = before + v * f[j]
        D[j] *= before / alpha
        part = -f[j] / before
        for i in range(j):
            x = V[j * p + i]
            V[j * p + i] = x + part * k[i]
            k[i] += v * x
        k[j] = v
    return alpha


@compiled(error_model="numpy")
def _up(p: int, D: Array, V: Array, a: Array) -> None:
    """P + a aᵀ (Agee and Turner); `a` is used up."""
    total, inverse = 1.0, 1.0
    for j in range(p - 1, -1, -1):
        x = a[j]
        q = x / D[j]
        total += q * x
        D[j] *= total * inverse
        inverse = 1.0 / total
        b = q * inverse
        for i in range(j):
            a[i] -= x * V[j * p + i]
            V[j * p + i] += b * a[i]


@compiled(error_model="numpy")
def _quadratic(p: int, D: Array, V: Array, x: Array) -> float:
    """Return xᵀ P x."""
    total = 0.0
    for j in range(p):
        f = x[j]
        for i in range(j):
            f += V[j * p + i] * x[i]
        total += D[j] * f * f
    return total


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
def _any(s: Array, p: int, phi: Array, y: Array, out: Array, t: int, until: float) -> int:
    """Least squares on samples t, ... until so many have been used: P and the information of squared weights."""
    theta, D, V, E, W = _views(s, p)
    _, _, f, k, a = _rest(s, p)
    grow, shrink, now = 1.0 / s[FACTOR_NOW], s[FACTOR_NOW] * s[FACTOR_NOW], s[NOW]
    while t < y.size and s[USED] < until:
        row, e = phi[t], y[t]
        for j in range(p):
            e -= row[j] * theta[j]
            a[j] = np.sqrt(now) * row[j]
        if not (_quadratic(p, D, V, row) + e * e < _HUGE):
            out[t] = np.nan
            s[REJECTED] += 1.0
            t += 1
            continue
        for j in range(p):
            D[j] *= grow
            E[j] *= shrink
        alpha = _down(p, D, V, row, f, k, 1.0)
        for j in range(p):
            theta[j] += k[j] * (e / alpha)
        _add_noise(s, e, min(_quadratic(p, E, W, k) / now, alpha - 1.0), alpha - 1.0)
        _up(p, E, W, a)
        s[USED] += 1.0
        out[t] = e
        t += 1
    return t


@compiled(error_model="numpy")
def _four(s: Array, phi: Array, y: Array, out: Array, t: int, until: float) -> int:
    """Do as `_any` for four coefficients, all in registers: d, u are the factors of P; g, w those of its companion."""
    theta, D, V, E, W = _views(s, 4)
    th0, th1, th2, th3 = theta[0], theta[1], theta[2], theta[3]
    d0, d1, d2, d3 = D[0], D[1], D[2], D[3]
    u10, u20, u21, u30, u31, u32 = V[4], V[8], V[9], V[12], V[13], V[14]
    g0, g1, g2, g3 = E[0], E[1], E[2], E[3]
    w10, w20, w21, w30, w31, w32 = W[4], W[8], W[9], W[12], W[13], W[14]
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
    D[0], D[1], D[2], D[3] = d0, d1, d2, d3
    V[4], V[8], V[9], V[12], V[13], V[14] = u10, u20, u21, u30, u31, u32
    E[0], E[1], E[2], E[3] = g0, g1, g2, g3
    W[4], W[8], W[9], W[12], W[13], W[14] = w10, w20, w21, w30, w31, w32
    s[NOISE_SUM], s[NOISE_WEIGHT], s[USED], s[REJECTED] = noise, weight, used, rejected
    return t


@compiled(error_model="numpy")
def _joseph(p: int, E: Array, W: Array, K: Array, phi: Array, f: Array, k: Array, r: float) -> float:
    """C becomes (I - Kφᵀ) C (I - Kφᵀ)ᵀ + r K Kᵀ for any gain: the best gain's, and a square of what K differs from it.

    Returns φᵀCφ of before; K is used up.
    """
    alpha = _down(p, E, W, phi, f, k, r)
    root = np.sqrt(alpha)
    for j in range(p):
        K[j] = root * K[j] - k[j] / root
    _up(p, E, W, K)
    return alpha - r


@compiled(error_model="numpy")
def _filtered(s: Array, p: int, phi: Array, y: Array, out: Array, t: int, until: float) -> int:
    """Kalman form: P is widened along φ (directional) or by a random walk, then takes in the sample."""
    theta, D, V, E, W = _views(s, p)
    walk, _, f, k, a = _rest(s, p)
    directional = s[KIND] == DIRECTIONAL
    grow = 1.0 / s[FACTOR_NOW] - 1.0
    while t < y.size and s[USED] < until:
        row, e = phi[t], y[t]
        for j in range(p):
            e -= row[j] * theta[j]
        if not (_quadratic(p, D, V, row) + e * e < _HUGE):
            out[t] = np.nan
            s[REJECTED] += 1.0
            t += 1
            continue
        if directional:
            _widen_along(p, D, V, row, grow, a)
        else:
            for i in range(p):
                a[:] = 0.0
                a[i] = np.sqrt(walk[i])
                _up(p, D, V, a)
        alpha = _down(p, D, V, row, f, k, 1.0)
        for j in range(p):
            a[j] = k[j] / alpha
            theta[j] += a[j] * e
        spread = alpha - 1.0  # not less than what C says, but where the noise has just fallen
        if directional:
            spread = min(spread, _quadratic(p, E, W, row) / noise_of_now(s))
        _add_noise(s, e, spread, alpha - 1.0)
        if directional:
            _joseph(p, E, W, a, row, f, k, noise_of_now(s))
        s[USED] += 1.0
        out[t] = e
        t += 1
    return t


@compiled(error_model="numpy")
def _widen_along(p: int, D: Array, V: Array, phi: Array, grow: float, a: Array) -> None:
    """P + (1/λ - 1) φ φᵀ / (φᵀ P⁻¹ φ): only the part of the information that φ meets is forgotten (Cao-Schwartz)."""
    a[:] = phi
    met = 0.0
    for j in range(p - 1, -1, -1):
        met += a[j] / D[j] * a[j]
        for i in range(j):
            a[i] -= a[j] * V[j * p + i]
    if 0.0 < met < _HUGE:
        root = np.sqrt(grow / met)
        for j in range(p):
            a[j] = root * phi[j]
        _up(p, D, V, a)


@compiled(error_model="numpy")
def _govern(s: Array, p: int) -> None:
    """Reset where it is due, and choose the factor with which P cannot pass its limit before the next look."""
    a, q = HEAD + p, 2 * (p + p * p)
    if s[RESET_EVERY] > 0 and s[USED] > 0 and s[USED] % s[RESET_EVERY] == 0:
        s[a : a + q] = s[a + q : a + 2 * q]
        s[UNIT] *= max(1.0, noise_of_now(s))
    if s[UNIT] == 0 and s[NOISE_WEIGHT] > s[SETTLED]:
        s[UNIT] = s[NOISE_SUM] / s[NOISE_WEIGHT]
    s[NOW] = noise_of_now(s)
    _, D, V, _, _ = _views(s, p)
    _, prior, _, _, _ = _rest(s, p)
    size = 0.0
    for i in range(p):
        variance = D[i]
        for j in range(i + 1, p):
            variance += D[j] * V[j * p + i] ** 2
        if s[VAGUE] > 0:
            prior[i] = min(prior[i], _WORSE * variance)
        size += variance / (prior[i] * p * s[LIMIT])
    s[FACTOR_NOW] = min(1.0, size ** (1.0 / s[EVERY])) if size > s[FACTOR] ** s[EVERY] else s[FACTOR]
    s[TYPICAL] = 0.1 * p / min(s[USED] + 1.0, s[MEMORY])


@compiled(error_model="numpy")
def _pause(s: Array) -> float:
    """Return the number of used samples at which to look again."""
    until = float((np.floor(s[USED] / s[EVERY]) + 1.0) * s[EVERY])
    if s[RESET_EVERY] > 0:
        until = min(until, (np.floor(s[USED] / s[RESET_EVERY]) + 1.0) * s[RESET_EVERY])
    return until


@compiled(error_model="numpy")
def least_squares(s: Array, phi: Array, y: Array, out: Array) -> None:
    """Exponential forgetting or none: take in rows of phi (n, p), y (n,); errors of prediction into out (n,)."""
    p, t = int(s[SIZE]), 0
    while t < y.size:
        until = _pause(s)
        t = _four(s, phi, y, out, t, until) if p == 4 else _any(s, p, phi, y, out, t, until)
        if s[USED] == until:
            _govern(s, p)


@compiled(error_model="numpy")
def kalman(s: Array, phi: Array, y: Array, out: Array) -> None:
    """Directional forgetting or a random walk; as `least_squares`."""
    p, t = int(s[SIZE]), 0
    while t < y.size:
        until = _pause(s)
        t = _filtered(s, p, phi, y, out, t, until)
        if s[USED] == until:
            _govern(s, p)


@compiled(error_model="numpy")
def gradient(s: Array, phi: Array, y: Array, out: Array) -> None:
    """LMS and normalised LMS with the exact covariance of their error; as `least_squares`."""
    p = int(s[SIZE])
    theta, _, _, E, W = _views(s, p)
    _, _, f, k, a = _rest(s, p)
    for t in range(y.size):
        row, e, power = phi[t], y[t], 0.0
        for j in range(p):
            e -= row[j] * theta[j]
            power += row[j] * row[j]
        if not (_quadratic(p, E, W, row) + power + e * e < _HUGE):
            out[t] = np.nan
            s[REJECTED] += 1.0
            continue
        step = s[STEP]
        if s[KIND] != LMS:
            step /= s[SMALL] + power
        elif step * power > 1.0:
            step = 1.0 / power
            s[LIMITED] += 1.0
        for j in range(p):
            a[j] = step * row[j]
            theta[j] += a[j] * e
        spread = _joseph(p, E, W, a, row, f, k, 1.0)
        leverage = step * power
        if leverage > 0.0:
            if s[TYPICAL] == 0.0:
                s[TYPICAL] = 0.1 * leverage
            _add_noise(s, e, spread, leverage)
            s[TYPICAL] += s[NOISE_RATE] * leverage / (leverage + s[TYPICAL]) * (0.1 * leverage - s[TYPICAL])
        s[USED] += 1.0
        out[t] = e
