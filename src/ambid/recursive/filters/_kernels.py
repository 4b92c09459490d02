"""Compiled recursions of the streaming filters: one pass over a block, state moved along in place.

A value that is not finite is missing: the filter predicts over it. Every recursion returns how many were missing.
"""

from __future__ import annotations

from math import cos, isfinite, sin, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled

_SAME = 2e-15  # relative change of a square root of a covariance that is rounding
_NOTHING = 1e-40  # squared part of a row that no rotation has to bring to its diagonal


@compiled
def _begin(y: Array, out: Array, j: int, x: float, first: float) -> tuple[int, float]:
    """Pass over what is missing before the first sample, which gives the state where none was given (x is NaN)."""
    k = 0
    while x != x and k < y.shape[0]:
        if isfinite(y[k, j]):
            x = first * y[k, j]
        else:
            out[k, j] = x
            k += 1
    return k, x


@compiled(fastmath={"contract"})
def hold_scan(y: Array, out: Array, state: Array, constants: Array) -> int:
    """x+ = decay x + forward y, output x before y; over a missing y, x+ = alone x. `state` (m, 1)."""
    decay, forward, alone, first = constants
    missing = 0
    for j in range(y.shape[1]):
        begun, x = _begin(y, out, j, state[j, 0], first)
        missing += begun
        for k in range(begun, y.shape[0]):
            v = y[k, j]  # before out, which may be the same array
            out[k, j] = x
            if isfinite(v):
                x = decay * x + forward * v
            else:
                x *= alone
                missing += 1
        state[j, 0] = x
    return missing


@compiled(fastmath={"contract"})
def riccati_scan(y: Array, out: Array, state: Array, constants: Array) -> int:
    """Kalman-Bucy filter whose variance follows the Riccati equation exactly over each sample. `state` (m, 2): x, S.

    With g = c²/r, v² = a² + g w² q, t = tanh(v T)/v: V = 1 - a t + g S t is what exp(∫ (g S - a)) comes to, apart from
    cosh, and S+ = (w² q t + S (1 + a t))/V. Both stay positive.
    """
    a, g, drive, per_c, t, sech, area, alone, far = constants
    missing = 0
    for j in range(y.shape[1]):
        begun, x = _begin(y, out, j, state[j, 0], per_c)
        S = state[j, 1]
        missing += begun
        for k in range(begun, y.shape[0]):
            v = y[k, j]  # before out, which may be the same array
            out[k, j] = x
            if isfinite(v):
                short = 1.0 / (1.0 - a * t + g * S * t)
                level = v * per_c  # the state that this sample points to, held
                x = level + short * (sech * (x - level) + a * level * (t + (g * S - a) * area))
                S = (drive * t + S * (1.0 + a * t)) * short
            else:
                x *= alone
                S = alone * alone * S + far
                missing += 1
        state[j, 0], state[j, 1] = x, S
    return missing


@compiled(fastmath={"contract"})
def scalar_scan(y: Array, out: Array, state: Array, constants: Array) -> int:
    """Discrete scalar Kalman filter. `state` (m, 3): predicted x and P, whether P has stopped changing."""
    rho, c, q, r, predicted = constants
    missing = 0
    for j in range(y.shape[1]):
        begun, x = _begin(y, out, j, state[j, 0], 1.0 / c)
        missing += begun
        P, settled = state[j, 1], state[j, 2] > 0.0
        gain = c * P / (c * c * P + r)
        for k in range(begun, y.shape[0]):
            v = y[k, j]
            if isfinite(v):
                if settled:
                    now = x + gain * (v - c * x)
                else:
                    s = 1.0 / (c * c * P + r)
                    gain = c * P * s
                    now = x + gain * (v - c * x)
                    new = rho * rho * (P * r * s) + q
                    settled = abs(new - P) <= _SAME * P
                    P = new
            else:
                now = x
                P = rho * rho * P + q
                settled = False
                missing += 1
            out[k, j] = x if predicted > 0.0 else now
            x = rho * now
        state[j, 0], state[j, 1], state[j, 2] = x, P, 1.0 if settled else 0.0
    return missing


