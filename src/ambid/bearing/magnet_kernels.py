"""The extended Kalman predictor of the nonlinear bearing and its exact sensitivities, compiled.

`theta` (21): the magnet's nine, then m, R, c, g, a, x_offset, i_offset, v_offset, v_drop, i_drop, tau, and the delay
beyond whole samples. A sensitivity is a lane: of a number, of a delay that becomes shorter instead of longer (`EARLY`:
the slopes differ where it is whole), or of the logarithm of a noise level. Lanes are the last axis in `X`, factors
stand in `C`, and states count by a tuple's length, so that the compiler can use vector instructions and unroll.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.physics.coenergy_law import coenergy_derivatives

Flags = NDArray[np.bool_]
Integers = NDArray[np.int64]
States = tuple[int, ...]

MAGNET = 9
MASS, RESISTANCE, DAMPING, GRAVITY, POLE, X_OFF, I_OFF, V_OFF, V_DROP, I_DROP, TAU, LATE = range(MAGNET, MAGNET + 12)
EARLY, LEVEL = LATE + 1, LATE + 2
"""Kinds of lanes: numbers, the delay either way, then six noise levels."""

PITCH = 32
"""Lanes that there is room for."""

_N = 6  # states that there is room for
# rows of `X`: state, covariance, each kind of lane but the magnet's, slopes of the law, derivatives of A, F and E, room
_S, _P, _KIND = 0, _N, _N + _N**2
_LAW = _KIND + LEVEL + 6 - MAGNET
_A, _F, _E = _LAW + 7, _LAW + 7 + _N**2, _LAW + 7 + 2 * _N**2
_U = _E + 2 * _N
_K, _SUM, _ROW = _U + _N**2, _U + _N**2 + _N, _U + _N**2 + 2 * _N
ROOM = (_ROW + 2) * PITCH
"""Length of `X`."""

# where the lanes of each kind begin in `X`
(
    _MASS,
    _RESISTANCE,
    _DAMPING,
    _GRAVITY,
    _POLE,
    _X_OFF,
    _,
    _V_OFF,
    _V_DROP,
    _I_DROP,
    _TAU,
    _LATE,
    _EARLY,
    _SENSOR,
    _,
    _FORCE,
) = (PITCH * (_KIND + kind) for kind in range(16))

# places in `C`: A, F, H and T = P F' in rows of `_N`, E in rows of two, then numbers
_CA, _CF, _CH, _CT, _CE, _CN = 0, _N**2, 2 * _N**2, 3 * _N**2, 4 * _N**2, 4 * _N**2 + 2 * _N

_energy: Callable[..., None] = compiled(coenergy_derivatives)


@compiled
def rates(z: Array, volt: float, th: Array, flags: Flags, w: Array, g: Array) -> tuple[float, float]:
    """Write the right-hand side g (n,) at a state under a voltage, by the co-energy's derivatives w (12,): position,
    velocity, current, force behind the eddy pole, drifting force and voltage, as `flags` (exponential, pair, eddy,
    drift, held) have them. Returns the share of v_drop that transistors and diodes take, and its slope by the current.
    """
    v, i, force, volt = z[1], z[2], z.size - 2, volt + th[V_OFF]
    if not flags[4]:
        net = (z[3] if flags[2] else w[0]) - th[DAMPING] * v
        if flags[3]:
            net += z[force]
            g[force] = -z[force] / th[TAU]
            volt += z[force + 1]
        g[0], g[1] = v, net / th[MASS] + th[GRAVITY]
    if flags[2]:
        g[3] = th[POLE] * (w[0] - z[3])
    share = math.tanh(i / th[I_DROP])
    g[2] = (volt - th[V_DROP] * share - th[RESISTANCE] * i - w[2] * v) / w[3]
    return share, (1.0 - share * share) / th[I_DROP]


@compiled
def jacobian(z: Array, th: Array, flags: Flags, w: Array, g: Array, steep: float, C: Array) -> None:
    """Write the Jacobian of the right-hand side to `C`, where `rates` was asked for last."""
    v, per = z[1], 1.0 / w[3]
    if not flags[4]:
        light = 1.0 / th[MASS]
        C[_CA + 1] = 1.0
        C[_CA + _N + 1] = -th[DAMPING] * light
        if flags[3]:
            force = z.size - 2
            C[_CA + _N + force], C[_CA + 2 * _N + force + 1] = light, per
            C[_CA + (_N + 1) * force] = -1.0 / th[TAU]
        if flags[2]:
            C[_CA + _N + 3] = light
            C[_CA + 3 * _N], C[_CA + 3 * _N + 2], C[_CA + 3 * _N + 3] = th[POLE] * w[1], th[POLE] * w[2], -th[POLE]
        else:
            C[_CA + _N], C[_CA + _N + 2] = w[1] * light, w[2] * light
    C[_CA + 2 * _N] = (-w[5] * v - g[2] * w[6]) * per
    C[_CA + 2 * _N + 1] = -w[2] * per
    C[_CA + 2 * _N + 2] = (-th[RESISTANCE] - th[V_DROP] * steep - w[6] * v - g[2] * w[7]) * per


@compiled
def _law_lanes(active: Integers, chain: Array, dw: Array, X: Array) -> None:
    """Write the slopes of the law by the magnet's numbers to their lanes."""
    for j in range(active.size):
        q = active[j]
        if q < MAGNET:
            for a in range(7):
                X[(_LAW + a) * PITCH + j] = dw[a, q] * chain[j]


