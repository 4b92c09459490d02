"""Compiled recursion of the polynomial predictor, its gradients and the U-D filter of its coefficients. Each signal is
a row of one buffer, whose end becomes the history of a new beginning; `plan_of` tells what is filtered by what.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.square_root_kernels import project, shrink, variance

Table = NDArray[np.int64]

# of `meta`: sizes; where filters of inputs, residual, gradients and unknown states end; where the other tables begin
_N, _NU, _LONGEST, _INPUT, _RESIDUAL, _GRADIENT, _STATES, _TERMS, _COLUMNS, _STABLE, _N_STABLE, _V, _E, _W = range(14)
_POS, _FILL, _RINGING, _USED, _REJECTED, _WAITED, _PROJECTED, _HELD, _LEARNT, _HOLD = range(10)  # of `count`
_FORGET, _SQUARES, _WEIGHT, _NOISE, _LEVELS = range(5)  # of `real`
_FIRST = 2  # free coefficient

_RADIUS = 0.99999  # roots of C and F stay inside
_RUNG_OUT = 0.01  # of what was unknown at a new beginning: what is left then counts for nothing
_LONGEST_RING = 5000  # a root at the border would never let it
_EVERY = 64  # most samples between looks at the growth of the covariance; not more than half the memory


@compiled
def filter_column(plan: Table, meta: Table, first: int, last: int, coef: Array, s: Array, t: int) -> None:
    """Run filters `first` to `last` at column t."""
    for f in range(first, last):
        row, over, n = plan[f, 0], plan[f, 1], plan[f, 2]
        x = 0.0
        for k in range(meta[_TERMS] + plan[f, 3], meta[_TERMS] + plan[f, 4]):
            source, c, at = plan[k, 0], plan[k, 1], t - plan[k, 3]
            for j in range(plan[k, 2]):
                x += coef[c + j] * s[source, at - j]
        for j in range(n):
            x -= coef[over + j] * s[row, t - 1 - j]
        s[row, t] = x


@compiled
def _stable(theta: Array, first: int, n: int, work: Array) -> bool:
    """Whether all roots of 1 + theta[first] q^-1 + ... are inside `_RADIUS` (Schur-Cohn)."""
    if n == 1:
        return bool(np.abs(theta[first]) < _RADIUS)
    if n == 2:
        p, q = theta[first] / _RADIUS, theta[first + 1] / (_RADIUS * _RADIUS)
        return bool(np.abs(q) < 1.0 and np.abs(p) < 1.0 + q)
    scale = 1.0
    for k in range(n):
        scale /= _RADIUS
        work[k] = theta[first + k] * scale
    for m in range(n, 0, -1):
        r = work[m - 1]
        if not np.abs(r) < 1.0:
            return False
        rest = 1.0 - r * r
        for k in range(m // 2):
            a, b = work[k], work[m - 2 - k]
            work[k] = (a - r * b) / rest
            work[m - 2 - k] = (b - r * a) / rest
    return True


@compiled
def follow(plan: Table, meta: Table, theta: Array, coef: Array, work: Array) -> int:
    """Let the filters have theta; return 1 if roots of C or F had to be drawn towards zero to keep them stable."""
    drawn = 0
    for j in range(theta.size):
        coef[_FIRST + j] = theta[j]
    for k in range(meta[_STABLE], meta[_STABLE] + meta[_N_STABLE]):
        first, n, shrink = plan[k, 0], plan[k, 1], 1.0 - _RADIUS
        while not _stable(coef, first, n, work):
            drawn, factor = 1, 1.0
            for j in range(n):
                factor *= max(1.0 - shrink, 0.0)
                coef[first + j] = theta[first - _FIRST + j] * factor
            shrink *= 2.0
    return drawn


# The arrays of a recursion, as `State.arrays` has them: plan, where its parts begin, counts, settings, coefficients,
# those that filters take, factors of P, scores, limits of P, signals, and room for gradient, gain and a product
Recursion = tuple[Table, Table, Table, Array, Array, Array, Array, Array, Array, Array, Array]


@compiled
def _wait(recursion: Recursion, t: int) -> None:
    """Take one more sample of history: noise counts as zero, so that the first w with a memory is what is left of A y,
    its error of the noise's size. Once it is long enough, ones stand for the unknown states of F and C: when their
    response is forgotten, the waiting ends.
    """
    plan, meta, count, _, _, coef, _, _, _, s, _ = recursion
    count[_WAITED] += 1
    if count[_FILL] < meta[_LONGEST]:
        s[meta[_E], t] = 0.0
        if meta[_W] >= 0:
            s[meta[_W], t] += s[meta[_V], t]
            s[meta[_V], t] = 0.0
        count[_FILL] += 1
        if count[_FILL] >= meta[_LONGEST]:
            for f in range(meta[_GRADIENT], meta[_STATES]):
                count[_RINGING] = 1
                for j in range(plan[f, 2]):
                    s[plan[f, 0], t - j] = 1.0
        return
    filter_column(plan, meta, meta[_GRADIENT], meta[_STATES], coef, s, t)
    most = 0.0
    for f in range(meta[_GRADIENT], meta[_STATES]):
        for j in range(plan[f, 2]):
            most = max(most, np.abs(s[plan[f, 0], t - j]))
    count[_RINGING] += 1
    if most < _RUNG_OUT or count[_RINGING] > _LONGEST_RING:
        count[_RINGING] = 0


@compiled
def _learn(recursion: Recursion, t: int) -> None:
    """Make one Gauss-Newton step (Ljung & Söderström 1983, sec. 3.4), from where the filters stand to where the data
    say: two places only while C or F would be unstable.
    """
    plan, meta, count, real, theta, coef, F, S, limit, s, room = recursion
    psi, gain, work = room[0, : theta.size], room[1, : theta.size], room[2, : theta.size]
    n, e = theta.size, s[meta[_E], t]
    for j in range(n):
        k = meta[_COLUMNS] + j
        psi[j] = plan[k, 2] * s[plan[k, 0], t - plan[k, 1]]
        e -= psi[j] * (theta[j] - coef[_FIRST + j])
    forget = keep = real[_FORGET]
    lost = 1.0 - forget
    every = _EVERY if lost * _EVERY <= 0.5 else max(1, int(0.5 / lost))
    if count[_LEARNT] % every == 0 and lost > 0.0:
        # not less than at the start: a signal that stands still has no noise, and its P would grow without end
        noise = max(real[_SQUARES] / real[_WEIGHT], real[_NOISE]) * (1.0 - lost) ** -every
        count[_HOLD] = 0
        for i in range(n):  # as large as it may be at the next look
            if variance(F, i) * noise > limit[i]:
                count[_HOLD] = 1
    if count[_HOLD]:
        forget = 1.0
        count[_HELD] += 1
    for j in range(n):
        F[j, j] /= forget
    project(F, psi, work)
    size = shrink(F, work, 1.0, gain)
    # forgotten while the coefficients are held, too: after a long calm the noise would be taken for small too long
    real[_SQUARES] = keep * real[_SQUARES] + e * e / size
    real[_WEIGHT] = keep * real[_WEIGHT] + 1.0
    # the noise of the moment goes with what the moment says: a calm later on makes old samples no better
    noise = real[_SQUARES] / real[_WEIGHT]
    for i in range(S.shape[0]):
        for j in range(i + 1):
            S[i, j] = forget * forget * S[i, j] + noise * psi[i] * psi[j]
    for j in range(n):
        theta[j] += gain[j] * (e / size)
    level = coef[_FIRST + n - 1]
    count[_PROJECTED] += follow(plan, meta, theta, coef, work)
    # the past of v and e is linear in the constant, and its first steps may be large
    step, ones = coef[_FIRST + n - 1] - level, plan[meta[_COLUMNS] + n - 1, 0]
    for k in range(1, meta[_LONGEST] + 1):
        s[meta[_V], t - k] -= step
        if meta[_E] != meta[_V]:
            s[meta[_E], t - k] -= step * s[ones, t - k]
    filter_column(plan, meta, meta[_INPUT], meta[_RESIDUAL], coef, s, t)
    count[_LEARNT] += 1


@compiled
def run(u: Array, y: Array, errors: Array, learn: bool, recursion: Recursion) -> None:
    """Take in samples u (m, n_inputs), y (m,); write the errors of prediction; `learn` false leaves coefficients."""
    plan, meta, count, real, _, coef, _, _, _, s, _ = recursion
    longest, width = meta[_LONGEST], s.shape[1]
    for k in range(y.size):
        errors[k] = np.nan
        t = count[_POS]
        if t == width:
            for row in range(s.shape[0]):
                for j in range(longest):
                    s[row, j] = s[row, width - longest + j]
            t = longest
        s[0, t], s[1, t], unknown = y[k] - real[_LEVELS], 1.0, 0.0
        for i in range(meta[_NU]):
            s[2 + i, t] = u[k, i] - real[_LEVELS + 1 + i]
            unknown += u[k, i] * 0.0
        filter_column(plan, meta, int(0.0), meta[_RESIDUAL], coef, s, t)
        e = s[meta[_E], t]
        if not np.isfinite(e * e + y[k] * 0.0 + unknown):  # or too large to compute with: all signals are forgotten
            count[_REJECTED] += 1
            count[_POS], count[_FILL], count[_RINGING] = longest, 0, 0
            for row in range(s.shape[0]):
                for j in range(width):
                    s[row, j] = 0.0
            continue
        count[_POS] = t + 1
        count[_USED] += 1
        if count[_FILL] < longest or count[_RINGING]:
            _wait(recursion, t)
        else:
            errors[k] = e
            if learn:
                _learn(recursion, t)
        filter_column(plan, meta, meta[_RESIDUAL], meta[_GRADIENT], coef, s, t)
