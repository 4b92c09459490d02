"""Compiled loops of the tracker: predictor with exact sensitivities, folded block by block into a triangle; and the
filter of the tracked numbers, on the square-root core of all recursions.

One step of the predictor is x+ = M w, w = [x; inputs at their lags; y; 1; unbalance forcing]; the derivative by number
q is s_q+ = F s_q + D_q w. Weighted innovations and their derivatives are the rows that Householder reflections take
into the triangle, at fixed counts of samples, so that numbers do not depend on how the stream is cut into calls.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.square_root_kernels import project, shrink, widen

Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

_MOST = 0.5  # part of a positive number by which one block may lower it


@compiled(error_model="numpy", fastmath={"contract"})
def advance(
    first: int, u: Array, y: Array, forcing: Array, M: Array, D: Array, scale: Array, lags: Integers, history: Array,
    s: Array, rows: Array, counts: Integers, unit: Array, errors: Array, w: Array, f: Array,
) -> int:  # fmt: skip
    """Run from sample `first` until a block is complete, `rows` are full, samples are used up, or one is not finite.

    Returns the sample that comes next.

    `u`, `y` in SI; `scale` (2, n_u + n_y) holds the operating point and the scales. `M` (n_x + n_y, n_l) gives the next
    state and the weighted innovations, `s` (n_x, p + 1) holds the sensitivities and in its last column the state.
    `errors` (n_samples, n_y) gets the innovations in SI, the triangle `unit` times weighted ones. `rows` (p + 1, room)
    holds rows that are not folded yet. `counts`: place of the next input in `history`, rows and samples of the present
    block, samples still to settle, samples of a block. `w` (n_l,) and `f` (n_x + n_y, p + 1) are scratch.
    """
    n_x, n_u, n_y, p = s.shape[0], u.shape[1], y.shape[1], s.shape[1] - 1
    depth, n_f, room, high, n_l = history.shape[0], forcing.shape[1], rows.shape[1], f.shape[0], w.size
    for k in range(first, y.shape[0]):
        now, column, total = counts[0], n_x, 0.0
        for j in range(n_u):
            history[now, j] = (u[k, j] - scale[0, j]) / scale[1, j]
            total += u[k, j]
        for lag in lags:
            for j in range(n_u):
                w[column] = history[(now - lag) % depth, j]
                column += 1
        for j in range(n_y):
            w[column] = (y[k, j] - scale[0, n_u + j]) / scale[1, n_u + j]
            total += y[k, j]
            column += 1
        w[column] = 1.0
        for j in range(n_f):
            w[column + 1 + j] = forcing[k, j]
            total += forcing[k, j]
        if not math.isfinite(total):
            return k
        counts[0] = (now + 1) % depth
        for j in range(n_x):
            w[j] = s[j, p]
        for i in range(high):
            for q in range(p + 1):
                f[i, q] = M[i, 0] * s[0, q]
            for j in range(1, n_x):
                v = M[i, j]
                for q in range(p + 1):
                    f[i, q] += v * s[j, q]
        for c in range(n_l):
            v = w[c]
            for i in range(n_x):
                for q in range(p):
                    f[i, q] += v * D[c, i, q]
            if c >= n_x:
                for i in range(high):
                    f[i, p] += v * M[i, c]
        r, settled = counts[1], counts[3] == 0
        for i in range(n_y):
            v = 0.0
            for j in range(i + 1):
                v += unit[i, j] * f[n_x + j, p]
            errors[k, i] = v
            if settled:
                for q in range(p + 1):
                    rows[q, r + i] = f[n_x + i, q]
        for i in range(n_x):
            for q in range(p + 1):
                s[i, q] = f[i, q]
        if settled:
            counts[1] = r + n_y
            counts[2] += 1
        else:
            counts[3] -= 1
        if counts[1] + n_y > room or counts[2] == counts[4]:
            return k + 1
    return len(y)


@compiled(error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def fold(R: Array, w: Array, n: int, begun: int) -> None:
    """Take `n` rows into the upper triangle R (p, width), width >= p; `w` (width, room) has them in columns, used up.

    Entry j of a row is zero in all but the first `begun` + j of them: `n` for any rows, 1 for those of a triangle.
    """
    p, width = R.shape
    for j in range(p):
        v = w[j]
        m = min(n, begun + j)
        s = 0.0
        for t in range(m):
            s += v[t] * v[t]
        if s == 0.0:
            continue
        a = R[j, j]
        b = -math.sqrt(a * a + s) if a > 0 else math.sqrt(a * a + s)
        size, tau = 1.0 / (a - b), (b - a) / b
        R[j, j] = b
        for k in range(j + 1, width):
            x = w[k]
            dot = 0.0
            for t in range(m):
                dot += v[t] * x[t]
            g = tau * (R[j, k] + dot * size)
            R[j, k] -= g
            g *= size
            for t in range(m):
                x[t] -= g * v[t]


@compiled(error_model="numpy")
def absorb(
    q: Array, F: Array, J: Array, r: Array, at: Array, active: Flags, positive: Flags, noise: float, K: Array
) -> tuple[float, float]:
    """Update q and the factors F of its covariance by the rows r + J (q* - at) ~ N(0, noise I), J upper triangular.

    Return rho^T V^-1 rho, where rho = r + J (q - at) and V = noise I + J P J^T, and the part of the step that is taken.
    The gain is optimal for the numbers that are active and zero for the others (Schmidt). Where the step would take a
    positive number below half of what it is, gain and step are made smaller: so far a first-order step is not to be
    believed. With a gain D K, K optimal and D diagonal, the covariance is that of K plus (I - D) K V K^T (I - D), and
    K V K^T the sum of what the rows have taken off one by one (Joseph's form). `K` (p + 2, p) is scratch.
    """
    p, total, part, held = q.size, 0.0, 1.0, False
    step, f = K[p], K[p + 1]
    for j in range(p):
        step[j] = 0.0
    for i in range(p):
        rho = r[i]
        for j in range(i, p):
            rho += J[i, j] * (q[j] - at[j] + step[j])
        project(F, J[i], f)
        alpha = shrink(F, f, noise, K[i])
        total += rho * rho / alpha
        root = 1.0 / math.sqrt(alpha)
        for j in range(p):
            K[i, j] *= root
            step[j] -= K[i, j] * root * rho
    for j in range(p):
        if not active[j]:
            held = True
        elif positive[j] and -step[j] > _MOST * q[j]:
            part = min(part, -_MOST * q[j] / step[j])
    for j in range(p):
        if active[j]:
            q[j] += part * step[j]
    if held or part < 1.0:
        for i in range(p):
            for j in range(p):
                f[j] = K[i, j] * (1.0 - part) if active[j] else K[i, j]
            widen(F, f, 1.0)
    return total, part


@compiled(error_model="numpy", fastmath={"contract"})
def filter_ring(
    J: Array, r: Array, at: Array, count: int, first: int, q: Array, P: Array, step: Array, noise: float, K: Array
) -> None:
    """Take `q` (p,) and `P` (p, p) from before a ring of `count` blocks to behind it.

    Kalman filter over blocks `first`, ..., their rows one by one, with a random walk of variance step^2 from one block
    to the next. J (size, p, p) upper triangular; `K` (size, p, p + 2) keeps gains, residuals and their variances. Inner
    loops run along rows of symmetric matrices: they take no sums, so that vector instructions fit.
    """
    size, p = r.shape
    for b in range(count):
        block = (first + b) % size
        for i in range(p):
            z, g = J[block, i], K[b, i]
            v, F = r[block, i], noise
            for a in range(p):
                g[a] = z[i] * P[i, a]
            for c in range(i + 1, p):
                w = z[c]
                for a in range(p):
                    g[a] += w * P[c, a]
            for a in range(i, p):
                v += z[a] * (q[a] - at[block, a])
                F += g[a] * z[a]
            g[p], g[p + 1] = v, F
            for a in range(p):
                w = g[a] / F
                q[a] -= w * v
                for c in range(p):
                    P[a, c] -= w * g[c]
        if b < count - 1:
            for a in range(p):
                P[a, a] += step[a] * step[a]


@compiled(error_model="numpy", fastmath={"contract"})
def smooth_ring(J: Array, count: int, first: int, K: Array, found: Array, N: Array) -> None:
    """Fill the first rows of `found` (4, p) with the sums of lambda_j^2 and of N_jj, twice the score their difference.

    Disturbance smoother backward over what `filter_ring` kept (Koopman and Shephard 1992; Durbin and Koopman 2012, sec.
    4.5 and 6.4). `N` (p, p) is scratch.
    """
    size, p, squares, powers, lam, drop = J.shape[0], J.shape[1], found[0], found[1], found[2], found[3]
    for a in range(p):
        squares[a] = powers[a] = lam[a] = 0.0
        for c in range(p):
            N[a, c] = 0.0
    for b in range(count - 1, -1, -1):
        block = (first + b) % size
        if b < count - 1:
            for a in range(p):
                squares[a] += lam[a] * lam[a]
                powers[a] += N[a, a]
        for i in range(p - 1, -1, -1):
            z, g = J[block, i], K[b, i]
            # L = I - K z / F:  lambda <- -z error / F + L^T lambda,  N <- z z^T / F + L^T N L
            F, dot, twice = g[p + 1], g[p], 0.0
            for a in range(p):
                drop[a] = 0.0
            for c in range(p):
                w = g[c] / F
                dot += g[c] * lam[c]
                for a in range(p):
                    drop[a] += w * N[c, a]
            for a in range(p):
                twice += g[a] * drop[a]
            twice = (1.0 + twice) / F
            for a in range(p):
                w = z[a] if a >= i else 0.0
                lam[a] -= w * dot / F
                for c in range(p):
                    N[a, c] -= w * drop[c]
                for c in range(i, p):
                    N[a, c] += (w * twice - drop[a]) * z[c]