@compiled
def _stage_factors(
    z: Array, th: Array, flags: Flags, w: Array, g: Array, drop: tuple[float, float], volts: Array, where: float,
    C: Array,
) -> None:  # fmt: skip
    """Write how the numbers act by themselves on the right-hand side, see `_stage_lanes`."""
    v, i, m, per, (share, steep) = z[1], z[2], th[MASS], 1.0 / w[3], drop
    free = 0.0 if flags[4] else 1.0
    C[_CN] = 0.0 if flags[2] else free / m
    C[_CN + 1], C[_CN + 2], C[_CN + 3] = -free * (g[1] - th[GRAVITY]) / m, -free * v / m, free
    C[_CN + 4], C[_CN + 5], C[_CN + 6], C[_CN + 7] = -v * per, -g[2] * per, -i * per, per
    C[_CN + 8], C[_CN + 9] = (volts[2] + volts[3] * where) * per, (volts[4] + volts[5] * where) * per
    C[_CN + 10], C[_CN + 11] = -share * per, th[V_DROP] * steep * i / th[I_DROP] * per
    C[_CN + 12] = th[POLE] if flags[2] else 0.0
    C[_CN + 13] = w[0] - z[3] if flags[2] else 0.0
    C[_CN + 14] = z[z.size - 2] / th[TAU] ** 2 if flags[3] else 0.0


@compiled(fastmath={"contract"})
def _stage_lanes(states: States, p: int, forth: float, weight: float, C: Array, X: Array) -> None:
    """Take the lanes of the state through one stage: K <- A (S + forth K) + what acts by itself; add to their sum."""
    n = len(states)
    m0, m1, m2, m3 = C[_CN], C[_CN + 1], C[_CN + 2], C[_CN + 3]
    e0, e1, e2, e3, e4 = C[_CN + 4], C[_CN + 5], C[_CN + 6], C[_CN + 7], C[_CN + 8]
    e5, e6, e7, f0, f1, f2 = C[_CN + 9], C[_CN + 10], C[_CN + 11], C[_CN + 12], C[_CN + 13], C[_CN + 14]
    for j in range(min(p, PITCH)):
        for a in range(n):
            X[(_U + a) * PITCH + j] = X[(_S + a) * PITCH + j] + forth * X[(_K + a) * PITCH + j]
        pull, motion, field = X[_LAW * PITCH + j], X[(_LAW + 2) * PITCH + j], X[(_LAW + 3) * PITCH + j]
        for a in range(n):
            X[(_K + a) * PITCH + j] = 0.0
        X[(_K + 1) * PITCH + j] = m0 * pull + m1 * X[_MASS + j] + m2 * X[_DAMPING + j] + m3 * X[_GRAVITY + j]
        X[(_K + 2) * PITCH + j] = (
            e0 * motion + e1 * field + e2 * X[_RESISTANCE + j] + e3 * X[_V_OFF + j] + e4 * X[_LATE + j]
            + e5 * X[_EARLY + j] + e6 * X[_V_DROP + j] + e7 * X[_I_DROP + j]
        )  # fmt: skip
        if n > 3:
            X[(_K + 3) * PITCH + j] = f0 * pull + f1 * X[_POLE + j]
            X[(_K + n - 2) * PITCH + j] += f2 * X[_TAU + j]
        for a in range(n):
            s = X[(_K + a) * PITCH + j]
            for c in range(n):
                s += C[_CA + _N * a + c] * X[(_U + c) * PITCH + j]
            X[(_K + a) * PITCH + j] = s
            X[(_SUM + a) * PITCH + j] += weight * s