@compiled(fastmath={"contract"})
def lower(M: Array, rows: int, columns: int) -> None:
    """Turn M[:rows, :columns] into lower triangular form with a diagonal of at least 0, by reflections of columns."""
    for i in range(min(rows, columns)):
        a, rest = M[i, i], 0.0
        for j in range(i + 1, columns):
            rest += M[i, j] * M[i, j]
        size = sqrt(a * a + rest)
        if rest > _NOTHING * a * a:
            head = -rest / (a + size) if a > 0.0 else a - size
            scale = -1.0 / (size * head)
            for k in range(i + 1, rows):
                along = head * M[k, i]
                for j in range(i + 1, columns):
                    along += M[i, j] * M[k, j]
                along *= scale
                M[k, i] -= head * along
                for j in range(i + 1, columns):
                    M[k, j] -= M[i, j] * along
        elif a < 0.0:
            for k in range(i + 1, rows):
                M[k, i] = -M[k, i]
        M[i, i] = size
        for j in range(i + 1, columns):
            M[i, j] = 0.0


@compiled(fastmath={"contract"})
def state_scan(
    y: Array, u: Array, out: Array, innovations: Array, model: Array, memory: Array, work: Array, tally: Array
) -> None:
    """Square-root Kalman filter (array form; Kailath, Sayed and Hassibi 2000, ch. 12).

    `model` (n + m, n + n_u + p): [A B G; C 0 L] with G Gᵀ = Q, L Lᵀ = R. `memory` (n + m, n + 1 + m): root of the
    covariance, predicted state and gain; below, the root of the innovation covariance in the last columns. `tally`:
    whether the covariance has stopped changing, whether predictions are wanted, values missing, values used, their
    squared normalised innovations. `innovations` gets y - C x, or NaN.
    """
    n_samples, m = y.shape
    n = model.shape[0] - m
    n_u = u.shape[1]
    p = model.shape[1] - n - n_u
    settled, predicted = tally[0] > 0.0, tally[1] > 0.0
    z = n + n_u
    for k in range(n_samples):
        seen = 0
        for i in range(m):
            if isfinite(y[k, i]):
                e = y[k, i]
                for j in range(n):
                    e -= model[n + i, j] * memory[j, n]
                innovations[k, i] = e
                seen += 1
            else:
                innovations[k, i] = np.nan
        tally[2] += m - seen
        tally[3] += seen
        if predicted:
            for i in range(n):
                out[k, i] = memory[i, n]
        if not (settled and seen == m):
            settled = _cover(innovations[k], model, memory, work, n, m, p, z) and seen == m
        _correct(innovations[k], memory, work, n, m, tally)
        if not predicted:
            for i in range(n):
                out[k, i] = memory[i, n]
        for i in range(n):
            x = 0.0
            for j in range(n):
                x += model[i, j] * memory[j, n]
            for j in range(n_u):
                x += model[i, n + j] * u[k, j]
            work[i, 0] = x
        for i in range(n):
            memory[i, n] = work[i, 0]
    tally[0] = 1.0 if settled else 0.0


