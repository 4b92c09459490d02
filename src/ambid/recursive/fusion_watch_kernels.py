"""Compiled tests of every position sensor against the others: whether one is at fault, which, since when."""

from __future__ import annotations

from math import isfinite, log, nan, sqrt

from ambid.arrays import Array
from ambid.compiled import compiled

# columns of `sensors`
PER_GAIN, OFFSET, CURVE_2, CURVE_3, NOISE, DRIFT, WARMTH, LOW, HIGH, STUCK = range(10)
# columns of `watch`, a row for each sensor
OUT, LAST, SAME, GONE, RAILED, UP, DOWN, LOUD, LOSS, EVIDENCE, UP_0, DOWN_0, LOUD_0, LOSS_0 = range(14)
SUM_T, SUM_ABS, SUM_TT, JUMPS, LAST_T, MEAN_R, SQUARE_R, NEED, SINCE = range(14, 23)
COUNT, R, RR, RX, X, XX, GATED, TESTED, SQUARES, DOUBT, ONSET, WAS_OUT, ZERO, BETWEEN = range(23, 37)
# entries of `settings`
HEIGHT, INSTANT, RESTORE_N, STATES, HOLD_N, GONE_N, LOSS_PART, SPAN, STRIDE = range(9)
# entries of `clock`
NOW, OLD, NEW, FRESH, HELD, COMMON, NOTES, DISPUTED, STREAK, AGREED = range(10)
# what a row of `notes` tells first
MISSING, RAIL, STUCK_AT, STEP, NOISY, GAIN, DISPUTE, MOTION, AGREEMENT = (1, 2, 3, 4, 5, 6, 8, 9, 10)
RESTORED = 7.0

# what `used` says of a value beside 1 (used) and 0 (none): of an excluded sensor, and of one that does not fit
LOOKED_AT, GATED_OUT = -1.0, -2.0
OPENED = -2  # the judgement that one of several is at fault

NOBODY = -1.0  # a float, here and below: a whole number written out makes Numba compile a function once more for it

GATE = 4.0  # standard deviations beyond which a single value is not used
CLIP = 5.0  # the most that one value weighs in the tests, so that a glitch is no fault
CLEAR = 6.0  # difference of squared residuals beyond which a single value is told from another
MARGIN = 7.0  # log odds (1000 to 1) by which a fault has to be more likely than the next explanation
JUMPING = 0.3  # share of squared changes in squared residuals: a step 3 samples ago; 2 for white noise
_LN2 = log(2.0)
_SOON = 20.0  # samples after which the first of several lost sensors is used again
_SLOW = 1.0 / 16.0  # weight of the newest residual in its running mean


@compiled
def note(notes: Array, clock: Array, code: int, i: int, onset: float, a: float, b: float) -> None:
    """Write what happened, for `ambid.recursive.fusion_sensor.reason`."""
    row = int(clock[NOTES])
    if row < notes.shape[0]:
        notes[row, 0], notes[row, 1], notes[row, 2], notes[row, 3], notes[row, 4] = code, i, onset, a, b
        clock[NOTES] += 1.0


@compiled
def quiet(watch: Array, clock: Array) -> None:
    """Begin the tests of all sensors anew."""
    watch[:, UP : EVIDENCE + 1] = 0.0
    watch[:, UP_0 : LOSS_0 + 1] = clock[NOW]
    for i in range(watch.shape[0]):
        watch[i, SUM_T] = watch[i, SUM_ABS] = watch[i, JUMPS] = watch[i, SUM_TT] = 0.0
    clock[COMMON] = 0.0


@compiled(fastmath={"contract"})
def read(y: Array, k: int, sensors: Array, watch: Array, z: Array, r: Array, used: Array) -> None:
    """Turn raw values into displacements with their noise, and count what is missing, at a rail or standing still."""
    for i in range(y.shape[1]):
        v = y[k, i]
        good = isfinite(v)
        railed = good and (v <= sensors[i, LOW] or v >= sensors[i, HIGH])
        watch[i, GONE] = 0.0 if good else watch[i, GONE] + 1.0
        watch[i, RAILED] = watch[i, RAILED] + 1.0 if railed else 0.0
        watch[i, SAME] = watch[i, SAME] + 1.0 if good and v == watch[i, LAST] and not railed else 0.0
        if good:
            watch[i, LAST] = v
        used[i] = 1.0 if good and not railed else 0.0
        d = (v - sensors[i, OFFSET]) * sensors[i, PER_GAIN]
        slope = 1.0 + d * (2.0 * sensors[i, CURVE_2] + 3.0 * sensors[i, CURVE_3] * d)
        z[i] = d * (1.0 + d * (sensors[i, CURVE_2] + sensors[i, CURVE_3] * d)) if used[i] > 0.0 else nan
        r[i] = sensors[i, NOISE] * slope * slope


