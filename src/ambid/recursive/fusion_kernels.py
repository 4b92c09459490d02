"""Compiled fusion of position sensors. The state is [motion, temperature (if modelled), one offset of each sensor],
whose factors and, in the last row, mean `memory` (n + 1, n) holds; the scan stops where `fusion` has to decide.
"""

from __future__ import annotations

from math import inf, isfinite, log, nan, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.square_root_kernels import project, propagate, shrink, size, walk

# columns of `sensors`
PER_GAIN, OFFSET, NOISE, LOW, HIGH, STUCK = range(6)
# columns of `watch`, a row for each sensor
OUT, LAST, SAME, GONE, RAILED, UP, DOWN, LOUD, LOSS, EVIDENCE, UP_0, DOWN_0, LOUD_0, LOSS_0 = range(14)
SUM_T, SUM_ABS, SUM_TT, JUMPS, LAST_T, MEAN_R, SQUARE_R, NEED, SINCE, BACK = range(14, 24)
COUNT, R, RR, RX, X, XX, GATED, TESTED, SQUARES, DOUBT, WAS_OUT, ZERO, BETWEEN, COLUMNS = range(24, 38)
# rows of `now`, the sample in work: displacement, whether it is used, innovation, residual against the others over its
# standard deviation, and one over that; then come the rows of the innovations' covariance
Z, USED, E, T, PER, S_0 = range(6)
# entries of `settings` and of `clock`
HEIGHT, RESTORE_N, STRIDE = range(3)
NOW, OLD, NEW, FRESH, COMMON, COMPARED, DISPUTED, STREAK, AGREED, STAGE = range(10)
# what is to be done of the sample in work
READ, TEST, TAKE, RETURN = range(4)
# what `USED` says of a value beside 1 (used) and 0 (none): of an excluded sensor, and of one that does not fit
LOOKED_AT, GATED_OUT = -1.0, -2.0

SPAN = 64  # samples between two states that are kept to go back to
GONE_N = 10.0  # values in succession that are missing or at a rail until a sensor is excluded
MARGIN = 7.0  # log odds (1000 to 1) by which a fault has to be more likely than the next explanation
_LOSS_PART = 0.2  # part of the gain whose loss is looked for
_GATE = 4.0  # standard deviations beyond which a single value is not used
_CLIP = 5.0  # the most that one value weighs in the tests, so that a glitch is no fault
_CLEAR = 6.0  # difference of squared residuals beyond which a single value is told from another
_LN2 = log(2.0)
_SOON = 20.0  # samples after which the first of several lost sensors is used again
_SLOW = 1.0 / 16.0  # weight of the newest residual in its running mean


@compiled(fastmath={"contract"})
def _see(memory: Array, H: Array, i: int, f: Array) -> float:
    """Fill f with Uᵀ h, h being row i of H, and return h · mean."""
    n, mean = memory.shape[1], 0.0
    for j in range(n):
        mean += H[i, j] * memory[n, j]
    project(memory, H[i], f)
    return mean


@compiled(fastmath={"contract"})
def absorb(z: Array, sensors: Array, memory: Array, H: Array, f: Array, b: Array) -> None:
    """Take in the displacements of one instant, NaN where there is none."""
    n = memory.shape[1]
    for i in range(z.size):
        if isfinite(z[i]):
            e = z[i] - _see(memory, H, i, f)
            gain = e / shrink(memory, f, sensors[i, NOISE], b)
            for j in range(n):
                memory[n, j] += gain * b[j]


@compiled(fastmath={"contract"})
def advance(memory: Array, A: Array, G: Array, walks: Array, stride: int, now: int, W: Array, w: Array) -> None:
    """Move mean and covariance one sample on; `walks` (n_states,): what temperature and offsets walk in each `stride`
    samples.
    """
    last, n = memory.shape[1], A.shape[0]
    for i in range(n):
        x = 0.0
        for a in range(n):
            x += A[i, a] * memory[last, a]
        w[i] = x
    for i in range(n):
        memory[last, i] = w[i]
    propagate(memory[:last], A, np.empty((n, 0)), G, W, w)
    if now % stride == 0:
        walk(memory, walks, w)