@compiled(fastmath={"contract"})
def two_state_scan(
    y: Array, _u: Array, out: Array, innovations: Array, model: Array, memory: Array, _work: Array, tally: Array
) -> None:
    """`state_scan` of two states, one measurement and no input, spelled out so that it stays in registers.

    S (I - h hᵀ/α) Sᵀ with h = C S, β = r + h1², α = β + h0² has the root S [[√(β/α), 0], [-h0 h1/√(α β), √(r/β)]]:
    no difference of like numbers is taken.
    """
    a00, a01, a10, a11 = model[0, 0], model[0, 1], model[1, 0], model[1, 1]
    q00, q01, q10, q11 = model[0, 2], model[0, 3], model[1, 2], model[1, 3]
    c0, c1, sd = model[2, 0], model[2, 1], model[2, 2]
    s00, s10, s11 = memory[0, 0], memory[1, 0], memory[1, 1]
    p0, p1, g0, g1, root = memory[0, 2], memory[1, 2], memory[0, 3], memory[1, 3], memory[2, 3]
    settled, predicted = tally[0] > 0.0, tally[1] > 0.0
    missing, squares = 0, tally[4]
    part = 1.0 / root if root > 0.0 else 0.0
    k = -1
    while k + 1 < y.shape[0]:
        k += 1
        if settled:  # one linear recursion up to what is missing
            k0, k1 = g0 * part, g1 * part
            l0, l1 = a00 * k0 + a01 * k1, a10 * k0 + a11 * k1
            b00, b01, b10, b11 = a00 - l0 * c0, a01 - l0 * c1, a10 - l1 * c0, a11 - l1 * c1
            weight = part * part
            while k < y.shape[0] and isfinite(y[k, 0]):
                v = y[k, 0]
                e = v - (c0 * p0 + c1 * p1)
                innovations[k, 0] = e
                squares += e * e * weight
                if predicted:
                    out[k, 0], out[k, 1] = p0, p1
                else:
                    out[k, 0], out[k, 1] = p0 + k0 * e, p1 + k1 * e
                p0, p1 = l0 * v + (b00 * p0 + b01 * p1), l1 * v + (b10 * p0 + b11 * p1)
                k += 1
            if k == y.shape[0]:
                break
        if predicted:
            out[k, 0], out[k, 1] = p0, p1
        e = y[k, 0] - (c0 * p0 + c1 * p1)
        seen = isfinite(e)
        f00, f10, f11 = s00, s10, s11
        if seen:
            h0, h1 = c0 * s00 + c1 * s10, c1 * s11
            beta = sqrt(sd * sd + h1 * h1)
            root = sqrt(sd * sd + h1 * h1 + h0 * h0)
            part, per_beta = 1.0 / root, 1.0 / beta
            g0, g1 = s00 * h0 * part, (s10 * h0 + s11 * h1) * part
            f00 = s00 * (beta * part)
            f10 = s10 * (beta * part) - s11 * (h0 * part) * (h1 * per_beta)
            f11 = s11 * (sd * per_beta)
        m0, m1 = a00 * f00 + a01 * f10, a01 * f11
        n0, n1 = a10 * f00 + a11 * f10, a11 * f11
        t00 = sqrt(m0 * m0 + m1 * m1 + q00 * q00 + q01 * q01)
        along = (m0 * n0 + m1 * n1 + q00 * q10 + q01 * q11) / t00
        w = along / t00
        n0, n1, n2, n3 = n0 - w * m0, n1 - w * m1, q10 - w * q00, q11 - w * q01
        t11 = sqrt(n0 * n0 + n1 * n1 + n2 * n2 + n3 * n3)
        change = max(abs(along - s10), abs(t11 - s11))
        settled = seen and abs(t00 - s00) <= _SAME * t00 and change <= _SAME * (abs(along) + t11)
        s00, s10, s11 = t00, along, t11
        if seen:
            innovations[k, 0] = e
            e *= part
            x0, x1 = p0 + g0 * e, p1 + g1 * e
            squares += e * e
        else:
            innovations[k, 0] = np.nan
            x0, x1 = p0, p1
            missing += 1
        if not predicted:
            out[k, 0], out[k, 1] = x0, x1
        p0, p1 = a00 * x0 + a01 * x1, a10 * x0 + a11 * x1
    memory[0, 0], memory[1, 0], memory[1, 1] = s00, s10, s11
    memory[0, 2], memory[1, 2], memory[0, 3], memory[1, 3], memory[2, 3] = p0, p1, g0, g1, root
    tally[0] = 1.0 if settled else 0.0
    tally[2] += missing
    tally[3] += y.shape[0] - missing
    tally[4] = squares


