"""Compiled work on small triangles: folding them together, and testing windows of blocks for a change.

Matrices here have five to fifteen rows: a call of the linear algebra library costs more than the sums themselves.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

_QUANTILE = 0.1  # share of quiet statistics above the point by which overdispersion is learned


@njit(cache=True, nogil=True, fastmath={"contract"})
def fold(A: Array, B: Array, s: Array) -> None:
    """Replace the upper triangle `A` (p, w), w >= p, by that of [A; B]; B is destroyed, s (w,) is scratch.

    Householder reflections of one row of A with the rows of B that have begun: B stays triangular on the way.
    """
    p, w = A.shape
    for k in range(p):
        square = 0.0
        for i in range(k + 1):
            square += B[i, k] * B[i, k]
        if square == 0.0:
            continue
        head = A[k, k]
        norm = -math.copysign(math.sqrt(head * head + square), head)
        v = head - norm
        tau = 2.0 / (v * v + square)
        A[k, k] = norm
        for j in range(k + 1, w):
            s[j] = v * A[k, j]
        for i in range(k + 1):
            b = B[i, k]
            for j in range(k + 1, w):
                s[j] += b * B[i, j]
        for j in range(k + 1, w):
            s[j] *= tau
            A[k, j] -= s[j] * v
        for i in range(k + 1):
            b = B[i, k]
            for j in range(k + 1, w):
                B[i, j] -= s[j] * b


@njit(cache=True, nogil=True, fastmath={"contract"})
def whiten(T: Array, before: Array, extra: Array, M: Array, X: Array) -> None:
    """Fill `X` (p, p + 1) with M^-1/2 [J rho], where M = I + J P J^T and rho = r + J q.

    `T` (p, p + 1) is [J r], `before` (p, p + 1) is [P q], `extra` (p,) is added to the diagonal of P, `M` is scratch.
    All pivots of M are at least one whatever P is: rounding below that is put right.
    """
    p = T.shape[0]
    for i in range(p):
        for j in range(p):
            X[i, j] = 0.0
        rho = T[i, p]
        for k in range(i, p):
            a = T[i, k]
            for j in range(p):
                X[i, j] += a * before[k, j]
            X[i, k] += a * extra[k]
            rho += a * before[k, p]
        X[i, p] = rho
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


@njit(cache=True, nogil=True)
def _level_of(rest: float, freedom: float) -> float:
    """Return a standard normal number for rest/freedom of a chi-squared `rest` (Wilson and Hilferty 1931)."""
    if freedom < 1.0:
        return 0.0
    v = 2.0 / (9.0 * freedom)
    return float(((rest / freedom) ** (1.0 / 3.0) - (1.0 - v)) / math.sqrt(v))


@njit(cache=True, nogil=True)
def watch(
    inlet: Array, bases: Array, notes: Array, counts: Counts, history: Array, learned: Array, marks: Array,
    tested: Counts, rows: Array, state: Array, scratch: Array, result: Array,
) -> None:  # fmt: skip
    """Take in one block, test the windows that end with it, learn how much larger than chance quiet statistics are.

    `inlet` (2 p + 2, at least p + 1): [J r], [P q], [at .], [rest, freedom, first, ...]. `bases` (levels, 4, p, p + 1):
    the last triangles of 2^level blocks; `notes` (levels, 4, 4): their rest, freedom, first sample, first block.
    `counts` (levels + 1,): bases so far, blocks so far last. `history` (ring, p, p + 1): [P q] before each block.
    `learned` (windows, tests): log of overdispersion. `marks` (2, tests): threshold of each test, and the point that one quiet
    statistic in ten passes. `tested` (hypotheses,): column of each. `rows` (4, wide): growth of variance per block,
    the reference point, two of scratch. Triangles are held at the reference point, estimates are kept relative to it.
    `state` (6,): log of the noise level, blocks to wait until statistics are quiet again, gain of learning, gain of the
    noise level, longest window, whether to alarm. `scratch` (4, p, p + 1). `result` (10 + hypotheses,): kind (-1: not
    finite), blocks, first sample, hypothesis, its statistic, size, sd, joint, rest, noise; statistics of all.
    """
    levels, _, p, _ = bases.shape
    hypotheses, ring, longest = tested.size, history.shape[0], int(state[4])
    joint, rest_test = hypotheses, hypotheses + 1
    total = 0.0
    for i in range(2 * p + 2):
        for j in range(p + 1):
            total += inlet[i, j]
    result[0] = 0.0
    if not math.isfinite(total):
        result[0] = -1.0
        return
    acc, other, M, X = scratch[0], scratch[1], scratch[2], scratch[3]
    reference, growth, s = rows[1], rows[2], rows[3]
    block = counts[levels]
    if block == 0:
        for j in range(p):
            reference[j] = inlet[2 * p, j]
    now = history[block % ring]
    new = bases[0, counts[0] % 4]
    for i in range(p):
        moved = inlet[i, p]
        for j in range(i, p):
            moved += inlet[i, j] * (reference[j] - inlet[2 * p, j])
        for j in range(p):
            new[i, j] = inlet[i, j] if j >= i else 0.0
            now[i, j] = inlet[p + i, j]
        new[i, p] = moved
        now[i, p] = inlet[p + i, p] - reference[i]
    rest, freedom, first = inlet[2 * p + 1, 0], inlet[2 * p + 1, 1], inlet[2 * p + 1, 2]
    note = notes[0, counts[0] % 4]
    note[0], note[1], note[2], note[3] = rest, freedom, first, float(block)
    counts[levels] += 1
    counts[0] += 1
    noise = math.exp(state[0])
    calm = state[1] <= 0.0
    if state[1] > 0.0:
        state[1] -= 1.0
    best = 0.0
    for level in range(levels):
        n_bases = counts[level]
        rest, freedom = 0.0, 0.0
        for m in range(1, min(n_bases, 4) + 1):
            length = m << level
            if length > longest:
                break
            slot = (n_bases - m) % 4
            if m == 1:
                acc[:] = bases[level, slot]
            else:
                other[:] = bases[level, slot]
                fold(acc, other, s)
            rest += notes[level, slot, 0]
            freedom += notes[level, slot, 1]
            if m == 2 and n_bases % 2 == 0 and level + 1 < levels:
                up = counts[level + 1] % 4
                bases[level + 1, up] = acc
                note = notes[level + 1, up]
                note[0], note[1] = rest, freedom
                note[2], note[3] = notes[level, slot, 2], notes[level, slot, 3]
            if level > 0 and m < 3:
                continue
            window = m - 1 if level == 0 else 1 + 2 * level + m - 2
            for k in range(p):
                growth[k] = rows[0, k] * length
            whiten(acc, history[int(notes[level, slot, 3]) % ring], growth, M, X)
            whole = 0.0
            for i in range(p):
                whole += X[i, p] * X[i, p]
            spread = rest / freedom if freedom >= 1.0 else 0.0
            gain = min(state[2] * (1 << level), 0.02) if state[5] > 0.0 else state[2]
            row = learned[window]
            top, winner, size, sd = 0.0, -1, 0.0, 0.0
            for h in range(hypotheses):
                j = tested[h]
                b, v = 0.0, 0.0
                for i in range(p):
                    b += X[i, j] * X[i, p]
                    v += X[i, j] * X[i, j]
                raw = b * b / v if v > 1e-30 else 0.0
                scale = max(math.exp(row[h]), spread)
                s[h] = raw / scale
                if calm:
                    _learn(row, h, raw, marks[1, h], gain)
                if s[h] > top:
                    top, winner, size, sd = s[h], h, -b / v, math.sqrt(scale / v)
            scaled = whole / max(math.exp(row[joint]), spread)
            z = _level_of(rest / noise, freedom)
            odd = z * z * math.exp(-row[rest_test])
            if calm:
                _learn(row, joint, whole, marks[1, joint], gain)
                _learn(row, rest_test, z * z, marks[1, rest_test], gain)
            strength = max(top / marks[0, 0], scaled / marks[0, joint], odd / marks[0, rest_test])
            code = 0.0
            if winner >= 0 and top > marks[0, 0]:
                # the one number stands for the change if what it leaves is chance, or less than what it explains
                code = 1.0 if scaled - top < max(marks[0, joint], top) else 2.0
            elif scaled > marks[0, joint]:
                code = 2.0
            elif odd > marks[0, rest_test]:
                code = 3.0
            # a window that names a number is preferred to one that cannot, unless that one is much the stronger
            order = strength if code == 1.0 else 0.5 * strength
            if code > 0.0 and order > best and state[5] > 0.0:
                best = order
                result[0], result[1], result[2] = code, float(length), notes[level, slot, 2]
                result[3], result[4], result[5], result[6] = float(winner), top, size, sd
                result[7], result[8], result[9] = scaled, odd, spread / noise
                for h in range(hypotheses):
                    result[10 + h] = s[h]
        if n_bases % 2 == 1 or level + 1 == levels:
            break
        counts[level + 1] += 1
    if result[0] > 0.0:
        state[1] = state[4]
        return
    last = notes[0, (counts[0] - 1) % 4]
    if calm and last[1] >= 1.0:
        middle = noise * (1.0 - 2.0 / (9.0 * last[1])) ** 3
        state[0] += state[3] if last[0] / last[1] > middle else -state[3]


@njit(cache=True, nogil=True)
def _learn(row: Array, at: int, statistic: float, point: float, gain: float) -> None:
    """Move the log of a scale (at least 0) so that one statistic in ten lies above `point` times the scale."""
    up = 1.0 - _QUANTILE if statistic > point * math.exp(row[at]) else -_QUANTILE
    row[at] = max(row[at] + gain * up, 0.0)


@njit(cache=True, nogil=True, fastmath={"contract"})
def inform(
    R: Array, J: Array, decay: float, duration: float, limits: Array, reference: Array, fresh: Counts, out: Array,
    work: Array,
) -> int:  # fmt: skip
    """Let a triangle `R` (p, p) forget, add the rows of `J`, say which numbers it alone informs; count what changed.

    `limits` (5,): freeze, thaw, enough, how much worse than enough is too little, weight of a ridge. `reference` (p,):
    information rates to compare with, negative for nuisance numbers. `fresh` (p,) is changed; `out` (2, p): standard
    deviations and information rates. `duration`: seconds that R stands for, not positive: judge nothing. `work`
    (3, p, p). The ridge, far below any information that matters, keeps the triangle regular.
    """
    p = R.shape[0]
    A, B, s = work[0], work[1], work[2, 0]
    keep = math.sqrt(decay)
    for i in range(p):
        for j in range(p):
            v = R[i, j] * keep
            R[i, j] = v if abs(v) > 1e-100 else 0.0
            B[i, j] = J[i, j] if j >= i else 0.0
    fold(R, B, s)
    for i in range(p):
        for j in range(p):
            A[i, j] = R[i, j]
            B[i, j] = limits[4] if i == j else 0.0
    fold(A, B, s)
    for j in range(p):
        out[0, j] = 0.0
    for k in range(p):  # column k of the inverse, from its last entry upwards
        for i in range(k, -1, -1):
            total = 1.0 if i == k else 0.0
            for j in range(i + 1, k + 1):
                total -= A[i, j] * s[j]
            s[i] = total / A[i, i]
            out[0, i] += s[i] * s[i]
    changed = 0
    for j in range(p):
        sd = math.sqrt(out[0, j])
        out[0, j] = sd
        out[1, j] = 1.0 / (sd * sd * duration) if duration > 0.0 else 0.0
        if reference[j] < 0.0 or duration <= 0.0:
            continue
        now = fresh[j]
        if sd <= limits[2] or out[1, j] >= limits[1] * reference[j]:
            now = 1
        elif sd > limits[3] * limits[2] and out[1, j] < limits[0] * reference[j]:
            now = 0
        if now != fresh[j]:
            fresh[j] = now
            changed += 1
    return changed