@compiled(fastmath={"contract"})
def compare(e: Array, used: Array, S: Array, W: Array, t: Array, per: Array, apart: bool) -> tuple[float, int]:
    """Fill `t` with each used sensor's residual against the others, over its standard deviation 1/per.

    t = (W e)/√diag W, W = S⁻¹ (Basseville and Nikiforov 1993, sec. 7.2). With `apart`, what all have in common is
    taken off first: W = S⁻¹ - S⁻¹ 1 1ᵀ S⁻¹/(1ᵀ S⁻¹ 1), and no motion of the rotor enters. Also the squared residual
    of all together, and how many were compared.
    """
    m, count = e.shape[0], 0
    for i in range(m):
        for j in range(m):
            W[i, j] = S[i, j] if used[i] > 0.0 and used[j] > 0.0 else 0.0
    for k in range(m):  # sweep: W becomes -S⁻¹ of those that are used
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
def gate(
    e: Array, used: Array, S: Array, W: Array, t: Array, per: Array, watch: Array, clock: Array, apart: bool
) -> int:
    """Leave out values that do not fit the others; where it cannot be told which, both of them."""
    m, clear = e.shape[0], CLEAR if apart else 2.0 * MARGIN
    common, count = compare(e, used, S, W, t, per, apart)
    tested = count
    if not apart and count > 0:
        clock[COMMON] = max(0.0, clock[COMMON] + 0.375 * common - _LN2)
    tied = False
    while count > 1:
        worst, best, second = -1, GATE * GATE, 0.0
        for i in range(m):
            if used[i] > 0.0 and t[i] * t[i] > best:
                worst, best = i, t[i] * t[i]
        if worst < 0 or (not apart and common > best - clear):
            break
        new = abs(t[worst] - watch[worst, LAST_T]) > GATE or watch[worst, WAS_OUT] > 0.0
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
        common, count = compare(e, used, S, W, t, per, apart)
    for i in range(m):
        watch[i, WAS_OUT] = 1.0 if used[i] == GATED_OUT else 0.0
    clock[STREAK] = clock[STREAK] + 1.0 if tied else 0.0
    return tested


@compiled
def sums(watch: Array, i: int, t: float, per: float, x: float, part: float, now: float) -> None:
    """Cumulative sums of the log likelihood ratios of a step either way, more noise, and a lower gain.

    Each passes h on the mean no sooner than after e^h quiet samples (Lorden 1971).
    """
    s = min(max(t, -CLIP), CLIP)
    phi = min(max(-part * x * per, -2.0), 2.0)
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
def standing(watch: Array, i: int) -> tuple[float, float, int, float]:
    """Return the highest sum of sensor i that raises an alarm, the highest of all, what it looks like and its onset.

    It looks like what says most of the sums that are near the highest.
    """
    first, high = watch[i, UP_0], watch[i, UP]
    for k in range(1, 4):
        if watch[i, UP + k] > high:
            first, high = watch[i, UP_0 + k], watch[i, UP + k]
    step, code = max(watch[i, UP], watch[i, DOWN]), NOISY
    if watch[i, LOSS] >= max(step, watch[i, LOUD]):
        code = GAIN
    elif step >= watch[i, LOUD] or abs(watch[i, SUM_T]) > 0.9 * watch[i, SUM_ABS]:
        code = STEP
    return high, max(high, watch[i, EVIDENCE]), code, first


@compiled
def exclude(i: int, settings: Array, watch: Array, clock: Array, onset: float) -> None:
    """Put sensor i out: the sooner after its return, the longer it has to agree before the next."""
    now = clock[NOW]
    again = watch[i, NEED] > 0.0 and now - watch[i, SINCE] < 10.0 * watch[i, NEED]
    watch[i, NEED] = min(2.0 * watch[i, NEED], 64.0 * settings[RESTORE_N]) if again else settings[RESTORE_N]
    watch[i, OUT], watch[i, SINCE], watch[i, ONSET], watch[i, DOUBT] = 1.0, now, onset, 0.0
    watch[i, COUNT : XX + 1] = 0.0
    quiet(watch, clock)


@compiled
def back(i: int, watch: Array, clock: Array, notes: Array) -> None:
    """Use sensor i again."""
    note(notes, clock, int(RESTORED), i, clock[NOW], clock[NOW] - watch[i, SINCE], 0.0)
    watch[i, OUT], watch[i, SINCE] = 0.0, clock[NOW]
    quiet(watch, clock)
    working = 0
    for j in range(watch.shape[0]):
        working += watch[j, OUT] == 0.0
    if working > 2:
        watch[:, DOUBT] = 0.0
        clock[DISPUTED] = 0.0
    clock[FRESH] = 1.0


@compiled
def self_test(sensors: Array, settings: Array, watch: Array, clock: Array, notes: Array, used: Array) -> int:
    """Exclude sensors that give nothing, stand at a rail or stand still; return how many are left."""
    now, working = clock[NOW], 0
    for i in range(watch.shape[0]):
        code, onset = 0, now
        if watch[i, GONE] >= settings[GONE_N]:
            code, onset = MISSING, now - watch[i, GONE] + 1.0
        elif watch[i, RAILED] >= settings[GONE_N]:
            code, onset = RAIL, now - watch[i, RAILED] + 1.0
        elif sensors[i, STUCK] > 0.0 and watch[i, SAME] >= sensors[i, STUCK]:
            code, onset = STUCK_AT, now - watch[i, SAME]
        if code > 0 and watch[i, OUT] > 0.0:
            watch[i, COUNT : XX + 1] = 0.0  # the proof begins anew
        elif code > 0:
            exclude(i, settings, watch, clock, onset)
            note(notes, clock, code, i, onset, watch[i, LAST], 0.0)
        if watch[i, OUT] == 0.0:
            working += 1
        elif used[i] > 0.0:
            used[i] = LOOKED_AT if code == 0 else 0.0
    return working


