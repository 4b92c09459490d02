"""Compiled recursion of instrumental variables by orthogonal rotations.

One array: head | estimate p | R m (m + p + 1) | T p p | long-run covariance m m | ring lags m | its sum m | prior p |
size of the instruments m | work. R is the upper part of the triangle of the weighted rows [ζᵀ φᵀ y], T the triangle of
its columns of φ.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled

# Places in the head of the one array of the recursion
(
    SIZE,  # p
    INSTRUMENTS,  # m
    LAGS,
    USED,
    REJECTED,
    SINGULAR,
    FACTOR,  # of forgetting, as asked for
    FACTOR_NOW,
    EVERY,  # samples between two looks at the limit
    LIMIT,
    MEMORY,
    NOISE_RATE,
    NOISE_SUM,
    NOISE_WEIGHT,
    SUM_OF_SQUARES,  # of the weights of the samples
    PRIOR_LEFT,  # squared weight that the prior still has
    VAGUE,  # 1 where no prior was given: the limit then is counted from the best variances so far
) = range(17)
HEAD = 20

_HUGE = 1e200
_SINGULAR = 1e-12
_LITTLE = 0.1  # of the usual leverage, at which a sample counts half
_WORSE = 1e9  # times its best variance: the prior variance, for the limit, of a coefficient without prior


@compiled(error_model="numpy")
def _take(R: Array, row: Array, m: int, root: float) -> None:
    """Weigh the rows of R (m, m + p + 1) by `root` and rotate a new row into them; what remains of it is dropped."""
    for i in range(m):
        r, x = root * R[i, i], row[i]
        length = np.hypot(r, x)
        c, s = (r / length, x / length) if length > 0 else (1.0, 0.0)
        R[i, i] = length
        for j in range(i + 1, row.size):
            a, b = root * R[i, j], row[j]
            R[i, j] = c * a + s * b
            row[j] = c * b - s * a


@compiled(error_model="numpy")
def _solve(R: Array, T: Array, work: Array, theta: Array, m: int, p: int) -> bool:
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
        return False
    for i in range(p):
        for j in range(i, p):
            T[i, j] = work[i, j]
    for i in range(p - 1, -1, -1):
        x = work[i, p]
        for j in range(i + 1, p):
            x -= T[i, j] * theta[j]
        theta[i] = x / T[i, i]
    return True


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
def _govern(s: Array, T: Array, prior: Array, unit: Array, solved: Array) -> None:
    """Choose the factor of forgetting that keeps the mean of the variances over the prior's below its limit."""
    p = prior.size
    size = 0.0
    for i in range(p):
        unit[:] = 0.0
        unit[i] = 1.0
        variance = _length(T, unit, solved)
        if s[VAGUE] > 0:
            prior[i] = min(prior[i], _WORSE * variance)
        size += variance / prior[i]
    size /= p * s[LIMIT]
    s[FACTOR_NOW] = s[FACTOR]
    if size > s[FACTOR] ** s[EVERY]:
        s[FACTOR_NOW] = min(1.0, size ** (1.0 / s[EVERY]))


@compiled(error_model="numpy")
def _add_noise(s: Array, omega: Array, ring: Array, total: Array, zeta: Array, weighted: float, share: float) -> None:
    """Long-run covariance of ζ e with Bartlett's weights: the mean square of its sums over `lags` samples."""
    m, lags = zeta.size, ring.shape[0]
    place = int(s[USED] % lags)
    for i in range(m):
        total[i] -= ring[place, i]
        ring[place, i] = zeta[i] * weighted
        total[i] += ring[place, i]
    if place == lags - 1:  # afresh, or rounding adds up
        for i in range(m):
            total[i] = 0.0
            for k in range(lags):
                total[i] += ring[k, i]
    keep = 1.0 - s[NOISE_RATE] * share
    for i in range(m):
        for j in range(i + 1):
            omega[i, j] = keep * omega[i, j] + share / lags * total[i] * total[j]
            omega[j, i] = omega[i, j]


@compiled(error_model="numpy")
def instrumental(s: Array, rows: Array, y: Array, out: Array) -> None:
    """Take in rows [φ, ζ] (n, p + m) and y (n,); errors of prediction into out (n,)."""
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
    unit, solved = s[a : a + p], s[a + p : a + 2 * p]
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
        phi, zeta = rows[t, :p], rows[t, p:]
        for j in range(m):
            new[j] = zeta[j]
        for j in range(p):
            new[m + j] = phi[j]
        new[m + p] = y[t]
        factor = s[FACTOR_NOW]
        spread = _length(T, phi, unit) / (1.0 + factor)
        _take(R, new, m, np.sqrt(factor))
        if not _solve(R, T, work, theta, m, p):
            s[SINGULAR] += 1.0
        _account(s, R, omega, ring, total, zeta, e / (1.0 + spread), 1.0 / (1.0 + spread), factor, work[:, 0])
        s[USED] += 1.0
        if s[USED] % s[EVERY] == 0:
            _govern(s, T, prior, unit, solved)
        out[t] = e


@compiled(error_model="numpy")
def _account(
    s: Array,
    R: Array,
    omega: Array,
    ring: Array,
    total: Array,
    zeta: Array,
    weighted: float,
    w: float,
    factor: float,
    solved: Array,
) -> None:
    """Track noise and weights, a sample by what its instruments add to those of before."""
    m = zeta.size
    leverage = _length(R[:, :m], zeta, solved)
    typical = _LITTLE * m / min(s[USED] + 1.0, s[MEMORY])
    share = leverage / (leverage + typical)
    _add_noise(s, omega, ring, total, zeta, weighted, share)
    keep = 1.0 - s[NOISE_RATE] * share
    s[NOISE_SUM] = keep * s[NOISE_SUM] + share * weighted * weighted
    s[NOISE_WEIGHT] = keep * s[NOISE_WEIGHT] + share * w
    s[SUM_OF_SQUARES] = factor * factor * s[SUM_OF_SQUARES] + (1.0 + _LITTLE) * share
    s[PRIOR_LEFT] *= factor * factor