@compiled(fastmath={"contract"})
def _compare(now: Array, W: Array, apart: bool) -> tuple[float, int]:
    """Find each used sensor's residual against the others, over its standard deviation 1/per, t = (W e)/√diag W, W =
    S⁻¹ (Basseville and Nikiforov 1993, sec. 7.2), the squared residual of all and how many; `W` becomes -S⁻¹ of those
    used. With `apart`, W = S⁻¹ - S⁻¹ 1 1ᵀ S⁻¹/(1ᵀ S⁻¹ 1): what all share, and so any motion of the rotor, is taken off
    first.
    """
    used, e, t, per, S = now[USED], now[E], now[T], now[PER], now[S_0:]
    m, count = e.size, 0
    for i in range(m):
        for j in range(m):
            W[i, j] = S[i, j] if used[i] > 0.0 and used[j] > 0.0 else 0.0
    for k in range(m):  # sweep
        if used[k] <= 0.0:
            continue
        count += 1
        part = 1.0 / W[k, k]
        for i in range(m):
            if i != k and used[i] > 0.0:
                along = W[i, k] * part
                for j in range(m):
                    if j != k:
                        W[i, j] -= along * W[k, j]
        for i in range(m):
            if i != k:
                W[i, k] *= part
                W[k, i] *= part
        W[k, k] = -part
    total = common = 0.0
    for i in range(m):
        if used[i] > 0.0:
            row = dot = 0.0
            for j in range(m):
                if used[j] > 0.0:
                    row -= W[i, j]
                    dot -= W[i, j] * e[j]
            per[i], t[i] = row, dot
            total += row
            common += dot
    for i in range(m):
        if used[i] > 0.0:
            own = -W[i, i] - (per[i] * per[i] / total if apart else 0.0)
            dot = t[i] - (per[i] * common / total if apart else 0.0)
            sure = own > 1e-12 * -W[i, i]  # the only one has nothing to be compared with
            per[i] = sqrt(own) if sure else 0.0
            t[i] = dot / per[i] if sure else 0.0
    return (common * common / total if count else 0.0), count


@compiled(fastmath={"contract"})
def _gate(now: Array, W: Array, watch: Array, clock: Array, apart: bool) -> int:
    """Leave out values that do not fit the others; where it cannot be told which, both of them."""
    used, t = now[USED], now[T]
    m, clear = t.size, _CLEAR if apart else 2.0 * MARGIN
    common, count = _compare(now, W, apart)
    tested = count
    if not apart and count > 0:
        clock[COMMON] = max(0.0, clock[COMMON] + 0.375 * common - _LN2)
    tied = False
    while count > 1:
        worst, best, second = -1, _GATE * _GATE, 0.0
        for i in range(m):
            if used[i] > 0.0 and t[i] * t[i] > best:
                worst, best = i, t[i] * t[i]
        if worst < 0 or (not apart and common > best - clear):
            break
        new = abs(t[worst] - watch[worst, LAST_T]) > _GATE or watch[worst, WAS_OUT] > 0.0
        if not (apart or new):  # what grew slowly has drawn the filter after it: which of the two is wrong is not seen
            break
        for i in range(m):
            if used[i] > 0.0 and i != worst:
                second = max(second, t[i] * t[i])
        tied = second > best - clear
        if tied and clock[STREAK] >= 2.0:  # no glitch any more: without them all the filter would go astray
            break
        for i in range(m):
            if used[i] > 0.0 and t[i] * t[i] >= best - (clear if tied else 0.0):
                used[i] = GATED_OUT
                watch[i, GATED] += 1.0
        if tied:
            break
        common, count = _compare(now, W, apart)
    for i in range(m):
        watch[i, WAS_OUT] = 1.0 if used[i] == GATED_OUT else 0.0
    clock[STREAK] = clock[STREAK] + 1.0 if tied else 0.0
    return tested


