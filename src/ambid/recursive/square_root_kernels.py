"""The square-root core of all recursions: P = U D Uᵀ by rank-one steps (Bierman 1977, ch. III, V, VI), D > 0 whatever
is rounded, no roots. Row j of `F` (n, n) has column j of unit upper U before its diagonal, D_j on it, the rest unread.
"""

from __future__ import annotations

from math import sqrt

from ambid.arrays import Array
from ambid.compiled import compiled


@compiled(error_model="numpy", fastmath={"contract"})
def project(F: Array, h: Array, f: Array) -> None:
    """Fill f with Uᵀ h."""
    for j in range(f.size):
        x = h[j]
        for i in range(j):
            x += F[j, i] * h[i]
        f[j] = x


@compiled(error_model="numpy", fastmath={"contract"})
def size(F: Array, f: Array) -> float:
    """Return hᵀ P h for f = Uᵀ h."""
    total = 0.0
    for j in range(f.size):
        total += F[j, j] * f[j] * f[j]
    return total


@compiled(error_model="numpy", fastmath={"contract"})
def variance(F: Array, i: int) -> float:
    """Return the variance of state i."""
    total = F[i, i]
    for j in range(i + 1, F.shape[0]):
        total += F[j, j] * F[j, i] * F[j, i]
    return float(total)


@compiled(error_model="numpy", fastmath={"contract"})
def deviations(F: Array, sd: Array) -> None:
    """Fill sd with the standard deviations of all states."""
    for i in range(sd.size):
        sd[i] = sqrt(variance(F, i))


@compiled(error_model="numpy", fastmath={"contract"})
def shrink(F: Array, f: Array, r: float, k: Array) -> float:
    """Take in a measurement of noise variance r > 0 that sees f = Uᵀ h (Bierman 1977, sec. V.3): P becomes P - P h hᵀ P
    / α; leave P h in k and return α = r + hᵀ P h.
    """
    alpha, inverse = r, 1.0 / r
    for j in range(f.size):
        before, part = alpha, -f[j] * inverse
        g = F[j, j] * f[j]
        alpha += g * f[j]
        inverse = 1.0 / alpha
        F[j, j] *= before * inverse
        for i in range(j):
            x = F[j, i]
            F[j, i] = x + part * k[i]
            k[i] += x * g
        k[j] = g
    return alpha


@compiled(error_model="numpy", fastmath={"contract"})
def widen(F: Array, a: Array, q: float) -> None:
    """Replace P by P + q a aᵀ, q > 0 (Agee and Turner; Bierman 1977, sec. III.3); `a` is used up."""
    total = 1.0 / q
    inverse = q
    for j in range(a.size - 1, -1, -1):
        x, d = a[j], F[j, j]
        if d > 0.0:
            part = x / d
            total += part * x
            F[j, j] = d * total * inverse
            inverse = 1.0 / total
            part *= inverse
            for i in range(j):
                a[i] -= x * F[j, i]
                F[j, i] += part * a[i]
        elif x != 0.0:  # a direction that was certain: what is added lies along it alone
            F[j, j] = x * x * inverse
            for i in range(j):
                F[j, i] = a[i] / x
            return


@compiled(error_model="numpy", fastmath={"contract"})
def walk(F: Array, q: Array, a: Array) -> None:
    """Let states walk at random: the variance of each grows by that in q (n,); `a` (n,) is scratch."""
    for i in range(q.size):
        if q[i] > 0.0:
            for j in range(i):
                a[j] = 0.0
            a[i] = 1.0
            widen(F, a[: i + 1], q[i])


@compiled(error_model="numpy", fastmath={"contract"})
def propagate(F: Array, A: Array, J: Array, G: Array, W: Array, w: Array) -> None:
    """Move P over x⁺ = A x + J z + G noise of covariance one, x the leading states, z those behind, which stay; `J` may
    have fewer columns. The new factors of x are those of W diag(w) Wᵀ by modified weighted Gram-Schmidt (Bierman 1977,
    sec. VI.4): stable, without roots. `W` (n_x, n_x + n_noise) and `w` (n_x + n_noise,) are scratch.
    """
    n, columns, known = A.shape[0], W.shape[1], A.shape[0] + J.shape[1]
    for j in range(n, F.shape[0]):
        for i in range(n):
            x = J[i, j - n] if j < known else 0.0
            for c in range(n):
                x += A[i, c] * F[j, c]
            for c in range(n, min(j, known)):
                x += J[i, c - n] * F[j, c]
            w[i] = x
        for i in range(n):
            F[j, i] = w[i]
    for j in range(n):
        for i in range(n):
            x = A[i, j]
            for c in range(j):
                x += A[i, c] * F[j, c]
            W[i, j] = x
        w[j] = F[j, j]
    for j in range(n, columns):
        for i in range(n):
            W[i, j] = G[i, j - n]
        w[j] = 1.0
    for j in range(n - 1, -1, -1):
        square = 0.0
        for c in range(columns):
            square += W[j, c] * W[j, c] * w[c]
        F[j, j] = square
        inverse = 1.0 / square if square > 0.0 else 0.0
        for i in range(j):
            along = 0.0
            for c in range(columns):
                along += W[i, c] * W[j, c] * w[c]
            along *= inverse
            F[j, i] = along
            for c in range(columns):
                W[i, c] -= along * W[j, c]