@compiled
def _advance(
    states: States, p: int, z: Array, th: Array, active: Integers, chain: Array, flags: Flags, volts: Array, h: float,
    steps: int, w: Array, dw: Array, g: Array, at: Array, to: Array, C: Array, X: Array,
) -> None:  # fmt: skip
    """Carry state and sensitivities over one sample in place by `steps` Runge-Kutta steps, after `_spread` (`w`, `dw`,
    lanes). `volts`: mean and slope of the voltage over the sample, and their derivatives by a longer and by a shorter
    delay.
    """
    n, step = len(states), h / steps
    for k in range(steps):
        for a in range(n):
            to[a], g[a] = z[a], 0.0
            for j in range(p):
                X[(_K + a) * PITCH + j] = 0.0
                X[(_SUM + a) * PITCH + j] = X[(_S + a) * PITCH + j]
        for stage in range(4):
            forth = 0.0 if stage == 0 else (step if stage == 3 else 0.5 * step)
            weight = step / 6.0 if stage in (0, 3) else step / 3.0
            where = (k + forth / step) / steps - 0.5
            for a in range(n):
                at[a] = z[a] + forth * g[a]
            if stage + k > 0:
                _energy(at[0], at[2], th, flags[0], flags[1], w, dw)
                _law_lanes(active, chain, dw, X)
            drop = rates(at, volts[0] + volts[1] * where, th, flags, w, g)
            for a in range(n):
                to[a] += weight * g[a]
            if p:
                jacobian(at, th, flags, w, g, drop[1], C)
                _stage_factors(at, th, flags, w, g, drop, volts, where, C)
                _stage_lanes(states, p, forth, weight, C, X)
        for a in range(n):
            z[a] = to[a]
            for j in range(p):
                X[(_S + a) * PITCH + j] = X[(_SUM + a) * PITCH + j]