@compiled
def _sum_up(watch: Array, i: int, t: float, per: float, x: float, now: float) -> None:
    """Sum log likelihood ratios of a step either way, more noise, a lower gain; each passes h on the mean no sooner
    than after e^h quiet samples (Lorden 1971).
    """
    s = min(max(t, -_CLIP), _CLIP)
    phi = min(max(-_LOSS_PART * x * per, -2.0), 2.0)
    watch[i, UP] += s - 0.5
    watch[i, DOWN] -= s + 0.5
    watch[i, LOUD] += 0.375 * s * s - _LN2
    watch[i, LOSS] += phi * (s - 0.5 * phi)
    watch[i, EVIDENCE] = max(0.0, watch[i, EVIDENCE] + 0.375 * t * t - _LN2)
    watch[i, SUM_T] += t
    watch[i, SUM_ABS] += abs(t)
    watch[i, JUMPS] += (t - watch[i, LAST_T]) ** 2
    watch[i, SUM_TT] += t * t
    watch[i, LAST_T] = t
    for k in range(4):
        if watch[i, UP + k] <= 0.0:
            watch[i, UP + k] = 0.0
            watch[i, UP_0 + k] = now + 1.0
            if k == 2:
                watch[i, SUM_T] = watch[i, SUM_ABS] = watch[i, JUMPS] = watch[i, SUM_TT] = 0.0
    if per > 0.0:
        res = t / per
        begun = watch[i, UP_0] if watch[i, UP] >= watch[i, DOWN] else watch[i, DOWN_0]
        gain = max(_SLOW, 1.0 / max(now + 1.0 - begun, 1.0))  # since the larger sum began, or the last samples of it
        watch[i, MEAN_R] += gain * (res - watch[i, MEAN_R])
        watch[i, SQUARE_R] += gain * (res * res - watch[i, SQUARE_R])
    watch[i, TESTED] += 1.0
    watch[i, SQUARES] += s * s


@compiled
def _agree(watch: Array, i: int, res: float, s: float, r: float, x: float, other: float, working: int) -> bool:
    """Say whether an excluded sensor has agreed with the others long enough: level, noise and gain."""
    watch[i, COUNT] += 1.0
    watch[i, R] += res
    watch[i, RR] += res * res
    watch[i, RX] += res * x
    watch[i, X] += x
    watch[i, XX] += x * x
    n, near = watch[i, COUNT], res * res <= 36.0 * s
    if near and n < (watch[i, NEED] if working > 0 else min(_SOON, watch[i, NEED])):
        return False
    mean = watch[i, R] / n
    spread_x = max(watch[i, XX] - watch[i, X] * watch[i, X] / n, 0.0)
    noise = r + (other if working > 0 else s)
    level = mean * mean <= 9.0 * (s - r + noise / n)
    calm = watch[i, RR] - n * mean * mean <= noise * (n + 4.0 * sqrt(2.0 * n))
    gain = abs(watch[i, RX] - mean * watch[i, X]) <= 0.05 * spread_x + 3.0 * sqrt(noise * spread_x)
    for k in range(COUNT, XX + 1):  # the proof begins anew
        watch[i, k] = 0.0
    return bool(near and level and calm and gain)


@compiled(fastmath={"contract"})
def _read(y: Array, sensors: Array, watch: Array, now: Array) -> bool:
    """Turn raw values into displacements; return whether a working sensor gives nothing, stands at a rail or still."""
    fault = False
    for i in range(y.size):
        v = y[i]
        good = isfinite(v)
        railed = good and (v <= sensors[i, LOW] or v >= sensors[i, HIGH])
        watch[i, GONE] = 0.0 if good else watch[i, GONE] + 1.0
        watch[i, RAILED] = watch[i, RAILED] + 1.0 if railed else 0.0
        watch[i, SAME] = watch[i, SAME] + 1.0 if good and v == watch[i, LAST] and not railed else 0.0
        if good:
            watch[i, LAST] = v
        sound = good and not railed
        now[Z, i] = (v - sensors[i, OFFSET]) * sensors[i, PER_GAIN] if sound else nan
        now[USED, i] = 0.0 if not sound else 1.0 if watch[i, OUT] == 0.0 else LOOKED_AT
        stuck = sensors[i, STUCK] > 0.0 and watch[i, SAME] >= sensors[i, STUCK]
        if watch[i, GONE] >= GONE_N or watch[i, RAILED] >= GONE_N or stuck:
            fault = fault or watch[i, OUT] == 0.0
            if watch[i, OUT] > 0.0:
                now[USED, i] = 0.0
                for k in range(COUNT, XX + 1):  # the proof begins anew
                    watch[i, k] = 0.0
    return fault


