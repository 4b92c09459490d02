"""Score test of further regressors for one residual, the estimated numbers accounted for.

The residuals of a consistent estimate are e0 - J (theta - theta0): with J projected out of the regressors, what
is left does not see the error of the estimate, whichever estimator made it (Neyman's C(alpha) test; for innovations
Ljung 1999, sec. 16.6, Soederstrom and Stoica 1989, sec. 11.2). If the model is right, the part of the residual that the
regressors explain is chi-squared, and each correlation is normal with the variance computed here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array

_SEEN = 1e-3  # part of a regressor that J must leave for it to be tested
_PREDICTED = 1e-16  # power from which a residual is more than rounding
_ROWS = 1000  # of a block
_DEPENDENT = 1e-9  # singular value from which a direction of J counts


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Score:
    """Outcome of a score test."""

    p: float  # probability of at least this much if the model is right
    statistic: float
    degrees: int
    correlation: Array  # (n_regressors,), correlation coefficient of the residual with each regressor
    # (n_regressors,), its standard deviation if the model is right; smaller than 1/sqrt(N) where estimated numbers
    # take part
    sd: Array


def score(e: Array, J: Array, regressors: Array, *, colour: Array | None = None) -> Score:
    """Test whether regressors explain a residual.

    `e`: (n_used,); `J`: (n_used, n_directions), derivative of the prediction by what was estimated; `regressors`:
    (n_used, n_regressors), known before each residual; or, with `colour`, independent of all residuals; `colour`: (n +
    1,).
    """
    from scipy.special import chdtrc

    n, rows = e.size, np.hstack([J, np.ones((e.size, 1)), regressors, e[:, None]])
    if colour is None:  # inner products are all that counts: those of the triangle are the same
        rows = triangle(rows)
    Q = basis(rows[:, : J.shape[1] + 1])
    L, e = rows[:, J.shape[1] + 1 : -1], rows[:, -1]
    size = np.linalg.norm(L, axis=0)
    L = L / np.where(size > 0, size, 1.0)
    for _ in range(2):  # twice is enough (Kahan): the first pass loses what cancels
        L = L - Q @ (Q.T @ L)
    rest = e - Q @ (Q.T @ e)
    power = float(rest @ rest)
    if power <= _PREDICTED * float(e @ e) or not L.shape[1]:
        nothing = np.zeros(L.shape[1])
        return Score(p=1.0, statistic=0.0, degrees=0, correlation=nothing, sd=nothing)
    variance = power / max(n - Q.shape[1], 1)
    inner = rest @ L
    _, s, right = np.linalg.svd(triangle(L), full_matrices=False)
    kept = s > _SEEN
    z = (right[kept] @ inner) / s[kept]
    if colour is None:
        spread = np.sqrt(np.sum(L**2, axis=0))
        statistic = float(z @ z) / variance
    else:
        M = coloured(L, colour)
        gain = variance / power_gain(colour)
        spread = np.sqrt(np.sum(M**2, axis=0) * gain / variance)
        W = triangle(M @ (right[kept].T / s[kept]))
        statistic = float(np.sum(np.linalg.lstsq(W.T, z, rcond=1e-8)[0] ** 2)) / gain
    degrees = int(np.count_nonzero(kept))
    return Score(
        p=float(chdtrc(degrees, statistic)) if degrees else 1.0,
        statistic=statistic,
        degrees=degrees,
        correlation=inner / np.sqrt(power),
        sd=np.asarray(spread * np.sqrt(variance / power)),
    )


def instrumental_score(e: Array, J: Array, instruments: Array, *, colour: Array) -> Score:
    """Test whether instruments explain a residual that feedback makes depend on `J`.

    There J cannot be projected out, because the noise is part of it. Instead only those combinations of the instruments
    count that are orthogonal to J, so that the error of the estimate does not reach them (the overidentification
    test of Sargan 1958).

    `e`: (n_used,); `J`: (n_used, n_directions); `instruments`: (n_used, n_regressors), independent of all noise;
    `colour`: (n + 1,), autoregression of the residuals. Returns correlations are those with the instruments themselves.
    """
    centred, rest = instruments - instruments.mean(axis=0), e - e.mean()
    size = np.linalg.norm(centred, axis=0)
    L = centred / np.where(size > 0, size, 1.0)
    length = np.linalg.norm(J, axis=0)
    u, s, _ = np.linalg.svd(L.T @ (J / np.where(length > 0, length, 1.0)))
    rank = int(np.count_nonzero(s > _DEPENDENT * max(float(s[0]), 1e-300))) if s.size else 0
    inner = score(rest, np.zeros((e.size, 0)), L @ u[:, rank:], colour=colour)
    power = float(np.linalg.norm(rest))
    return Score(
        p=inner.p,
        statistic=inner.statistic,
        degrees=inner.degrees,
        correlation=rest @ L / power if power > 0 else np.zeros(L.shape[1]),
        sd=np.full(L.shape[1], 1 / np.sqrt(e.size)),
    )


def basis(J: Array) -> Array:
    """Return an orthonormal basis of the columns of a matrix.

    `J`: (n, n_columns). Returns (n, n_independent).
    """
    size = np.linalg.norm(J, axis=0)
    used = J[:, size > 0] / size[size > 0]
    if not used.shape[1]:
        return np.zeros((J.shape[0], 0))
    Q, R = np.linalg.qr(used)
    u, s, _ = np.linalg.svd(R)
    return np.asarray(Q @ u[:, s > _DEPENDENT * s[0]])


def triangle(a: Array) -> Array:
    """Return the factor R of a matrix Q R.

    `a`: (n, n_columns). Returns (min(n, n_columns), n_columns).
    """
    block = max(_ROWS, 4 * a.shape[1])
    R = np.zeros((0, a.shape[1]))
    for first in range(0, a.shape[0], block):  # blocks that stay in the cache
        R = np.asarray(np.linalg.qr(np.vstack([R, a[first : first + block]]), mode="r"), dtype=np.float64)
    return R


def autoregression(e: Array) -> Array:
    """Describe the colour of a residual: an autoregression by Yule-Walker, its order by BIC.

    `e`: (n_used,). Returns (n + 1,), [1, a1, ..., an], stable; [1] for a white residual.
    """
    n = e.size
    longest = max(1, min(int(10 * np.log10(n)), n // 10))
    v = e - e.mean()
    r = np.array([v[k:] @ v[: n - k] for k in range(longest + 1)]) / n
    best, a, power = np.ones(1), np.ones(1), float(r[0])
    if power <= 0:
        return best
    least = n * np.log(power)
    for k in range(1, longest + 1):  # Levinson's recursion
        reflection = -float(a @ r[k:0:-1]) / power
        a = np.concatenate([a, [0.0]]) + reflection * np.concatenate([[0.0], a[::-1]])
        power *= 1 - reflection**2
        if power <= 0:
            break
        bic = n * np.log(power) + k * np.log(n)
        if bic < least:
            least, best = bic, a
    return best


def coloured(L: Array, a: Array) -> Array:
    """Return H' L for residuals H w of white w: L filtered by 1/A backwards in time.

    `L`: (n_used, n_columns); `a`: (n + 1,). Returns (n_used, n_columns).
    """
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], a, L[::-1], axis=0)[::-1])


def power_gain(a: Array) -> float:
    """Return the variance of a residual over that of the white noise behind it.

    `a`: (n + 1,).
    """
    from scipy.signal import lfilter

    impulse = np.zeros(20_000)
    impulse[0] = 1.0
    return float(np.sum(lfilter([1.0], a, impulse) ** 2))