@compiled(fastmath={"contract"})
def _bend(
    states: States, p: int, z: Array, th: Array, flags: Flags, volts: Array, h: float, w: Array, g: Array,
    drop: tuple[float, float], C: Array, X: Array,
) -> None:  # fmt: skip
    """Write the derivatives of A, F and E of `_spread` by all lanes: by themselves, and through the state."""
    n, force = len(states), max(len(states) - 2, 3)
    v, i, m, rate, (share, steep) = z[1], z[2], th[MASS], g[2], drop
    free, eddy, drift = (0.0 if flags[4] else 1.0), (1.0 if flags[2] else 0.0), (1.0 if flags[3] else 0.0)
    light, heavy, per = free / m, -free / (m * m), 1.0 / w[3]
    near, through, pole = light * (1.0 - eddy), heavy * (1.0 - eddy), th[POLE] * eddy
    R, wide, damping = th[RESISTANCE], th[I_DROP], th[DAMPING]
    faster = 1.0 / th[TAU] ** 2 if flags[3] else 0.0
    slope, curl, turn = th[V_DROP] * steep, 2.0 * share / wide, i / wide
    w1, w2, w4, w5, w6, w7, w8, w9, w10, w11 = w[1], w[2], w[4], w[5], w[6], w[7], w[8], w[9], w[10], w[11]
    a20, a21, a22 = C[_CA + 2 * _N], C[_CA + 2 * _N + 1], C[_CA + 2 * _N + 2]
    late, early, half = volts[2], volts[4], 0.5 * h * h
    for j in range(min(p, PITCH)):
        dx, dv, di = X[_S * PITCH + j], X[(_S + 1) * PITCH + j], X[(_S + 2) * PITCH + j]
        dm, d_R, d_drop, d_wide = X[_MASS + j], X[_RESISTANCE + j], X[_V_DROP + j], X[_I_DROP + j]
        xx = w4 * dx + w5 * di + X[(_LAW + 1) * PITCH + j]
        xi = w5 * dx + w6 * di + X[(_LAW + 2) * PITCH + j]
        ii = w6 * dx + w7 * di + X[(_LAW + 3) * PITCH + j]
        xxi = w8 * dx + w9 * di + X[(_LAW + 4) * PITCH + j]
        xii = w9 * dx + w10 * di + X[(_LAW + 5) * PITCH + j]
        iii = w10 * dx + w11 * di + X[(_LAW + 6) * PITCH + j]
        X[(_A + _N) * PITCH + j] = near * xx + through * w1 * dm
        X[(_A + _N + 1) * PITCH + j] = -light * X[_DAMPING + j] - heavy * damping * dm
        X[(_A + _N + 2) * PITCH + j] = near * xi + through * w2 * dm
        if n > 3:
            X[(_A + _N + 3) * PITCH + j] = heavy * eddy * dm
            d_pole = eddy * X[_POLE + j]
            X[(_A + 3 * _N) * PITCH + j] = pole * xx + w1 * d_pole
            X[(_A + 3 * _N + 2) * PITCH + j] = pole * xi + w2 * d_pole
            X[(_A + 3 * _N + 3) * PITCH + j] = -d_pole
            X[(_A + _N + force) * PITCH + j] += heavy * drift * dm
            X[(_A + (_N + 1) * force) * PITCH + j] += faster * X[_TAU + j]
        d_volt = X[_V_OFF + j] + late * X[_LATE + j] + early * X[_EARLY + j] - share * d_drop
        d_volt -= slope * (di - turn * d_wide) + d_R * i + R * di + xi * v + w2 * dv
        if n > 4:
            d_volt += X[(_S + force + 1) * PITCH + j]
            X[(_A + 2 * _N + force + 1) * PITCH + j] = -drift * ii * per * per
        d_rate = (d_volt - rate * ii) * per
        d_slope = steep * d_drop + slope * ((curl * i - 1.0) / wide * d_wide - curl * di)
        X[(_A + 2 * _N) * PITCH + j] = -(xxi * v + w5 * dv + d_rate * w6 + rate * xii + a20 * ii) * per
        X[(_A + 2 * _N + 1) * PITCH + j] = -(xi + a21 * ii) * per
        X[(_A + 2 * _N + 2) * PITCH + j] = (
            -(d_R + d_slope + xii * v + w6 * dv + d_rate * w7 + rate * iii + a22 * ii) * per
        )
        d_light, d_per = heavy * dm, -ii * per * per
        for a in range(n):
            by_force = X[(_A + _N * a + 1) * PITCH + j] * light + C[_CA + _N * a + 1] * d_light
            by_volt = X[(_A + _N * a + 2) * PITCH + j] * per + C[_CA + _N * a + 2] * d_per
            X[(_E + 2 * a) * PITCH + j] = half * by_force
            X[(_E + 2 * a + 1) * PITCH + j] = half * by_volt
        X[(_E + 2) * PITCH + j] += h * d_light
        X[(_E + 5) * PITCH + j] += h * d_per
        for a in range(n):
            for b in range(n):
                s = 0.0
                for c in range(1, n):
                    s += C[_CH + _N * a + c] * X[(_A + _N * c + b) * PITCH + j]
                if a > 0:
                    for c in range(n):
                        s += X[(_A + _N * a + c) * PITCH + j] * C[_CH + _N * c + b]
                X[(_F + _N * a + b) * PITCH + j] = s


