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
from ambid.recursive.square_root_kernels import project, shrink, variance, widen

Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

_MOST = 0.5  # part of a positive number by which one block may lower it


@compiled(error_model="numpy", fastmath={"contract"})
def advance(
    u: Array,
    y: Array,
    forcing: Array,
    M: Array,
    D: Array,
    C: Array,
    H: Array,
    W: Array,
    scale: Array,
    lags: Integers,
    history: Array,
    x: Array,
    s: Array,
    rows: Array,
    triangle: Array,
    counts: Integers,
    errors: Array,
) -> int:
    """Run until a block is complete, samples are used up, or one is not finite; return how many were used.

    `u`, `y` in SI; `scale` (2, n_u + n_y) holds the operating point and the scales. `errors` (n_samples, n_y) gets
    innovations in scaled units, `W` weights them, and `H` is W C. `rows` (p + 1, room) holds rows that are not folded
    yet. `counts`: place of the next input in `history`, rows and samples of the present block, samples still to settle,
    samples of a block.
    """
    (n_x, n_l), (n_u, n_y), p = M.shape, (u.shape[1], y.shape[1]), s.shape[1]
    depth, n_f, room = history.shape[0], forcing.shape[1], rows.shape[1]
    w, f, first_y = np.empty(n_l), np.empty((n_x, p)), n_x + lags.size * n_u
    for k in range(y.shape[0]):
        now, finite = counts[0], True
        for j in range(n_u):
            history[now, j] = (u[k, j] - scale[0, j]) / scale[1, j]
            finite = finite and math.isfinite(u[k, j])
        for j in range(n_y):
            w[first_y + j] = (y[k, j] - scale[0, n_u + j]) / scale[1, n_u + j]
            finite = finite and math.isfinite(y[k, j])
        w[first_y + n_y] = 1.0
        for j in range(n_f):
            w[first_y + n_y + 1 + j] = forcing[k, j]
            finite = finite and math.isfinite(forcing[k, j])
        if not finite:
            return k
        column = n_x
        for lag in lags:
            at = (now - lag) % depth
            for j in range(n_u):
                w[column] = history[at, j]
                column += 1
        for j in range(n_x):
            w[j] = x[j]
        counts[0] = (now + 1) % depth
        for i in range(n_y):
            v = w[first_y + i]
            for j in range(n_x):
                v -= C[i, j] * x[j]
            errors[k, i] = v
        if counts[3] > 0:
            counts[3] -= 1
        else:
            r = counts[1]
            for i in range(n_y):
                for q in range(p):
                    v = 0.0
                    for j in range(n_x):
                        v -= H[i, j] * s[j, q]
                    rows[q, r + i] = v
                v = 0.0
                for j in range(n_y):
                    v += W[i, j] * errors[k, j]
                rows[p, r + i] = v
            counts[1] = r + n_y
            counts[2] += 1
        # next state and sensitivities
        for i in range(n_x):
            for q in range(p):
                f[i, q] = 0.0
        for c in range(n_l):
            v = w[c]
            for i in range(n_x):
                for q in range(p):
                    f[i, q] += v * D[c, i, q]
        for i in range(n_x):
            for j in range(n_x):
                v = M[i, j]
                for q in range(p):
                    f[i, q] += v * s[j, q]
        for i in range(n_x):
            for q in range(p):
                s[i, q] = f[i, q]
        for i in range(n_x):
            v = 0.0
            for c in range(n_l):
                v += M[i, c] * w[c]
            x[i] = v
        if counts[1] + n_y > room or counts[2] == counts[4]:
            fold(triangle, rows, counts[1], counts[1])
            counts[1] = 0
            if counts[2] == counts[4]:
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


@compiled(error_model="numpy")
def walk(F: Array, rates: Array, active: Flags, time: float, f: Array) -> None:
    """Let the active numbers walk: their variances grow by time x rates; `f` (p,) is scratch."""
    for j in range(rates.size):
        if active[j] and rates[j] > 0.0:
            for i in range(f.size):
                f[i] = 1.0 if i == j else 0.0
            widen(F, f, time * rates[j])


@compiled(error_model="numpy")
def far(q: Array, at: Array, J: Array, F: Array, curved: Array, most: float) -> bool:
    """Return whether |J (q - at)|^2 passes `most`, or a squared move its standard deviation times `curved`."""
    p, total = q.size, 0.0
    for a in range(p):
        v = 0.0
        for k in range(a, p):
            v += J[a, k] * (q[k] - at[k])
        total += v * v
        if (q[a] - at[a]) ** 2 > curved[a] * math.sqrt(variance(F, a)):
            return True
    return total > most


@compiled(error_model="numpy", fastmath={"contract"})
def walk_score(
    J: Array, r: Array, at: Array, count: int, first: int, q0: Array, P0: Array, step: Array, noise: float,
    K: Array, errors: Array,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return sums of lambda_j^2 and N_jj over a ring of `count` blocks, and estimate and covariance after the last.

    The difference of the sums is twice the score.

    Kalman filter forward over blocks `first`, ..., their rows one by one, with a random walk of variance step^2 from
    one block to the next; then the disturbance smoother backward (Koopman and Shephard 1992; Durbin and Koopman 2012,
    sec. 4.5 and 6.4). J (size, p, p) upper triangular; `K` (size, p, p) and `errors` (size, p, 2) are scratch. Inner
    loops run along rows of symmetric matrices: they take no sums, so that vector instructions fit.
    """
    size, p = J.shape[0], J.shape[1]
    q, P = q0.copy(), P0.copy()
    for b in range(count):
        block = (first + b) % size
        for i in range(p):
            z, g = J[block, i], K[b, i]
            v, F = r[block, i], noise
            for a in range(i, p):
                v += z[a] * (q[a] - at[block, a])
            g[:] = 0.0
            for c in range(i, p):
                w = z[c]
                for a in range(p):
                    g[a] += w * P[c, a]
            for a in range(i, p):
                F += g[a] * z[a]
            errors[b, i, 0], errors[b, i, 1] = v, F
            for a in range(p):
                w = g[a] / F
                q[a] -= w * v
                for c in range(p):
                    P[a, c] -= w * g[c]
        if b < count - 1:
            for a in range(p):
                P[a, a] += step[a] * step[a]
    lam, N, drop = np.zeros(p), np.zeros((p, p)), np.zeros(p)
    squares, powers = np.zeros(p), np.zeros(p)
    for b in range(count - 1, -1, -1):
        block = (first + b) % size
        if b < count - 1:
            for a in range(p):
                squares[a] += lam[a] * lam[a]
                powers[a] += N[a, a]
        for i in range(p - 1, -1, -1):
            z, g, v, F = J[block, i], K[b, i], errors[b, i, 0], errors[b, i, 1]
            # L = I - K z / F:  lambda <- -z error / F + L^T lambda,  N <- z z^T / F + L^T N L
            dot, twice = v, 0.0
            drop[:] = 0.0
            for c in range(p):
                w = g[c]
                dot += w * lam[c]
                for a in range(p):
                    drop[a] += w * N[c, a]
            for a in range(p):
                twice += g[a] * drop[a]
            twice = (1.0 + twice / F) / F
            for a in range(p):
                drop[a] /= F
            for a in range(i, p):
                w = z[a]
                lam[a] -= w * dot / F
                for c in range(p):
                    N[a, c] += w * (z[c] * twice - drop[c]) if c >= i else -w * drop[c]
            for a in range(p):
                w = drop[a]
                for c in range(i, p):
                    N[a, c] -= w * z[c]
    return squares, powers, q, P
