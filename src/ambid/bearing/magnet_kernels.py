"""The plant of the predictor, compiled: rates of change, Jacobian, derivatives by the numbers.

Physical numbers `theta` (20): the magnet's nine, then m, R, c, g, a, x_offset, i_offset, v_offset, v_drop, i_drop, and
the delay beyond whole samples.

The extended Kalman predictor of the nonlinear bearing and its exact sensitivities, compiled.

Physical numbers `theta` (20) as in `_plant_kernels`. Columns of all sensitivities: the active ones of these, then the
log noise levels.
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

MAGNET = 9
MASS, RESISTANCE, DAMPING, GRAVITY, POLE, X_OFF, I_OFF, V_OFF, V_DROP, I_DROP, LATE = range(MAGNET, MAGNET + 11)
N_NUMBERS = LATE + 1

# Numba looks for edits of a kernel's own file alone: after one of the co-energy, run make clean
_energy: Callable[..., None] = compiled(coenergy_derivatives)


@compiled
def drop_of(i: float, th: Array) -> tuple[float, float, float]:
    """Return what transistors and diodes take of the voltage at a current, its slope, and the slope over v_drop."""
    t = math.tanh(i / th[I_DROP])
    c = (1.0 - t * t) / th[I_DROP]
    return th[V_DROP] * t, th[V_DROP] * c, c


@compiled
def rates(z: Array, volt: Array, th: Array, flags: Flags, w: Array, dw: Array, g: Array, A: Array, G: Array) -> None:
    """Write the right-hand side g (n,), its Jacobian A (n, n), and its derivatives G (n, 20) by `theta`.

    `volt` is the voltage and its derivative by the delay. Position, velocity and current, then the force behind the
    eddy pole, then a drifting force, where `flags` (exponential, pair, eddy, drift, locked) have them.
    """
    for a in range(g.size):
        g[a] = 0.0
        for b in range(g.size):
            A[a, b] = 0.0
        for b in range(N_NUMBERS):
            G[a, b] = 0.0
    x, v, i = z[0], z[1], z[2]
    _energy(x, i, th, flags[0], flags[1], w, dw)
    m, ell = th[MASS], w[3]
    if not flags[4]:
        pull = z[3] if flags[2] else w[0]
        net = pull - th[DAMPING] * v
        last = g.size - 1
        if flags[3]:
            net += z[last]
            A[1, last] = 1.0 / m
        g[0] = v
        g[1] = net / m + th[GRAVITY]
        A[0, 1] = 1.0
        A[1, 1] = -th[DAMPING] / m
        if flags[2]:
            A[1, 3] = 1.0 / m
        else:
            A[1, 0] = w[1] / m
            A[1, 2] = w[2] / m
            for q in range(MAGNET):
                G[1, q] = dw[0, q] / m
        G[1, MASS] = -net / m**2
        G[1, DAMPING] = -v / m
        G[1, GRAVITY] = 1.0
    drop, steep, c = drop_of(i, th)
    rate = (volt[0] + th[V_OFF] - drop - th[RESISTANCE] * i - w[2] * v) / ell
    g[2] = rate
    A[2, 0] = (-w[5] * v - rate * w[6]) / ell
    A[2, 1] = -w[2] / ell
    A[2, 2] = (-th[RESISTANCE] - steep - w[6] * v - rate * w[7]) / ell
    for q in range(MAGNET):
        G[2, q] = (-dw[2, q] * v - rate * dw[3, q]) / ell
    G[2, RESISTANCE] = -i / ell
    G[2, V_OFF] = 1.0 / ell
    G[2, V_DROP] = -math.tanh(i / th[I_DROP]) / ell
    G[2, I_DROP] = th[V_DROP] * c * i / th[I_DROP] / ell
    G[2, LATE] = volt[1] / ell
    if flags[2]:
        g[3] = th[POLE] * (w[0] - z[3])
        A[3, 0], A[3, 2], A[3, 3] = th[POLE] * w[1], th[POLE] * w[2], -th[POLE]
        for q in range(MAGNET):
            G[3, q] = th[POLE] * dw[0, q]
        G[3, POLE] = w[0] - z[3]


Integers = NDArray[np.int64]


@compiled(fastmath={"contract"})
def _left(M: Array, X: Array, factor: float, out: Array) -> None:
    """Add factor M X to `out`, X (n, columns, p) a matrix for each of p numbers."""
    for a in range(out.shape[0]):
        for c in range(X.shape[0]):
            f = factor * M[a, c]
            if f != 0.0:
                for b in range(X.shape[1]):
                    for j in range(X.shape[2]):
                        out[a, b, j] += f * X[c, b, j]


@compiled(fastmath={"contract"})
def _right(X: Array, M: Array, factor: float, out: Array) -> None:
    """Add factor X M to `out`, X (n, n, p) a matrix for each of p numbers."""
    for c in range(X.shape[1]):
        for b in range(M.shape[1]):
            f = factor * M[c, b]
            if f != 0.0:
                for a in range(X.shape[0]):
                    for j in range(X.shape[2]):
                        out[a, b, j] += f * X[a, c, j]


@compiled(fastmath={"contract"})
def _sum(x: Array, factor: float, y: Array, out: Array) -> None:
    """Write x + factor y to `out`, all of one shape."""
    for a in range(x.shape[0]):
        for b in range(x.shape[1]):
            for j in range(x.shape[2]):
                out[a, b, j] = x[a, b, j] + factor * y[a, b, j]


@compiled
def _advance(
    z: Array, S: Array, th: Array, active: Integers, chain: Array, flags: Flags, volts: Array, h: float,
    steps: int, slopes: bool, w: Array, dw: Array, g: Array, A: Array, G: Array, room: Array,
) -> None:  # fmt: skip
    """Carry state and sensitivities over one sample in place by `steps` classical Runge-Kutta steps.

    `volts`: mean and slope of the voltage over the sample, and their derivatives by the delay.
    """
    n, n_a = z.size, active.size
    at, to, volt, K, Ss, St = np.empty(n), np.empty(n), np.empty(2), room[0], room[1], room[2]
    step = h / steps
    for k in range(steps):
        for a in range(n):
            to[a] = z[a]
            g[a] = 0.0
        if slopes:
            _sum(K, -1.0, K, K)
            _sum(S, 0.0, K, Ss)
        for stage in range(4):
            forth = 0.0 if stage == 0 else (step if stage == 3 else 0.5 * step)
            weight = step / 6.0 if stage in (0, 3) else step / 3.0
            where = (k + forth / step) / steps - 0.5
            volt[0] = volts[0] + volts[1] * where
            volt[1] = volts[2] + volts[3] * where
            for a in range(n):
                at[a] = z[a] + forth * g[a]
            rates(at, volt, th, flags, w, dw, g, A, G)
            for a in range(n):
                to[a] += weight * g[a]
            if slopes:
                _sum(S, forth, K, St)
                _sum(K, -1.0, K, K)
                _left(A, St, 1.0, K)
                for a in range(1, n):
                    for j in range(n_a):
                        K[a, 0, j] += G[a, active[j]] * chain[j]
                _sum(Ss, weight, K, Ss)
        for a in range(n):
            z[a] = to[a]
        if slopes:
            _sum(Ss, 0.0, K, S)


@compiled
def _bend(
    z: Array, S: Array, th: Array, active: Integers, chain: Array, flags: Flags, volt: Array, h: float, w: Array,
    dw: Array, g: Array, A: Array, dA: Array, dE: Array,
) -> None:  # fmt: skip
    """Write the total derivatives of A and E of `_spread` by all numbers: by themselves, and through the state."""
    n, p, n_a = S.shape[0], S.shape[2], active.size
    m, ell, last, rate, v, i = th[MASS], w[3], n - 1, g[2], z[1], z[2]
    push = 3 if flags[2] else 1
    gain = th[POLE] if flags[2] else 1.0 / m
    bf = 0.0 if flags[4] else 1.0 / m
    _, steep, c = drop_of(i, th)
    t, wide = math.tanh(i / th[I_DROP]), th[I_DROP]
    _sum(dA, -1.0, dA, dA)
    for j in range(p):
        dx, dv, di = S[0, 0, j], S[1, 0, j], S[2, 0, j]
        q = active[j] if j < n_a else -1
        f = chain[j] if j < n_a else 0.0
        xx, xi, ii = w[4] * dx + w[5] * di, w[5] * dx + w[6] * di, w[6] * dx + w[7] * di
        xxi, xii, iii = w[8] * dx + w[9] * di, w[9] * dx + w[10] * di, w[10] * dx + w[11] * di
        if 0 <= q < MAGNET:
            xx, xi, ii = xx + dw[1, q] * f, xi + dw[2, q] * f, ii + dw[3, q] * f
            xxi, xii, iii = xxi + dw[4, q] * f, xii + dw[5, q] * f, iii + dw[6, q] * f
        dm = f if q == MASS else 0.0
        dr, dc, da = f if q == RESISTANCE else 0.0, f if q == DAMPING else 0.0, f if q == POLE else 0.0
        d_drop, d_wide = f if q == V_DROP else 0.0, f if q == I_DROP else 0.0
        d_volt = (f if q == V_OFF else 0.0) + (volt[1] * f if q == LATE else 0.0)
        d_drop_all = t * d_drop + steep * (di - i / wide * d_wide)
        d_steep = c * d_drop + th[V_DROP] * (-2.0 * t * c / wide * di + (2.0 * t * i / wide - 1.0) * c / wide * d_wide)
        dgain = da if flags[2] else -dm / m**2
        if not flags[4]:
            dA[push, 0, j] += gain * xx + dgain * w[1]
            dA[push, 2, j] += gain * xi + dgain * w[2]
            dA[1, 1, j] += -dc / m + th[DAMPING] * dm / m**2
            if flags[2]:
                dA[1, 3, j] = -dm / m**2
                dA[3, 3, j] = -da
            if flags[3]:
                dA[1, last, j] = -dm / m**2
        d_rate = (d_volt - d_drop_all - dr * i - th[RESISTANCE] * di - xi * v - w[2] * dv - rate * ii) / ell
        dA[2, 0, j] = (-xxi * v - w[5] * dv - d_rate * w[6] - rate * xii - A[2, 0] * ii) / ell
        dA[2, 1, j] = (-xi - A[2, 1] * ii) / ell
        dA[2, 2, j] = (-dr - d_steep - xii * v - w[6] * dv - d_rate * w[7] - rate * iii - A[2, 2] * ii) / ell
        dbf = 0.0 if flags[4] else -dm / m**2
        dbv = -ii / ell**2
        for a in range(n):
            dE[a, 0, j] = 0.5 * h * h * (dA[a, 1, j] * bf + A[a, 1] * dbf)
            dE[a, 1, j] = 0.5 * h * h * (dA[a, 2, j] / ell + A[a, 2] * dbv)
        dE[1, 0, j] += h * dbf
        dE[2, 1, j] += h * dbv


@compiled
def _double(F: Array, dF: Array, E: Array, dE: Array, slopes: bool, T: Array, T2: Array, dT: Array) -> None:
    """Make F and E of a step those of two, in place: E <- E + F E, F <- F F, with their derivatives."""
    n = F.shape[0]
    if slopes:
        for a in range(n):
            for d in range(2):
                for j in range(dE.shape[2]):
                    s = dE[a, d, j]
                    for c in range(n):
                        s += dF[a, c, j] * E[c, d] + F[a, c] * dE[c, d, j]
                    dT[a, d, j] = s
        for a in range(n):
            for d in range(2):
                for j in range(dE.shape[2]):
                    dE[a, d, j] = dT[a, d, j]
        _sum(dT, -1.0, dT, dT)
        _right(dF, F, 1.0, dT)
        _left(F, dF, 1.0, dT)
        _sum(dT, 0.0, dF, dF)
    for a in range(n):
        for d in range(2):
            s = E[a, d]
            for c in range(n):
                s += F[a, c] * E[c, d]
            T2[a, d] = s
        for b in range(n):
            s = 0.0
            for c in range(n):
                s += F[a, c] * F[c, b]
            T[a, b] = s
    for a in range(n):
        for d in range(2):
            E[a, d] = T2[a, d]
        for b in range(n):
            F[a, b] = T[a, b]


@compiled
def _spread(
    z: Array, S: Array, P: Array, dP: Array, th: Array, active: Integers, chain: Array, flags: Flags,
    level2: Array, q2: Array, volts: Array, h: float, steps: int, slopes: bool, w: Array, dw: Array, g: Array,
    A: Array, G: Array, dA: Array, F: Array, dF: Array, T: Array, dT: Array, E: Array, dE: Array, T2: Array, H: Array,
) -> None:  # fmt: skip
    """Carry the covariance over one sample in place: P <- F P F' + E q2 E', F and E of the linearised plant.

    `q2` is `level2`, force, voltage and drift, with what is not known of force and voltage of this sample. A is the
    Jacobian where the sample begins, under its mean voltage; F = I + h A + (h A)^2/2 and E = h (I + h A/2) B of a
    step, put together over `steps` of them, a power of two.
    """
    h /= steps
    n, p, n_a = z.size, S.shape[2], active.size
    volt = np.empty(2)
    volt[0], volt[1] = volts[0], volts[2]
    rates(z, volt, th, flags, w, dw, g, A, G)
    m, ell, last = th[MASS], w[3], n - 1
    bf = 0.0 if flags[4] else 1.0 / m
    for a in range(n):
        for b in range(n):
            s = 0.0
            for c in range(n):
                s += A[a, c] * A[c, b]
            F[a, b] = h * A[a, b] + 0.5 * h * h * s
        F[a, a] += 1.0
        E[a, 0] = 0.5 * h * h * A[a, 1] * bf
        E[a, 1] = 0.5 * h * h * A[a, 2] / ell
    E[1, 0] += h * bf
    E[2, 1] += h / ell
    if slopes:
        _bend(z, S, th, active, chain, flags, volt, h, w, dw, g, A, dA, dE)
        _sum(dF, -1.0, dF, dF)
        for a in range(n):
            for b in range(n):
                H[a, b] = 0.5 * h * h * A[a, b]
            H[a, a] += 0.5 * h  # dF = H dA + dA H
        _left(H, dA, 1.0, dF)
        _right(dA, H, 1.0, dF)
    done = 1
    while done < steps:
        _double(F, dF, E, dE, slopes, T, T2, dT)
        done *= 2
    for a in range(n):
        for b in range(n):
            s = 0.0
            for c in range(n):
                s += P[a, c] * F[b, c]
            T[a, b] = s  # P F'
    if slopes:
        _sum(dT, -1.0, dT, dT)
        for a in range(n):
            for b in range(n):
                T2[a, b] = F[b, a]
        _left(F, dP, 0.5, dT)  # dT = F dP/2 + dF P, so that dP+ = dT F' + F dT' + noise
        _right(dF, P, 1.0, dT)
        _sum(dP, -1.0, dP, dP)
        _right(dT, T2, 1.0, dP)
        for a in range(n):
            for b in range(a, n):
                f00, f01 = E[b, 0] * q2[0], E[a, 0] * q2[0]
                f10, f11 = E[b, 1] * q2[1], E[a, 1] * q2[1]
                for j in range(p):
                    noise = f00 * dE[a, 0, j] + f01 * dE[b, 0, j] + f10 * dE[a, 1, j] + f11 * dE[b, 1, j]
                    dP[a, b, j] += dP[b, a, j] + noise
                    dP[b, a, j] = dP[a, b, j]
                for d in range(2):
                    dP[a, b, n_a + 2 + d] += 2.0 * level2[d] * E[a, d] * E[b, d]
                    dP[b, a, n_a + 2 + d] = dP[a, b, n_a + 2 + d]
        if flags[3]:
            dP[last, last, n_a + 4] += 2.0 * q2[2]
    for a in range(n):
        for b in range(a, n):
            s = E[a, 0] * E[b, 0] * q2[0] + E[a, 1] * E[b, 1] * q2[1]
            for c in range(n):
                s += F[a, c] * T[c, b]
            P[a, b] = s
            P[b, a] = s
    if flags[3]:
        P[last, last] += q2[2]


@compiled(fastmath={"contract"})
def _correct(
    e: float, de: Array, c: int, r2: float, level: int, z: Array, S: Array, P: Array, dP: Array, slopes: bool,
    rows: Array, col: Array, dcol: Array, dk: Array,
) -> float:  # fmt: skip
    """Take in one measured output, state number `c`; return its innovation variance.

    `rows` (2, p + 1) gets the rows of the likelihood: innovation over its deviation, and (1 - e^2/s)/sqrt(2) with the
    derivative ds/(s sqrt(2)): their inner products are gradient and Fisher information of (log s + e^2/s)/2.
    """
    n, p = S.shape[0], S.shape[2]
    for a in range(n):
        col[a] = P[a, c]
    s: float = col[c] + r2
    if slopes:
        root, narrow = math.sqrt(s), 1.0 / (s * math.sqrt(2.0))
        for a in range(n):
            for j in range(p):
                dcol[a, j] = dP[a, c, j]
        ds = dk[n]
        for j in range(p):
            ds[j] = dcol[c, j]
        ds[level] += 2.0 * r2
        for j in range(p):
            rows[0, j] = de[j] / root
            rows[1, j] = ds[j] * narrow
        rows[0, p], rows[1, p] = e / root, (1.0 - e * e / s) / math.sqrt(2.0)
        for a in range(n):
            f = col[a] / s
            for j in range(p):
                dk[a, j] = (dcol[a, j] - f * ds[j]) / s
                S[a, 0, j] += dk[a, j] * e + f * de[j]
        for a in range(n):
            f = col[a] / s
            for b in range(a, n):
                t = col[b]
                for j in range(p):
                    dP[a, b, j] -= dk[a, j] * t + f * dcol[b, j]
                    dP[b, a, j] = dP[a, b, j]
    for a in range(n):
        z[a] += col[a] * e / s
        for b in range(n):
            P[a, b] -= col[a] * col[b] / s
    return s


@compiled
def predict(
    u: Array, loose: Array, knock: Array, y: Array, valid: Flags, first: int, end: int, whole: int, th: Array,
    active: Integers, chain: Array, noise2: Array, flags: Flags, h: float, steps: int, z: Array, P: Array, S: Array,
    dP: Array, slopes: bool, e: Array, s: Array, rows: Array,
) -> bool:  # fmt: skip
    """Run the predictor from sample `first` to `end`; False where a gap closes or numbers cease to be finite.

    `u` (n,), `loose` (n,) variance of what is not known of it, `knock` (n, 2) of what is not known of the force, and of
    the motional voltage; `y` (n, 2) position and current, `valid` (n, 2): which of them are measured. `z` (n_states,)
    and `P` hold the state before sample `first`, `S` (n_states, 1, p) and `dP` (n_states, n_states, p) their
    derivatives, and all move along. `noise2` holds the squares of the levels of position,
    current, force, voltage and drift (of one sample). `e`, `s` (n, 2) get innovations and their variances; `rows`
    (4 (end - first), p + 1) the rows of the likelihood, where `slopes` wants them.
    """
    n, n_a = z.size, active.size
    p = n_a + 5
    w, dw = np.zeros(12), np.zeros((7, MAGNET))
    g, A, G = np.zeros(n), np.zeros((n, n)), np.zeros((n, N_NUMBERS))
    room = np.zeros((3, n, 1, p))
    dA, dF, dT, dE = np.zeros((n, n, p)), np.zeros((n, n, p)), np.zeros((n, n, p)), np.zeros((n, 2, p))
    F, T, E, T2, H = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, 2)), np.zeros((n, n)), np.zeros((n, n))
    col, dcol, dk, de, volts = np.zeros(n), np.zeros((n, p)), np.zeros((n + 1, p)), np.zeros(p), np.zeros(4)
    none, q2 = np.zeros((2, p + 1)), np.zeros(3)
    phi = th[LATE]
    for k in range(first, end):
        for c in range(2):
            if not valid[k, c]:
                continue
            at = 0 if c == 0 else 2
            error = y[k, c] - z[at] - th[X_OFF + c]
            if slopes:
                for j in range(p):
                    de[j] = -S[at, 0, j]
                for j in range(n_a):
                    if active[j] == X_OFF + c:
                        de[j] -= chain[j]
                # the derivative of the innovation is -(d prediction); the correction adds K (dy - dC z) = K de
            row = 4 * (k - first) + 2 * c
            out = rows[row : row + 2] if slopes else none
            s[k, c] = _correct(error, de, at, noise2[c], n_a + c, z, S, P, dP, slopes, out, col, dcol, dk)
            e[k, c] = error
        late, now = u[k - whole - 1], u[k - whole]
        volts[0], volts[1] = phi * late + (1.0 - phi) * now, 6.0 * phi * (1.0 - phi) * (now - late)
        volts[2], volts[3] = late - now, 6.0 * (1.0 - 2.0 * phi) * (now - late)
        for d in range(3):
            q2[d] = noise2[2 + d]
        q2[0] += knock[k, 0]
        q2[1] += max(loose[k - whole - 1], loose[k - whole]) + knock[k, 1]
        _spread(
            z, S, P, dP, th, active, chain, flags, noise2[2:], q2, volts, h, steps, slopes, w, dw, g, A, G, dA, F, dF,
            T, dT, E, dE, T2, H,
        )  # fmt: skip
        _advance(z, S, th, active, chain, flags, volts, h, steps, slopes, w, dw, g, A, G, room)
        low, high = z[0] + th[1], th[1] - z[0]
        if not flags[0] and (low <= 0.0 or (flags[1] and high <= 0.0)):
            return False
        if not (math.isfinite(z[0] + z[1] + z[2]) and math.isfinite(P[0, 0] + P[2, 2])):
            return False
    return True