@compiled
def agree(watch: Array, i: int, res: float, s: float, r: float, x: float, other: float, working: int) -> bool:
    """Say whether an excluded sensor has agreed with the others long enough: level, noise and gain."""
    if not res * res <= 36.0 * s:
        watch[i, COUNT : XX + 1] = 0.0  # the proof begins anew
        return False
    watch[i, COUNT] += 1.0
    watch[i, R] += res
    watch[i, RR] += res * res
    watch[i, RX] += res * x
    watch[i, X] += x
    watch[i, XX] += x * x
    if watch[i, COUNT] < (watch[i, NEED] if working > 0 else min(_SOON, watch[i, NEED])):
        return False
    n = watch[i, COUNT]
    mean = watch[i, R] / n
    spread_x = max(watch[i, XX] - watch[i, X] * watch[i, X] / n, 0.0)
    noise = r + (other if working > 0 else s)
    level = mean * mean <= 9.0 * (s - r + noise / n)
    calm = watch[i, RR] - n * mean * mean <= noise * (n + 4.0 * sqrt(2.0 * n))
    along = abs(watch[i, RX] - mean * watch[i, X])
    gain = along <= 0.05 * spread_x + 3.0 * sqrt(noise * spread_x)
    watch[i, COUNT : XX + 1] = 0.0  # the proof begins anew
    return bool(level and calm and gain)


@compiled
def judge(settings: Array, watch: Array, clock: Array, notes: Array, tested: int, apart: bool, x: float) -> int:
    """Return the sensor that is at fault and exclude it; -1 if there is none, OPENED if one is but not known which."""
    m, worst, most, high, now = watch.shape[0], int(NOBODY), 0.0, settings[HEIGHT], clock[NOW]
    for i in range(m):
        alarm, points, _, _ = standing(watch, i)
        if watch[i, OUT] == 0.0 and alarm > high and (worst < 0 or points > most):
            worst, most = i, points
    if worst < 0:
        return -1
    second = 0.0
    for i in range(m):
        if i != worst and watch[i, OUT] == 0.0:
            second = max(second, standing(watch, i)[1])
    moved = tested < 2 or (not apart and clock[COMMON] > most - MARGIN)
    _, _, what, start = standing(watch, worst)
    # Of two sensors the motion model can only name one that jumps: a slow difference draws the filter after it first.
    shown = apart or watch[worst, JUMPS] > JUMPING * watch[worst, SUM_TT]
    if clock[DISPUTED] == 0.0 and not moved and shown and second < most - (MARGIN if apart else 2.0 * MARGIN):
        note(notes, clock, what, worst, start, watch[worst, MEAN_R], x)
        exclude(worst, settings, watch, clock, start)
        return worst
    if apart and most < 3.0 * high:
        return -1
    if now >= clock[HELD] and (moved or clock[DISPUTED] == 0.0):
        note(notes, clock, MOTION if moved else DISPUTE, worst, start, watch[worst, MEAN_R], x)
        clock[HELD] = now + settings[HOLD_N]
    opened = not moved and clock[DISPUTED] == 0.0
    if opened:
        clock[DISPUTED], clock[AGREED] = 1.0, 0.0
        for i in range(m):  # those that could have done it
            if watch[i, OUT] == 0.0 and standing(watch, i)[1] >= most - 3.0 * MARGIN:
                watch[i, DOUBT] = 1.0
                watch[i, BETWEEN] = watch[i, SQUARE_R]
    quiet(watch, clock)
    return OPENED if opened else -1


@compiled
def doubt(z: Array, r: Array, x: float, settings: Array, watch: Array, clock: Array, notes: Array) -> float:
    """Return the variance that stands for not knowing which sensor is right: how far the position is from each.

    Each one's position is by its zero from before the fault. Where all agree again for long enough, the doubt ends.
    """
    extra, agreed = 0.0, True
    for i in range(watch.shape[0]):
        if watch[i, DOUBT] > 0.0:
            if isfinite(z[i]):
                apart = z[i] - watch[i, ZERO] - x
                watch[i, BETWEEN] += _SLOW * (apart * apart - watch[i, BETWEEN])
            extra = max(extra, watch[i, BETWEEN] - r[i])
            agreed = agreed and watch[i, BETWEEN] < 2.0 * r[i]
    clock[AGREED] = clock[AGREED] + 1.0 if agreed else 0.0
    if clock[AGREED] >= settings[RESTORE_N]:
        watch[:, DOUBT] = 0.0
        clock[DISPUTED] = 0.0
        note(notes, clock, AGREEMENT, 0, clock[NOW], settings[RESTORE_N], 0.0)
    return extra