@compiled(fastmath={"contract"})
def _double(states: States, p: int, C: Array, X: Array) -> None:
    """Make F and E of a step those of two, in place: E <- E + F E, F <- F F, with their derivatives."""
    n = len(states)
    for j in range(min(p, PITCH)):
        for a in range(n):
            for d in range(2):
                s = X[(_E + 2 * a + d) * PITCH + j]
                for c in range(n):
                    s += X[(_F + _N * a + c) * PITCH + j] * C[_CE + 2 * c + d]
                    s += C[_CF + _N * a + c] * X[(_E + 2 * c + d) * PITCH + j]
                X[(_K + 2 * a + d) * PITCH + j] = s
            for b in range(n):
                s = 0.0
                for c in range(n):
                    s += X[(_F + _N * a + c) * PITCH + j] * C[_CF + _N * c + b]
                    s += C[_CF + _N * a + c] * X[(_F + _N * c + b) * PITCH + j]
                X[(_U + _N * a + b) * PITCH + j] = s
        for a in range(n):
            for d in range(2):
                X[(_E + 2 * a + d) * PITCH + j] = X[(_K + 2 * a + d) * PITCH + j]
            for b in range(n):
                X[(_F + _N * a + b) * PITCH + j] = X[(_U + _N * a + b) * PITCH + j]
    for a in range(n):  # T serves as room
        for d in range(2):
            s = C[_CE + 2 * a + d]
            for c in range(n):
                s += C[_CF + _N * a + c] * C[_CE + 2 * c + d]
            C[_CN + 2 * a + d] = s
        for b in range(n):
            s = 0.0
            for c in range(n):
                s += C[_CF + _N * a + c] * C[_CF + _N * c + b]
            C[_CT + _N * a + b] = s
    for a in range(n):
        for d in range(2):
            C[_CE + 2 * a + d] = C[_CN + 2 * a + d]
        for b in range(n):
            C[_CF + _N * a + b] = C[_CT + _N * a + b]


@compiled(fastmath={"contract"})
def _spread_lanes(states: States, p: int, drift: bool, q2: Array, C: Array, X: Array) -> None:
    """Carry the derivatives of the covariance: dP <- F dP F' + dF T + (dF T)' + that of the noise, T = P F'."""
    n = len(states)
    for j in range(min(p, PITCH)):
        for a in range(n):
            for b in range(n):
                s = 0.0
                for c in range(n):
                    s += C[_CF + _N * a + c] * X[(_P + _N * c + b) * PITCH + j]
                X[(_U + _N * a + b) * PITCH + j] = s
        for a in range(n):
            for b in range(a, n):
                s = 0.0
                for d in range(2):
                    f, g = C[_CE + 2 * a + d], C[_CE + 2 * b + d]
                    s += q2[d] * (g * X[(_E + 2 * a + d) * PITCH + j] + f * X[(_E + 2 * b + d) * PITCH + j])
                    s += f * g * X[_FORCE + d * PITCH + j]
                for c in range(n):
                    s += X[(_U + _N * a + c) * PITCH + j] * C[_CF + _N * b + c]
                    s += X[(_F + _N * a + c) * PITCH + j] * C[_CT + _N * c + b]
                    s += X[(_F + _N * b + c) * PITCH + j] * C[_CT + _N * c + a]
                X[(_P + _N * a + b) * PITCH + j] = s
                X[(_P + _N * b + a) * PITCH + j] = s
    if drift:
        for j in range(min(p, PITCH)):
            X[(_P + (_N + 1) * (n - 2)) * PITCH + j] += X[_FORCE + 2 * PITCH + j]
            X[(_P + (_N + 1) * (n - 1)) * PITCH + j] += X[_FORCE + 3 * PITCH + j]


