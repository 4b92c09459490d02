"""Compiled work on small triangles: folding them together, and testing windows of blocks for a change.

Matrices here have five to fifteen rows: a call of the linear algebra library costs more than the sums themselves.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Counts = NDArray[np.int64]

_QUANTILE = 0.03  # share of quiet statistics above the point by which overdispersion is learned
_LARGEST_GAIN = 0.02  # of learning overdispersion
_SETTLE_GAIN = 12.0  # over the number of tests, while settling: one over the density of log chi-squared at that point
_RAISED = 1.5  # level of the unexplained part, over its usual one, from which no number is named


@compiled(error_model="numpy", fastmath={"contract"})
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


@compiled(error_model="numpy", fastmath={"contract"})
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


@compiled(error_model="numpy")
def _level_of(rest: float, freedom: float) -> float:
    """Return a standard normal number for rest/freedom of a chi-squared `rest` (Wilson and Hilferty 1931)."""
    if freedom < 1.0:
        return 0.0
    v = 2.0 / (9.0 * freedom)
    return float(((rest / freedom) ** (1.0 / 3.0) - (1.0 - v)) / math.sqrt(v))


@compiled(error_model="numpy")
def _copy(A: Array, B: Array) -> None:
    """Copy `A` to `B`, both (p, w)."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            B[i, j] = A[i, j]


@compiled(error_model="numpy")
def _take(inlet: Array, base: Array, note: Array, before: Array, reference: Array, block: int) -> None:
    """Store the triangle of a block, and estimate and covariance before it, at the reference point."""
    p = base.shape[0]
    for i in range(p):
        r = inlet[i, p]
        for j in range(p):
            base[i, j] = inlet[i, j] if j >= i else 0.0
            before[i, j] = inlet[p + i, j]
            r += base[i, j] * (reference[j] - inlet[2 * p, j])
        base[i, p] = r
        before[i, p] = inlet[p + i, p] - reference[i]
    note[0], note[1], note[2] = inlet[2 * p + 1, 0], inlet[2 * p + 1, 1], inlet[2 * p + 1, 2]
    note[3] = float(block)


@compiled(error_model="numpy")
def _test(
    X: Array, rest: float, freedom: float, row: Array, marks: Array, tested: Counts, gain: float, noise: float,
    now: Array, found: Array,
) -> None:  # fmt: skip
    """Test one whitened window, and learn from it if `gain` is positive.

    `found` (10,): kind, 0 (length), 0 (first), hypothesis, its statistic, size, sd, joint, rest, noise; `now` (tests,):
    statistics of all hypotheses.
    """
    p, hypotheses = X.shape[0], tested.size
    joint, level = hypotheses, hypotheses + 1
    spread = rest / freedom if freedom >= 1.0 else 0.0
    for i in range(10):
        found[i] = 0.0
    found[3] = -1.0
    for h in range(hypotheses):
        j = tested[h]
        b, v = 0.0, 0.0
        for i in range(p):
            b += X[i, j] * X[i, p]
            v += X[i, j] * X[i, j]
        raw = b * b / v if v > 1e-30 else 0.0
        scale = max(math.exp(row[h]), spread)
        now[h] = raw / scale
        if now[h] > found[4]:
            found[3], found[4], found[5], found[6] = float(h), now[h], -b / v, math.sqrt(scale / v)
        if gain > 0.0:
            _learn(row, h, raw, marks[1, h], gain)
    whole = 0.0
    for i in range(p):
        whole += X[i, p] * X[i, p]
    z = _level_of(rest / noise, freedom)
    found[7] = whole / max(math.exp(row[joint]), spread)
    found[8] = z * z * math.exp(-row[level])
    found[9] = spread / noise
    if gain > 0.0:
        _learn(row, joint, whole, marks[1, joint], gain)
        _learn(row, level, z * z, marks[1, level], gain)
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
    inlet: Array, bases: Array, notes: Array, counts: Counts, history: Array, learned: Array, marks: Array,
    tested: Counts, rows: Array, state: Array, scratch: Array, result: Array,
) -> None:  # fmt: skip
    """Take in one block, test the windows that end with it, learn how much larger than chance quiet statistics are.

    `inlet` (2 p + 2, at least p + 1): [J r], [P q], [at .], [rest, freedom, first, ...]. `bases` (levels, 4, p, p + 1):
    the last triangles of 2^level blocks; `notes` (levels, 4, 4): their rest, freedom, first sample, first block.
    `counts` (levels + 1,): bases so far, blocks so far last. `history` (ring, p, p + 1): [P q] before each block.
    `learned` (windows, tests): log of overdispersion. `marks` (2, tests): threshold of each test, and the point that
    few quiet statistics pass. `tested` (hypotheses,): column of each. `rows` (5, wide): growth of variance per
    block, the reference point, scratch. Triangles are held at the reference point, estimates relative to it.
    `state` (6,): log of the noise level, blocks to wait until statistics are quiet again, gain of learning, gain of the
    noise level, longest window, whether to alarm. `scratch` (4, p, p + 1). `result` (10 + hypotheses,): kind (-1: not
    finite), blocks, first sample, hypothesis, its statistic, size, sd, joint, rest, noise; statistics of all.
    """
    levels, _, p, _ = bases.shape
    tests, ring, longest = tested.size + 2, history.shape[0], int(state[4])
    total = 0.0
    for i in range(2 * p + 2):
        for j in range(p + 1):
            total += inlet[i, j]
    result[0] = 0.0
    if not math.isfinite(total):
        result[0] = -1.0
        return
    acc, other, M, X = scratch[0], scratch[1], scratch[2], scratch[3]
    reference, growth, now, found = rows[1], rows[2], rows[3], rows[4]
    block = int(counts[levels])
    if block == 0:
        for j in range(p):
            reference[j] = inlet[2 * p, j]
    slot = counts[0] % 4
    _take(inlet, bases[0, slot], notes[0, slot], history[block % ring], reference, block)
    newest, freedom_now = notes[0, slot, 0], notes[0, slot, 1]
    counts[levels] += 1
    counts[0] += 1
    noise, calm, best = math.exp(state[0]), state[1] <= 0.0, 0.0
    state[1] -= 0.0 if calm else 1.0
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
            _copy(bases[level, slot], acc if m == 1 else other)
            if m > 1:
                fold(acc, other, now)
            rest += notes[level, slot, 0]
            freedom += notes[level, slot, 1]
            if m == 2 and n_bases % 2 == 0 and level + 1 < levels:
                up = counts[level + 1] % 4
                _copy(acc, bases[level + 1, up])
                notes[level + 1, up, 0], notes[level + 1, up, 1] = rest, freedom
                notes[level + 1, up, 2], notes[level + 1, up, 3] = notes[level, slot, 2], notes[level, slot, 3]
            if level > 0 and m < 3:
                continue
            for i in range(p):
                growth[i] = rows[0, i] * length
            whiten(acc, history[int(notes[level, slot, 3]) % ring], growth, M, X)
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
                result[1], result[2] = float(length), notes[level, slot, 2]
                for i in range(tests - 2):
                    result[10 + i] = now[i]
        if n_bases % 2 == 1 or level + 1 == levels:
            break
        counts[level + 1] += 1
    if result[0] > 0.0:
        state[1] = state[4]
    elif calm and freedom_now >= 1.0:
        middle = noise * (1.0 - 2.0 / (9.0 * freedom_now)) ** 3
        state[0] += state[3] if newest / freedom_now > middle else -state[3]


