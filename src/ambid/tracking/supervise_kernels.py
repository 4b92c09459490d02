"""Compiled work on the small triangles of blocks: windows of them are tested for a change.

Matrices here have five to fifteen rows: a call of the linear algebra library costs more than the sums themselves.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.tracking.rpem_kernels import fold

Counts = NDArray[np.int64]

_QUANTILE = 0.03  # share of quiet statistics above the point by which overdispersion is learned
_LARGEST_GAIN = 0.02  # of learning overdispersion
_SETTLE_GAIN = 12.0  # over the number of tests, while settling: one over the density of log chi-squared at that point


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
    X: Array, rest: float, freedom: float, learned: Array, marks: Array, tested: Counts, gain: float, noise: float,
    row: Array,
) -> None:  # fmt: skip
    """Test one whitened window, and learn from it if `gain` is positive; see `watch` for `row`."""
    p, joint = X.shape[0], tested.size
    level = joint + 1
    spread = rest / freedom if freedom >= 1.0 else 0.0
    row[3], row[4] = -1.0, 0.0
    for t in range(level + 1):
        b, v, raw, scale = 0.0, 0.0, 0.0, math.exp(learned[t])
        if t < joint:
            j = tested[t]
            for i in range(p):
                b += X[i, j] * X[i, p]
                v += X[i, j] * X[i, j]
            if v > 1e-30:
                raw = b * b / v
        elif t == joint:
            for i in range(p):
                raw += X[i, p] * X[i, p]
        elif freedom >= 1.0:  # a standard normal number for rest/freedom of a chi-squared rest (Wilson, Hilferty 1931)
            v = 2.0 / (9.0 * freedom)
            raw = ((spread / noise) ** (1.0 / 3.0) - (1.0 - v)) ** 2 / v
        if gain > 0.0:  # so that a share `_QUANTILE` lies above the mark times the scale, which is at least one
            step = gain * ((1.0 if raw > marks[1, t] * scale else 0.0) - _QUANTILE)
            learned[t] = max(learned[t] + step, 0.0)
        if t < level:
            scale = max(scale, spread)
        now = raw / scale
        row[10 + t] = now
        if t < joint and now > row[4]:
            row[3], row[4], row[5], row[6] = float(t), now, -b / v, math.sqrt(scale / v)
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
    bases: Array, notes: Array, counts: Counts, history: Array, learned: Array, marks: Array, tested: Counts,
    drift: Array, longest: int, gain: float, noise: float, acc: Array, other: Array, M: Array, X: Array, found: Array,
) -> bool:  # fmt: skip
    """Test the windows that end with the newest block, learn how much larger than chance quiet statistics are.

    `bases` (4 levels, p, p + 1): of each level the last four triangles [J r] of 2^level blocks, the newest block among
    them; `notes` (4 levels, 4): their rest, freedom, first sample, first block. `counts` (levels,): bases so far.
    `history` (ring, p, p + 1): [P q] before each block; all q relative to the point of the triangles. `learned`
    (windows, tests): log of overdispersion. `marks` (2, tests): threshold of each test, and the point that few quiet
    statistics pass. `tested` (hypotheses,): column of each. `drift` (p,): growth of variance per block. `longest`
    window, blocks; `gain` of learning, below 0 while settling; `noise` level. `acc` (p, p + 1), `other` (p + 1, p), `M`
    (p, p), `X` (p, p + 1) are scratch. `found` (windows, 10 + tests), of the windows that were looked at: whether a
    threshold was passed, blocks, first sample, likeliest hypothesis, its statistic, size, sd, joint, rest, noise; all
    statistics. Returns whether any was passed.
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
            found[window, 1], found[window, 2] = length, note[2]
            _test(X, rest, freedom, learned[window], marks, tested, speed, noise, found[window])
            alarm = alarm or found[window, 0] > 0.0
        if n_bases % 2 == 1 or level + 1 == levels:
            break
        counts[level + 1] += 1
    return alarm