@compiled
def _spread(
    states: States, p: int, z: Array, P: Array, th: Array, active: Integers, chain: Array, flags: Flags, q2: Array,
    volts: Array, h: float, steps: int, w: Array, dw: Array, g: Array, C: Array, X: Array,
) -> None:  # fmt: skip
    """Carry the covariance over one sample in place: P <- F P F' + E q2 E', F = I + h A + (h A)^2/2 and E = h (I + h
    A/2) B of a step, put together over `steps`, a power of two; A is the Jacobian where the sample begins, under its
    mean voltage. `q2`: variances of force, voltage and their drifts, with what is not known of force and voltage of
    this sample.
    """
    n = len(states)
    h /= steps
    _energy(z[0], z[2], th, flags[0], flags[1], w, dw)
    drop = rates(z, volts[0], th, flags, w, g)
    jacobian(z, th, flags, w, g, drop[1], C)
    light, per, half = 0.0 if flags[4] else 1.0 / th[MASS], 1.0 / w[3], 0.5 * h * h
    for a in range(n):
        for b in range(n):
            s = 0.0
            for c in range(n):
                s += C[_CA + _N * a + c] * C[_CA + _N * c + b]
            C[_CF + _N * a + b] = h * C[_CA + _N * a + b] + half * s
            C[_CH + _N * a + b] = half * C[_CA + _N * a + b]  # dF = H dA + dA H
        C[_CF + (_N + 1) * a] += 1.0
        C[_CH + (_N + 1) * a] += 0.5 * h
        C[_CE + 2 * a] = half * C[_CA + _N * a + 1] * light
        C[_CE + 2 * a + 1] = half * C[_CA + _N * a + 2] * per
    C[_CE + 2] += h * light
    C[_CE + 5] += h * per
    if p:
        _law_lanes(active, chain, dw, X)
        if n > 3:
            force = max(n - 2, 3)
            for j in range(p):
                X[(_A + _N + force) * PITCH + j] = 0.0
                X[(_A + (_N + 1) * force) * PITCH + j] = 0.0
        _bend(states, p, z, th, flags, volts, h, w, g, drop, C, X)
    done = 1
    while done < steps:
        _double(states, p, C, X)
        done *= 2
    for a in range(n):
        for b in range(n):
            s = 0.0
            for c in range(n):
                s += P[a, c] * C[_CF + _N * b + c]
            C[_CT + _N * a + b] = s
    if p:
        _spread_lanes(states, p, flags[3], q2, C, X)
    for a in range(n):
        for b in range(a, n):
            s = C[_CE + 2 * a] * C[_CE + 2 * b] * q2[0] + C[_CE + 2 * a + 1] * C[_CE + 2 * b + 1] * q2[1]
            for c in range(n):
                s += C[_CF + _N * a + c] * C[_CT + _N * c + b]
            P[a, b] = s
            P[b, a] = s
    if flags[3]:
        P[n - 2, n - 2] += q2[2]
        P[n - 1, n - 1] += q2[3]


@compiled(fastmath={"contract"})
def _correct_lanes(states: States, p: int, e: float, s: float, C: Array, X: Array) -> None:
    """Correct the lanes; those of prediction and variance become rows of the likelihood, see `_correct`."""
    n = len(states)
    root, narrow, per = 1.0 / math.sqrt(s), 1.0 / (s * math.sqrt(2.0)), 1.0 / s
    for j in range(min(p, PITCH)):
        de, ds = -X[_ROW * PITCH + j], X[(_ROW + 1) * PITCH + j]
        X[_ROW * PITCH + j], X[(_ROW + 1) * PITCH + j] = de * root, ds * narrow
        for a in range(n):
            gain = C[_CN + a] * per
            X[(_U + a) * PITCH + j] = (X[(_K + a) * PITCH + j] - gain * ds) * per
            X[(_S + a) * PITCH + j] += X[(_U + a) * PITCH + j] * e + gain * de
        for a in range(n):
            gain = C[_CN + a] * per
            for b in range(a, n):
                t = X[(_U + a) * PITCH + j] * C[_CN + b] + gain * X[(_K + b) * PITCH + j]
                X[(_P + _N * a + b) * PITCH + j] -= t
                X[(_P + _N * b + a) * PITCH + j] = X[(_P + _N * a + b) * PITCH + j]


@compiled
def _correct(
    states: States, e: float, o: int, r2: float, p: int, z: Array, P: Array, C: Array, X: Array, rows: Array
) -> float:  # fmt: skip
    """Take in output 0 (position) or 1 (current); return its innovation variance s. `rows` (2, p + 1) gets e over its
    deviation, and (1 - e^2/s)/sqrt(2) with derivative ds/(s sqrt(2)): inner products are gradient and Fisher
    information of (log s + e^2/s)/2.
    """
    n, at = len(states), 2 * o
    for a in range(n):
        C[_CN + a] = P[a, at]
    s: float = P[at, at] + r2
    if p:
        for j in range(p):
            X[_ROW * PITCH + j] = X[(_S + at) * PITCH + j] + X[_X_OFF + o * PITCH + j]
            X[(_ROW + 1) * PITCH + j] = X[(_P + (_N + 1) * at) * PITCH + j] + X[_SENSOR + o * PITCH + j]
        for a in range(n):
            for j in range(p):
                X[(_K + a) * PITCH + j] = X[(_P + _N * a + at) * PITCH + j]
        _correct_lanes(states, p, e, s, C, X)
        p = rows.shape[1] - 1
        for j in range(p):
            rows[0, j], rows[1, j] = X[_ROW * PITCH + j], X[(_ROW + 1) * PITCH + j]
        rows[0, p], rows[1, p] = e / math.sqrt(s), (1.0 - e * e / s) / math.sqrt(2.0)
    for a in range(n):
        z[a] += C[_CN + a] * e / s
        for b in range(n):
            P[a, b] -= C[_CN + a] * C[_CN + b] / s
    return s


