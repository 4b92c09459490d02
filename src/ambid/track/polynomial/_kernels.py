"""Compiled recursion of the polynomial predictor, its gradients and the U-D filter of its coefficients.

Every signal is a row of one buffer that is written from column to column; when it is full, its end becomes the history
of a new beginning, so that a sample costs the same whether it comes alone or in a block. `orders` holds na, nc, nd,
n_inputs, whether there is a constant, the number of coefficients and the longest lag, then nb, nk, nf of each input.
Coefficients stand in the order A, B..., C, D, F..., constant.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Table = NDArray[np.int64]

# orders, then counters, then real numbers of the state
_NA, _NC, _ND, _NU, _CONSTANT, _N, _LONGEST, _INPUT = range(8)
POS, FILL, RINGING, USED, REJECTED, WAITED, PROJECTED, HELD, LEARNT, HOLD, N_COUNTS = range(11)
FORGET, FINAL, GROWTH, SQUARES, WEIGHT, Y_CENTRE, U_CENTRE = range(7)
# rows of the buffer: outputs, then six for each input
_Y, _V, _E, _YF, _EF, _VF, _KF, _RING, _FIRST_INPUT = range(9)
_U, _W, _UC, _UF, _WF, _WRING, _ROWS = range(7)
N_FIXED_ROWS, N_INPUT_ROWS = _FIRST_INPUT, _ROWS

_RADIUS = 0.99999  # roots of C and F stay inside
_HALVINGS = 30
_RUNG_OUT = 0.01  # of what was unknown at a new beginning: what is left then counts for nothing
_LONGEST_RING = 20000
_EVERY = 64  # samples between looks at the growth of the covariance


@njit(cache=True, nogil=True)
def _sum(theta: Array, first: int, n: int, s: Array, row: int, t: int) -> float:
    """Return sum_k theta[first + k] s[row, t - k]."""
    total = 0.0
    for k in range(n):
        total += theta[first + k] * s[row, t - k]
    return total


@njit(cache=True, nogil=True)
def _places(orders: Table) -> tuple[int, int, int]:
    """Return where C, D and the first F begin."""
    c = orders[_NA]
    for i in range(orders[_NU]):
        c += orders[_INPUT + 3 * i]
    return c, c + orders[_NC], c + orders[_NC] + orders[_ND]


@njit(cache=True, nogil=True)
def input_signals(orders: Table, at: Array, s: Array, t: int) -> None:
    """Write (D/C) u, D/(C F) u and D/C of the constant at column t; they need no output."""
    c, d, f = _places(orders)
    nc, nd = orders[_NC], orders[_ND]
    for i in range(orders[_NU]):
        row, nf = _FIRST_INPUT + _ROWS * i, orders[_INPUT + 3 * i + 2]
        x = s[row + _U, t] + _sum(at, d, nd, s, row + _U, t - 1) - _sum(at, c, nc, s, row + _UC, t - 1)
        s[row + _UC, t] = x
        s[row + _UF, t] = x - _sum(at, f, nf, s, row + _UF, t - 1)
        f += nf
    x = 1.0
    for k in range(nd):
        x += at[d + k]
    s[_KF, t] = x - _sum(at, c, nc, s, _KF, t - 1)


@njit(cache=True, nogil=True)
def residual(orders: Table, at: Array, s: Array, t: int) -> float:
    """Write w = (B/F) u, v = A y - w - constant and e = (D/C) v at column t; return e."""
    c, d, f = _places(orders)
    b = orders[_NA]
    v = s[_Y, t] + _sum(at, 0, orders[_NA], s, _Y, t - 1)
    for i in range(orders[_NU]):
        row, k = _FIRST_INPUT + _ROWS * i, _INPUT + 3 * i
        w = _sum(at, b, orders[k], s, row + _U, t - orders[k + 1]) - _sum(at, f, orders[k + 2], s, row + _W, t - 1)
        s[row + _W, t] = w
        v -= w
        b += orders[k]
        f += orders[k + 2]
    if orders[_CONSTANT]:
        v -= at[orders[_N] - 1]
    s[_V, t] = v
    e = v + _sum(at, d, orders[_ND], s, _V, t - 1) - _sum(at, c, orders[_NC], s, _E, t - 1)
    s[_E, t] = e
    return float(e)


@njit(cache=True, nogil=True)
def output_signals(orders: Table, at: Array, s: Array, t: int) -> None:
    """Write (D/C) y, e/C, v/C and D/(C F) w at column t, for the gradients of later samples."""
    c, d, f = _places(orders)
    nc, b = orders[_NC], orders[_NA]
    if orders[_NA]:
        s[_YF, t] = s[_Y, t] + _sum(at, d, orders[_ND], s, _Y, t - 1) - _sum(at, c, nc, s, _YF, t - 1)
    if nc:
        s[_EF, t] = s[_E, t] - _sum(at, c, nc, s, _EF, t - 1)
    if orders[_ND]:
        s[_VF, t] = s[_V, t] - _sum(at, c, nc, s, _VF, t - 1)
    for i in range(orders[_NU]):
        row, k = _FIRST_INPUT + _ROWS * i, _INPUT + 3 * i
        nf = orders[k + 2]
        if nf:  # (D/C) w is B times D/(C F) u
            x = _sum(at, b, orders[k], s, row + _UF, t - orders[k + 1])
            s[row + _WF, t] = x - _sum(at, f, nf, s, row + _WF, t - 1)
        b += orders[k]
        f += nf


@njit(cache=True, nogil=True)
def regressor(orders: Table, s: Array, t: int, psi: Array) -> None:
    """Write the gradient of the prediction at column t (theory.md 2.5)."""
    n = 0
    for k in range(orders[_NA]):
        psi[n] = -s[_YF, t - 1 - k]
        n += 1
    for i in range(orders[_NU]):
        row, lag = _FIRST_INPUT + _ROWS * i + _UF, orders[_INPUT + 3 * i + 1]
        for k in range(orders[_INPUT + 3 * i]):
            psi[n] = s[row, t - lag - k]
            n += 1
    for k in range(orders[_NC]):
        psi[n] = s[_EF, t - 1 - k]
        n += 1
    for k in range(orders[_ND]):
        psi[n] = -s[_VF, t - 1 - k]
        n += 1
    for i in range(orders[_NU]):
        row = _FIRST_INPUT + _ROWS * i + _WF
        for k in range(orders[_INPUT + 3 * i + 2]):
            psi[n] = -s[row, t - 1 - k]
            n += 1
    if orders[_CONSTANT]:
        psi[n] = s[_KF, t]


@njit(cache=True, nogil=True)
def _ud(UD: Array, psi: Array, forget: float, gain: Array) -> float:
    """Take one row into P = U D U' (Bierman 1977, ch. 5), P/forget before; return 1 + psi' P psi / forget.

    Row j of `UD` holds column j of U above its diagonal, D_j on it.
    """
    n, alpha = psi.size, forget
    for j in range(n):
        f = psi[j]
        for i in range(j):
            f += UD[j, i] * psi[i]
        g = UD[j, j] * f
        before = alpha
        alpha = before + f * g
        UD[j, j] *= before / (alpha * forget)
        gain[j] = g
        p = -f / before
        for i in range(j):
            x = UD[j, i]
            UD[j, i] = x + gain[i] * p
            gain[i] += x * g
    for j in range(n):
        gain[j] /= alpha
    return alpha / forget


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _predictor_stable(orders: Table, theta: Array, work: Array) -> bool:
    c, _, f = _places(orders)
    if orders[_NC] and not _stable(theta, c, orders[_NC], work):
        return False
    for i in range(orders[_NU]):
        nf = orders[_INPUT + 3 * i + 2]
        if nf and not _stable(theta, f, nf, work):
            return False
        f += nf
    return True


@njit(cache=True, nogil=True)
def _follow(orders: Table, theta: Array, at: Array, trial: Array, work: Array) -> int:
    """Move `at` towards theta as far as C and F stay stable; return 1 if it stopped short."""
    share = 1.0
    for _ in range(_HALVINGS):
        for j in range(theta.size):
            trial[j] = theta[j] if share == 1.0 else at[j] + share * (theta[j] - at[j])
        if _predictor_stable(orders, trial, work):
            at[:] = trial
            break
        share *= 0.5
    return int(share != 1.0)


@njit(cache=True, nogil=True)
def _grown(UD: Array, limit: Array, variance: float) -> bool:
    """Whether the variance of any coefficient is beyond its limit."""
    n = limit.size
    for i in range(n):
        p = UD[i, i]
        for j in range(i + 1, n):
            p += UD[j, i] * UD[j, i] * UD[j, j]
        if p * variance > limit[i]:
            return True
    return False


@njit(cache=True, nogil=True)
def _begin_ringing(orders: Table, s: Array, t: int, count: Table) -> None:
    """Stand for the unknown states of F and C at column t by ones in the past."""
    s[_RING, t - orders[_NC] : t] = 1.0
    states = orders[_NC]
    for i in range(orders[_NU]):
        nf = orders[_INPUT + 3 * i + 2]
        s[_FIRST_INPUT + _ROWS * i + _WRING, t - nf : t] = 1.0
        states += nf
    count[RINGING] = int(states > 0)


@njit(cache=True, nogil=True)
def _ring(orders: Table, at: Array, s: Array, t: int, count: Table) -> None:
    """Let the unknown states die away through 1/F and 1/C; end the waiting when they have."""
    c, _, f = _places(orders)
    most, through = 0.0, 0.0
    for i in range(orders[_NU]):
        row, nf = _FIRST_INPUT + _ROWS * i + _WRING, orders[_INPUT + 3 * i + 2]
        s[row, t] = -_sum(at, f, nf, s, row, t - 1)
        through += s[row, t]
        for k in range(nf):
            most = max(most, np.abs(s[row, t - k]))
        f += nf
    s[_RING, t] = through - _sum(at, c, orders[_NC], s, _RING, t - 1)
    for k in range(orders[_NC]):
        most = max(most, np.abs(s[_RING, t - k]))
    count[RINGING] += 1
    if most < _RUNG_OUT or count[RINGING] > _LONGEST_RING:
        count[RINGING] = 0


@njit(cache=True, nogil=True)
def _fill(orders: Table, at: Array, s: Array, t: int, count: Table) -> None:
    """One more sample of history: the noise is taken as zero, so the first w that has a memory is what is left of A y.

    From then on the error of w is of the size of the noise, not of the signal.
    """
    residual(orders, at, s, t)
    s[_E, t] = 0.0
    for i in range(orders[_NU]):
        row = _FIRST_INPUT + _ROWS * i
        if orders[_INPUT + 3 * i + 2]:
            s[row + _W, t] += s[_V, t]
            s[_V, t] = 0.0
            break
    count[FILL] += 1
    if count[FILL] >= orders[_LONGEST]:
        _begin_ringing(orders, s, t + 1, count)


@njit(cache=True, nogil=True)
def _learn(
    orders: Table,
    count: Table,
    real: Array,
    theta: Array,
    at: Array,
    UD: Array,
    S: Array,
    limit: Array,
    s: Array,
    t: int,
    work: Array,
) -> None:
    """One Gauss-Newton step (Ljung & Soderstrom 1983, eq. 3.150 ff.)."""
    psi, gain = work[0], work[1]
    e = s[_E, t]
    for j in range(theta.size):
        e -= psi[j] * (theta[j] - at[j])
    if count[LEARNT] % _EVERY == 0 and real[FINAL] < 1.0:
        count[HOLD] = int(_grown(UD, limit, real[SQUARES] / real[WEIGHT]))
    forget = real[FORGET]
    if count[HOLD]:
        forget = 1.0
        count[HELD] += 1
    real[FORGET] = real[FINAL] + real[GROWTH] * (real[FORGET] - real[FINAL])
    size = _ud(UD, psi, forget, gain)
    if S.shape[0]:
        for i in range(theta.size):
            for j in range(i + 1):
                S[i, j] = forget * forget * S[i, j] + psi[i] * psi[j]
    real[SQUARES] = forget * real[SQUARES] + e * e / size
    real[WEIGHT] = forget * real[WEIGHT] + 1.0
    for j in range(theta.size):
        theta[j] += gain[j] * e
    count[PROJECTED] += _follow(orders, theta, at, work[2], work[3])
    residual(orders, at, s, t)
    count[LEARNT] += 1


@njit(cache=True, nogil=True)
def _finite(u: Array, y: Array, k: int) -> bool:
    x = y[k]
    for i in range(u.shape[1]):
        x += u[k, i] * 0.0
    return bool(np.isfinite(x))


@njit(cache=True, nogil=True)
def _forget_signals(s: Array, count: Table, longest: int) -> None:
    s[:, :] = 0.0
    count[POS] = longest
    count[FILL] = 0
    count[RINGING] = 0


@njit(cache=True, nogil=True)
def run(
    u: Array,
    y: Array,
    errors: Array,
    learn: bool,
    orders: Table,
    count: Table,
    real: Array,
    theta: Array,
    at: Array,
    UD: Array,
    S: Array,
    limit: Array,
    s: Array,
    work: Array,
) -> None:
    """Take in samples u (m, n_inputs), y (m,); write the errors of prediction; `learn` false leaves coefficients."""
    longest, width = orders[_LONGEST], s.shape[1]
    for k in range(y.size):
        errors[k] = np.nan
        if not _finite(u, y, k):
            count[REJECTED] += 1
            _forget_signals(s, count, longest)
            continue
        count[USED] += 1
        t = count[POS]
        if t == width:
            for row in range(s.shape[0]):
                for j in range(longest):
                    s[row, j] = s[row, width - longest + j]
            t = longest
        count[POS] = t + 1
        s[_Y, t] = y[k] - real[Y_CENTRE]
        for i in range(orders[_NU]):
            s[_FIRST_INPUT + _ROWS * i + _U, t] = u[k, i] - real[U_CENTRE + i]
        input_signals(orders, at, s, t)
        if count[FILL] < longest:
            count[WAITED] += 1
            _fill(orders, at, s, t, count)
        else:
            e = residual(orders, at, s, t)
            if not np.isfinite(e * e):  # too large to compute with
                count[USED] -= 1
                count[REJECTED] += 1
                _forget_signals(s, count, longest)
                continue
            if count[RINGING]:
                count[WAITED] += 1
                _ring(orders, at, s, t, count)
            else:
                errors[k] = e
                if learn:
                    regressor(orders, s, t, work[0])
                    _learn(orders, count, real, theta, at, UD, S, limit, s, t, work)
        output_signals(orders, at, s, t)