@compiled(fastmath={"contract"})
def fuse_scan(
    k: int, y: Array, out: Array, A: Array, G: Array, H: Array, walks: Array, sensors: Array, settings: Array,
    memory: Array, watch: Array, clock: Array, ring: Array, kept: Array, now: Array,
) -> int:  # fmt: skip
    """Run over a block from sample k; return where it stopped, `clock[STAGE]` saying what is to be done there.

    `H` (m + 1, n_states): how each sensor sees the state, and position. `out` (n_samples, 2): position and its
    standard deviation. `ring` (2 span, m): displacements that were used, else NaN. `kept`: the filter as it was before
    the two last whole spans.
    """
    m, last, n, stride = sensors.shape[0], memory.shape[1], A.shape[0], int(settings[STRIDE])
    z, used, e, S = now[Z], now[USED], now[E], now[S_0:]
    f, W = np.empty((m + 1, last)), np.empty((m, m))
    M, b = np.empty((n, 2 * n)), np.empty(max(2 * n, last))
    while k < y.shape[0]:
        t, at = clock[NOW], int(clock[NOW]) % ring.shape[0]
        if clock[STAGE] == READ:
            fresh = clock[FRESH] > 0.0
            if fresh or int(t) % SPAN == 0:
                for i in range(last + 1):
                    for j in range(last):
                        kept[0, i, j] = memory[i, j] if fresh else kept[1, i, j]
                        kept[1, i, j] = memory[i, j]
                clock[OLD] = t if fresh else clock[NEW]
                clock[NEW], clock[FRESH] = t, 0.0
            clock[STAGE] = TEST
            if _read(y[k], sensors, watch, now):
                return k
        working = int(0.0)  # a plain 0 has a type of its own: what takes it would be compiled twice
        for i in range(m):
            working += watch[i, OUT] == 0.0
        if clock[STAGE] == TEST:
            for i in range(m):
                if used[i] > 0.0:
                    e[i] = z[i] - _see(memory, H, i, f[i])
                    for j in range(i + 1):
                        if used[j] > 0.0:
                            total = sensors[i, NOISE] if i == j else 0.0
                            for a in range(last):
                                total += f[i, a] * memory[a, a] * f[j, a]
                            S[i, j] = S[j, i] = total
            x = _see(memory, H, m, f[m])
            clock[COMPARED] = _gate(now, W, watch, clock, working > 2)
            clock[STAGE], alarm = TAKE, False
            for i in range(m):
                if used[i] > 0.0 or used[i] == GATED_OUT:
                    _sum_up(watch, i, now[T, i], now[PER, i], x, t)
                for j in range(UP, LOSS + 1):
                    alarm = alarm or (watch[i, OUT] == 0.0 and watch[i, j] > settings[HEIGHT])
            if alarm:
                return k
        quietest = inf
        for i in range(m):
            ring[at, i] = z[i] if used[i] > 0.0 else nan
            if used[i] > 0.0:
                quietest = min(quietest, sensors[i, NOISE])
        absorb(ring[at], sensors, memory, H, f[0], b)
        filtered = _see(memory, H, m, f[m])
        variance, stop = size(memory, f[m]), False
        for i in range(m):
            if used[i] == LOOKED_AT:
                residual = z[i] - _see(memory, H, i, f[0])
                s = size(memory, f[0]) + sensors[i, NOISE]
                watch[i, BACK] = _agree(watch, i, residual, s, sensors[i, NOISE], filtered, quietest, working)
                stop = stop or watch[i, BACK] > 0.0
        if clock[DISPUTED] > 0.0:  # either may be right: each one's position is by its zero from before the fault
            extra, agreed = 0.0, True
            for i in range(m):
                if watch[i, DOUBT] > 0.0:
                    if isfinite(z[i]):
                        between = z[i] - watch[i, ZERO] - filtered
                        watch[i, BETWEEN] += _SLOW * (between * between - watch[i, BETWEEN])
                    extra = max(extra, watch[i, BETWEEN] - sensors[i, NOISE])
                    agreed = agreed and watch[i, BETWEEN] < 2.0 * sensors[i, NOISE]
            clock[AGREED] = clock[AGREED] + 1.0 if agreed else 0.0
            stop = stop or clock[AGREED] >= settings[RESTORE_N]
            variance += extra
        out[k, 0], out[k, 1] = filtered, sqrt(variance)
        advance(memory, A, G, walks, stride, int(t), M, b)
        clock[NOW], clock[STAGE] = t + 1.0, RETURN if stop else READ
        k += 1
        if stop:
            break
    return k