@compiled
def predict(
    states: States, u: Array, push: Array, loose: Array, knock: Array, y: Array, valid: Flags, first: int, end: int,
    whole: int, th: Array, active: Integers, chain: Array, noise2: Array, flags: Flags, h: float, steps: int, z: Array,
    P: Array, X: Array, e: Array, s: Array, ahead: Array, rows: Array,
) -> bool:  # fmt: skip
    """Run the predictor from sample `first` to `end`; False where a gap closes or numbers cease to be finite. `u` (n,),
    `push` (n,) an acceleration that is known, `loose` (n,) the voltage's unknown variance, `knock` (n, 2) that of force
    and back-EMF; `y`, `valid` (n, 2): position and current, and whether measured; `active`, `chain` (p,): kind of each
    lane, and the derivative by it of a number, or twice the square of a level; without lanes the criterion alone.
    `noise2`: squared levels of position, current, force, voltage and their drifts (of one sample). `z`, `P`, `X`
    (`ROOM`,; zero at first), state, covariance and derivatives before `first`, move along; `e`, `s` (n, 2) get
    innovations and variances, `ahead` (n, 3) position, velocity and current as predicted, `rows` (4 (end - first),
    p + 1) the likelihood's.
    """
    n = len(states)
    p = min((active.size + 7) // 8 * 8, PITCH)  # a few stay empty, so that vector instructions leave none over
    w, dw, C = np.zeros(12), np.zeros((7, MAGNET)), np.zeros(_CN + 15)
    g, at, to, volts, q2 = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(6), np.zeros(4)
    for j in range(active.size):
        if active[j] >= MAGNET:
            X[(_KIND + active[j] - MAGNET) * PITCH + j] = chain[j]
    phi, gravity, th = th[LATE], th[GRAVITY], th.copy()
    for k in range(first, end):
        for o in range(3):
            ahead[k, o] = z[o]
        for o in range(2):
            if valid[k, o]:
                e[k, o] = y[k, o] - z[2 * o] - th[X_OFF + o]
                row = 4 * (k - first) + 2 * o if p else 0
                s[k, o] = _correct(states, e[k, o], o, noise2[o], p, z, P, C, X, rows[row : row + 2])
        late, now = u[k - whole - 1], u[k - whole]
        volts[0], volts[1] = phi * late + (1.0 - phi) * now, 6.0 * phi * (1.0 - phi) * (now - late)
        volts[2], volts[3] = late - now, 6.0 * (1.0 - 2.0 * phi) * (now - late)
        if whole > 0:
            soon = u[k - whole + 1]
            volts[4], volts[5] = now - soon, -6.0 * (soon - now)
        th[GRAVITY] = gravity + push[k]
        q2[0] = noise2[2] + knock[k, 0]
        q2[1] = noise2[3] + max(loose[k - whole - 1], loose[k - whole]) + knock[k, 1]
        q2[2], q2[3] = noise2[4], noise2[5]
        _spread(states, p, z, P, th, active, chain, flags, q2, volts, h, steps, w, dw, g, C, X)
        _advance(states, p, z, th, active, chain, flags, volts, h, steps, w, dw, g, at, to, C, X)
        low, high = z[0] + th[1], th[1] - z[0]
        if not flags[0] and (low <= 0.0 or (flags[1] and high <= 0.0)):
            return False
        if not (math.isfinite(z[0] + z[1] + z[2]) and math.isfinite(P[0, 0] + P[2, 2])):
            return False
    return True
