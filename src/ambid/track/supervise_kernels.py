"""Compiled work on the small triangles of blocks: what they inform, and windows of them tested for a change.

Matrices here have five to fifteen rows: a call of the linear algebra library costs more than the sums themselves.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.square_root_kernels import project, shrink, variance
from ambid.track.rpem_kernels import fold

Counts = NDArray[np.int64]

_QUANTILE = 0.03  # share of quiet statistics above the point by which overdispersion is learned
_LARGEST_GAIN = 0.02  # of learning overdispersion
_SETTLE_GAIN = 12.0  # over the number of tests, while settling: one over the density of log chi-squared at that point
_RAISED = 1.5  # level of the unexplained part, over its usual one, from which no number is named


@compiled(error_model="numpy", fastmath={"contract"})
def deviations(R: Array, ridge: float, F: Array, work: Array, sd: Array) -> None:
    """Fill `sd` (p,) with the standard deviations that the triangle R (p, p) alone gives each number.

    The `ridge`, far below any information that matters, stands for what would be known otherwise. `F` (p, p) and `work`
    (2, p) are scratch.
    """
    p, f, k = R.shape[0], work[0], work[1]
    for i in range(p):
        for j in range(p):
            F[i, j] = 1.0 / (ridge * ridge) if i == j else 0.0
    for i in range(p):
        project(F, R[i], f)
        shrink(F, f, 1.0, k)
    for j in range(p):
        sd[j] = math.sqrt(variance(F, j))


@compiled(error_model="numpy", fastmath={"contract"})
def whiten(T: Array, before: Array, drift: Array, blocks: int, M: Array, X: Array) -> None:
    """Fill `X` (p, p + 1) with M^-1/2 [J rho], where M = I + J P J^T and rho = r + J q.

    `T` (p, p + 1) is [J r], `before` (p, p + 1) is [P q], P grows by `drift` (p,) in each block, `M` is scratch.
    All pivots of M are at least one whatever P is: rounding below that is put right.
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
    X: Array, rest: float, freedom: float, row: Array, marks: Array, tested: Counts, gain: float, noise: float,
    now: Array, found: Array,
) -> None:  # fmt: skip
    """Test one whitened window, and learn from it if `gain` is positive.

    `found` (10,): kind, 0 (length), 0 (first), hypothesis, its statistic, size, sd, joint, rest, noise; `now` (tests,):
    statistics of all hypotheses, of all numbers together, and of the unexplained part.
    """
    p, hypotheses = X.shape[0], tested.size
    joint, level = hypotheses, hypotheses + 1
    spread = rest / freedom if freedom >= 1.0 else 0.0
    for i in range(10):
        found[i] = 0.0
    found[3] = -1.0
    for t in range(level + 1):
        b, v, scale = 0.0, 1.0, math.exp(row[t])
        if t < joint:
            j, v = tested[t], 0.0
            for i in range(p):
                b += X[i, j] * X[i, p]
                v += X[i, j] * X[i, j]
            raw = b * b / v if v > 1e-30 else 0.0
        elif t == joint:
            raw = 0.0
            for i in range(p):
                raw += X[i, p] * X[i, p]
        elif freedom >= 1.0:  # a standard normal number for rest/freedom of a chi-squared rest (Wilson, Hilferty 1931)
            v = 2.0 / (9.0 * freedom)
            raw = ((spread / noise) ** (1.0 / 3.0) - (1.0 - v)) ** 2 / v
        else:
            raw = 0.0
        if gain > 0.0:  # so that a share `_QUANTILE` lies above the mark times the scale, which is at least one
            row[t] = max(row[t] + gain * ((1.0 if raw > marks[1, t] * scale else 0.0) - _QUANTILE), 0.0)
        if t < level:
            scale = max(scale, spread)
        now[t] = raw / scale
        if t < joint and now[t] > found[4]:
            found[3], found[4], found[5], found[6] = float(t), now[t], -b / v, math.sqrt(scale / v)
    found[7], found[8], found[9] = now[joint], now[level], spread / noise
    if found[4] > marks[0, 0]:
        # the one number stands for the change if what it leaves is chance or less than what it explains; where the
        # unexplained part rose as well, this is the transient of a change, or none that it could name
        clean = found[8] <= marks[0, level] or found[9] < _RAISED
        found[0] = 1.0 if clean and found[7] - found[4] < max(marks[0, joint], found[4]) else 2.0
    elif found[7] > marks[0, joint]:
        found[0] = 2.0
    elif found[8] > marks[0, level]:
        found[0] = 3.0