@compiled(error_model="numpy")
def _learn(row: Array, at: int, statistic: float, point: float, gain: float) -> None:
    """Move the log of a scale (at least 0) so that a share `_QUANTILE` lies above `point` times the scale."""
    up = 1.0 - _QUANTILE if statistic > point * math.exp(row[at]) else -_QUANTILE
    row[at] = max(row[at] + gain * up, 0.0)


@compiled(error_model="numpy", fastmath={"contract"})
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


@compiled(error_model="numpy", fastmath={"contract"})
def gather(J: Array, r: Array, at: Array, T: Array, point: Array, other: Array, s: Array) -> bool:
    """Fold a block into `T` (p, p + 1), which is held at `point`; do nothing and return False if it is not finite.

    `other` (p, p + 1) and `s` (p + 1,) are scratch.
    """
    p, total = T.shape[0], 0.0
    for i in range(p):
        v = r[i]
        for j in range(p):
            a = J[i, j] if j >= i else 0.0
            other[i, j] = a
            total += a
            v += a * (point[j] - at[j])
        other[i, p] = v
        total += v
    if not math.isfinite(total):
        return False
    fold(T, other, s)
    return True


@compiled(error_model="numpy")
def weigh(T: Array, sides: Array, M: Array, X: Array, before: Array, out: Array) -> None:
    """Compare two sets of numbers on the evidence `T` (p, p + 1) held at the first of them.

    `sides` (2 p + 1, p): covariance of the first and of the second, and their difference d. `M` (p, p), `X` and
    `before` (p, p + 1) are scratch. `out` (5,): gain in loss, |J d|^2, variance of half the gain, misfit of the first,
    square of d over both covariances (infinite where d moves a number without variance).
    """
    p = T.shape[0]
    d, growth = sides[2 * p], out[5:]
    cross, square, claim = 0.0, 0.0, 0.0
    for i in range(p):
        before[i, p] = growth[i] = 0.0
        for j in range(p):
            before[i, j] = sides[i, j]
    whiten(T, before, growth, M, X)
    misfit, variance = 0.0, 0.0
    for i in range(p):
        w = 0.0
        for j in range(i, p):
            w += T[i, j] * d[j]
        square += w * w
        cross += w * T[i, p]
        misfit += X[i, p] * X[i, p]
        for j in range(i, p):
            growth[j] += T[i, j] * w
    for i in range(p):
        for j in range(p):
            variance += growth[i] * sides[i, j] * growth[j]
    for i in range(p):  # Cholesky of the sum of both covariances, scaled to unit diagonal; d is solved on the way
        size = sides[i, i] + sides[p + i, i]
        if size <= 0.0 and d[i] != 0.0:
            claim = math.inf
        scale = M[i, i] = 1.0 / math.sqrt(size) if size > 0.0 else 0.0
        pivot, left = 1.0, d[i] * scale
        for j in range(i):
            total = (sides[i, j] + sides[p + i, j]) * scale * M[j, j]
            for k in range(j):
                total -= X[i, k] * X[j, k]
            X[i, j] = total * before[j, p]
            pivot -= X[i, j] * X[i, j]
            left -= X[i, j] * X[j, p]
        before[i, p] = 1.0 / math.sqrt(max(pivot, 1e-10)) if scale > 0.0 else 0.0
        X[i, p] = left * before[i, p]
        claim += X[i, p] * X[i, p]
    out[0], out[1], out[2], out[3], out[4] = square - 2.0 * cross, square, square + max(variance, 0.0), misfit, claim
