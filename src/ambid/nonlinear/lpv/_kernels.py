"""Compiled recursions of LPV difference equations in scaled signals: set point, basis, errors with slopes, free run.

Coefficients are those of the present sample: x(t) = -sum a_k(p(t)) z(t-k) + w(t) b(p(t)), z past outputs, or past x in
the output form. W (n_samples, n_w) holds lagged inputs and a last column of ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Table = NDArray[np.int64]

_FAR = 1e6  # times the typical size of the output: a recursion that is beyond has diverged


@compiled(error_model="numpy")
def set_points(y: Array, share: float, out: Array) -> None:
    """Low-pass filter of the outputs before each sample: their mean at first, then forgetting with `share`."""
    level = 0.0
    for t in range(y.size):
        out[t] = level if t > 0 else y[0]
        level += max(share, 1.0 / (t + 1)) * (y[t] - level)


@compiled(error_model="numpy")
def basis_at(s: float, hats: int, out: Array) -> None:
    """Basis functions at s, -1 to 1 in training: Legendre polynomials, or hats (linear beyond the last knots)."""
    n = out.size
    out[0] = 1.0
    if n == 1:
        return
    if hats == 0:
        out[1] = s
        for k in range(2, n):
            out[k] = ((2 * k - 1) * s * out[k - 1] - (k - 1) * out[k - 2]) / k
        return
    out[:] = 0.0
    at = 0.5 * (s + 1.0) * (n - 1)
    first = 0 if not at > 0.0 else min(int(min(at, 1e6)), n - 2)
    out[first + 1] = at - first
    out[first] = 1.0 - out[first + 1]


@compiled(error_model="numpy")
def basis_rows(s: Array, hats: int, out: Array) -> None:
    """Basis functions at each of s."""
    for t in range(s.size):
        basis_at(s[t], hats, out[t])


@compiled(error_model="numpy")
def run(
    y: Array, W: Array, phi: Array, psi: Array, theta: Array, start: Array, shape: Table, slopes: int,
    x: Array, g: Array, e: Array, J: Array,
) -> bool:  # fmt: skip
    """Write x, predictions g, innovations e and, with `slopes`, the derivatives J of g; False where they diverge.

    `shape` = (na, nd, nc, own, m, K_c): m samples before the first x, m + nd before the first e. theta holds, for each
    of a_1 ... a_na and the columns of W, one number for each column of phi, of which the ones have K_c; then for each
    of d_1 ... and c_1 ... one for each column of psi. `start` holds what x differs from y before m (output form,
    own = 1), then the innovations before the first. J (n_samples, n_theta + n_start): all columns with slopes = 2,
    those of `start` alone with 1.
    """
    na, nd, nc, own, m, K_c = shape[0], shape[1], shape[2], shape[3], shape[4], shape[5]
    n, n_w, K, Q, lag = y.size, W.shape[1], phi.shape[1], psi.shape[1], m + nd
    n_p, n_x = (na + n_w - 1) * K + K_c, own * na
    P = n_p + (nd + nc) * Q
    width = P + n_x + nc
    a, d, c = np.empty(max(na, 1)), np.empty(max(nd, 1)), np.empty(max(nc, 1))
    ring = max(na, nd) + 1
    dx = np.zeros((ring, width if slopes > 0 else 1))
    low = P if slopes == 1 else 0
    for t in range(m):
        x[t] = y[t]
    for k in range(n_x):
        x[m - 1 - k] += start[k]
        if slopes > 0:
            dx[(m - 1 - k) % ring, P + k] = 1.0
    e[:lag] = 0.0
    if slopes > 0:
        J[:lag] = 0.0
    for k in range(nc):
        e[lag - 1 - k] = start[n_x + k]
        if slopes > 0:
            J[lag - 1 - k, P + n_x + k] = -1.0
    for t in range(m, n):
        s = 0.0
        for k in range(na):
            a[k] = 0.0
            for j in range(K):
                a[k] += theta[k * K + j] * phi[t, j]
            s -= a[k] * (x[t - 1 - k] if own == 1 else y[t - 1 - k])
        for i in range(n_w):
            b = 0.0
            for j in range(K if i < n_w - 1 else K_c):
                b += theta[(na + i) * K + j] * phi[t, j]
            s += b * W[t, i]
        if not abs(s) < _FAR:
            return False
        x[t] = s
        now = t % ring
        if slopes > 0:
            dx[now] = 0.0
            if slopes == 2:
                for k in range(na):
                    z = -(x[t - 1 - k] if own == 1 else y[t - 1 - k])
                    for j in range(K):
                        dx[now, k * K + j] = z * phi[t, j]
                for i in range(n_w):
                    for j in range(K if i < n_w - 1 else K_c):
                        dx[now, (na + i) * K + j] = W[t, i] * phi[t, j]
            if own == 1:
                for k in range(na):
                    back = (t - 1 - k) % ring
                    for q in range(low, width):
                        dx[now, q] -= a[k] * dx[back, q]
        if t < lag:
            continue
        r = s
        for k in range(nd):
            d[k] = 0.0
            for j in range(Q):
                d[k] += theta[n_p + k * Q + j] * psi[t, j]
            r -= d[k] * (y[t - 1 - k] - x[t - 1 - k])
        for k in range(nc):
            c[k] = 0.0
            for j in range(Q):
                c[k] += theta[n_p + (nd + k) * Q + j] * psi[t, j]
            r += c[k] * e[t - 1 - k]
        if not abs(r) < _FAR:
            return False
        g[t] = r
        e[t] = y[t] - r
        if slopes == 0:
            continue
        for q in range(low, width):
            J[t, q] = dx[now, q]
        for k in range(nd):
            back = (t - 1 - k) % ring
            for q in range(low, width):
                J[t, q] += d[k] * dx[back, q]
            if slopes == 2:
                for j in range(Q):
                    J[t, n_p + k * Q + j] -= (y[t - 1 - k] - x[t - 1 - k]) * psi[t, j]
        for k in range(nc):
            for q in range(low, width):
                J[t, q] -= c[k] * J[t - 1 - k, q]
            if slopes == 2:
                for j in range(Q):
                    J[t, n_p + (nd + k) * Q + j] += e[t - 1 - k] * psi[t, j]
    return True


@compiled(error_model="numpy")
def free_run(
    y: Array, W: Array, s: Array, K: int, K_c: int, hats: int, theta: Array, na: int, first: int, share: float,
    middle: float, half: float,
) -> None:  # fmt: skip
    """Write the free run into y from sample `first` on; NaN from a divergence on.

    The scheduling signal is s or, with `share` > 0, the set point of the run itself: (level - middle) / half.
    """
    n, n_w = y.size, W.shape[1]
    phi, level = np.empty(K), 0.0
    for t in range(n):
        if t >= first:
            basis_at((level - middle) / half if share > 0.0 else s[t], hats, phi)
            x = 0.0
            for j in range(K):
                p = 0.0
                for k in range(na):
                    p -= theta[k * K + j] * y[t - 1 - k]
                for i in range(n_w if j < K_c else n_w - 1):
                    p += theta[(na + i) * K + j] * W[t, i]
                x += p * phi[j]
            if not abs(x) < _FAR:
                y[t:] = np.nan
                return
            y[t] = x
        level += max(share, 1.0 / (t + 1)) * (y[t] - level)