@compiled(error_model="numpy")
def watch(
    bases: Array, notes: Array, counts: Counts, history: Array, learned: Array, marks: Array, tested: Counts,
    drift: Array, state: Array, scratch: tuple[Array, Array, Array, Array], now: Array, found: Array, result: Array,
) -> None:  # fmt: skip
    """Test the windows that end with the newest block, learn how much larger than chance quiet statistics are.

    `bases` (levels, 4, p, p + 1): the last triangles [J r] of 2^level blocks, the newest block among them; `notes`
    (levels, 4, 4): their rest, freedom, first sample, first block. `counts` (levels,): bases so far. `history`
    (ring, p, p + 1): [P q] before each block; all q relative to the point of the triangles. `learned` (windows, tests):
    log of overdispersion. `marks` (2, tests): threshold of each test, and the point that few quiet statistics pass.
    `tested` (hypotheses,): column of each. `drift` (p,): growth of variance per block. `state` (6,): log of the noise
    level, blocks to wait until statistics are quiet again, gain of learning, gain of the noise level, longest window,
    whether to alarm. `scratch`: (p, p + 1), (p + 1, p), (p, p), (p, p + 1); `now` (tests,), `found` (10,). `result`
    (10 + tests,): kind, blocks, first sample, hypothesis, its statistic, size, sd, joint, rest, noise; all statistics.
    """
    levels, _, p, width = bases.shape
    tests, ring, longest = now.size, history.shape[0], int(state[4])
    result[0] = 0.0
    acc, other, M, X = scratch
    noise, calm, best = math.exp(state[0]), state[1] <= 0.0, 0.0
    state[1] -= 0.0 if calm else 1.0
    newest, freedom_now = 0.0, 0.0
    for level in range(levels):
        n_bases, rest, freedom = counts[level], 0.0, 0.0
        gain = 0.0
        if calm and state[5] > 0.0:  # long windows are looked at less often
            gain = min(state[2] * (1 << level), _LARGEST_GAIN)
        elif calm:  # as fast as a quantile can be learned
            gain = _SETTLE_GAIN / (n_bases + 2.0 * _SETTLE_GAIN)
        for m in range(1, min(n_bases, 4) + 1):
            length = m << level
            if length > longest:
                break
            slot = (n_bases - m) % 4
            base, note = bases[level, slot], notes[level, slot]
            for i in range(p):
                for j in range(width):
                    if m == 1:
                        acc[i, j] = base[i, j]
                    else:
                        other[j, i] = base[i, j]
            if m > 1:
                fold(acc, other, p, width - p)
            rest += note[0]
            freedom += note[1]
            if length == 1:
                newest, freedom_now = rest, freedom
            if m == 2 and n_bases % 2 == 0 and level + 1 < levels:
                up = counts[level + 1] % 4
                for i in range(p):
                    for j in range(width):
                        bases[level + 1, up, i, j] = acc[i, j]
                above = notes[level + 1, up]
                above[0], above[1], above[2], above[3] = rest, freedom, note[2], note[3]
            if level > 0 and m < 3:
                continue
            whiten(acc, history[int(note[3]) % ring], drift, length, M, X)
            window = m - 1 if level == 0 else 2 * level + m - 1
            _test(X, rest, freedom, learned[window], marks, tested, gain, noise, now, found)
            if found[0] == 0.0 or state[5] == 0.0:
                continue
            # a window that names a number comes before one that cannot, then the one that shows most
            order = found[4] / marks[0, 0] + 1e9
            if found[0] > 1.0:
                order = max(found[7] / marks[0, tests - 2], found[8] / marks[0, tests - 1])
            if order > best:
                best = order
                for i in range(10):
                    result[i] = found[i]
                result[1], result[2] = float(length), note[2]
                for i in range(tests):
                    result[10 + i] = now[i]
        if n_bases % 2 == 1 or level + 1 == levels:
            break
        counts[level + 1] += 1
    if result[0] > 0.0:
        state[1] = state[4]
    elif calm and freedom_now >= 1.0:
        middle = noise * (1.0 - 2.0 / (9.0 * freedom_now)) ** 3
        state[0] += state[3] if newest / freedom_now > middle else -state[3]