@compiled(fastmath={"contract"})
def _cover(e: Array, model: Array, memory: Array, work: Array, n: int, m: int, p: int, z: int) -> bool:
    """Move the root of the covariance over one sample, and say whether it stayed where it was.

    [[L, C S], [0, S]], rows of what was measured only, becomes [[root, 0], [gain, S filtered]].
    """
    row = 0
    for i in range(m):
        if isfinite(e[i]):
            for j in range(m):
                work[row, j] = model[n + i, z + j]
            for j in range(n):
                h = 0.0
                for r in range(n):
                    h += model[n + i, r] * memory[r, j]
                work[row, m + j] = h
            row += 1
    for i in range(n):
        for j in range(m):
            work[row + i, j] = 0.0
        for j in range(n):
            work[row + i, m + j] = memory[i, j]
    lower(work, row + n, m + n)
    for j in range(row):
        for i in range(row):
            memory[n + i, n + 1 + j] = work[i, j]
        for i in range(n):
            memory[i, n + 1 + j] = work[row + i, j]
    for i in range(n):  # then over the sample: [A S, G]
        for j in range(n):
            work[i, n + p + j] = work[row + i, row + j]
    for i in range(n):
        for j in range(n):
            s = 0.0
            for r in range(j, n):
                s += model[i, r] * work[r, n + p + j]
            work[i, j] = s
        for j in range(p):
            work[i, n + j] = model[i, z + j]
    lower(work, n, n + p)
    same = True
    for i in range(n):
        size, change = 0.0, 0.0
        for j in range(i + 1):
            size += work[i, j] * work[i, j]
            change = max(change, abs(work[i, j] - memory[i, j]))
            memory[i, j] = work[i, j]
        same = same and change <= _SAME * sqrt(size)
    return same


@compiled(fastmath={"contract"})
def _correct(e: Array, memory: Array, work: Array, n: int, m: int, tally: Array) -> None:
    """x += gain root⁻¹ e for what was measured."""
    row = 0
    for i in range(m):
        if isfinite(e[i]):
            v = e[i]
            for j in range(row):
                v -= memory[n + row, n + 1 + j] * work[j, 0]
            v /= memory[n + row, n + 1 + row]
            work[row, 0] = v
            tally[4] += v * v
            for r in range(n):
                memory[r, n] += memory[r, n + 1 + row] * v
            row += 1


@compiled(fastmath={"contract"})
def synchronous_scan(y: Array, phase: Array, out: Array, state: Array, constants: Array) -> int:
    """Follow cos φ, sin φ and an offset, all in random walks, and take the rotation off.

    `state` (m, 18): cosine, sine, offset; root of their covariance over that of the noise (row by row, 9); sums of
    cos φ e and sin φ e over a batch, samples in it; noise density at the rotation; batches; samples seen.
    """
    step, most, longest, start = constants[0], constants[1], constants[2], constants[3]
    taper = constants[4:]  # against leakage of stronger noise at other frequencies
    work = np.zeros((4, 6))
    missing = 0
    for j in range(y.shape[1]):
        s = state[j]
        for k in range(y.shape[0]):
            v, c, d = y[k, j], cos(phase[k]), sin(phase[k])
            if not (isfinite(v) and isfinite(c)):
                out[k, j] = v if not isfinite(v) else np.nan
                missing += 1
                continue
            if s[17] == 0.0:
                s[2] = v
                s[3], s[7], s[11] = start, start, start
            s[17] += 1.0
            out[k, j] = v - s[0] * c - s[1] * d
            e = out[k, j] - s[2]
            work[0, 0] = 1.0
            for i in range(3):
                work[1 + i, 0] = 0.0
                work[0, 1 + i] = c * s[3 + i] + d * s[6 + i] + s[9 + i]
                for r in range(3):
                    work[1 + r, 1 + i] = s[3 + 3 * r + i]
            lower(work, 4, 4)
            gain = e / work[0, 0]
            s[0] += work[1, 0] * gain
            s[1] += work[2, 0] * gain
            s[2] += work[3, 0] * gain
            e *= taper[int(s[14])] / work[0, 0]
            s[12] += c * e
            s[13] += d * e
            s[14] += 1.0
            if s[14] >= taper.size:  # the mean squared sum is the density of the noise around the rotation
                s[16] = min(s[16] + 1.0, longest)
                s[15] += ((s[12] * s[12] + s[13] * s[13]) / s[14] - s[15]) / s[16]
                s[12], s[13], s[14] = 0.0, 0.0, 0.0
            total = 0.0
            for r in range(3):
                for i in range(3):
                    work[r, i] = work[1 + r, 1 + i]
                    total += work[r, i] * work[r, i]
            if total < most:  # without rotation nothing bounds the covariance but this
                for r in range(3):
                    for i in range(3):
                        work[r, 3 + i] = step if i == r else 0.0
                lower(work, 3, 6)
            for r in range(3):
                for i in range(3):
                    s[3 + 3 * r + i] = work[r, i]
    return missing
