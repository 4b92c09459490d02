"""Compiled changes of a triangular factor, shared by the loops of the joint filters.

A covariance is S S^T with S lower triangular; `T` holds S transposed, so that a column of S lies together in memory.
"""
# mypy: disallow-untyped-decorators=False

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled


@compiled
def rank_one(T: Array, w: Array, first: int) -> None:
    """Replace S by the factor of S S^T + w w^T by plane rotations; `w` is zero before `first` and is used up."""
    n = T.shape[0]
    for j in range(first, n):
        r = np.hypot(T[j, j], w[j])
        c, s = T[j, j] / r, w[j] / r
        T[j, j], w[j] = r, 0.0
        for i in range(j + 1, n):
            t = T[j, i]
            T[j, i] = c * t + s * w[i]
            w[i] = c * w[i] - s * t


@compiled
def shrink(T: Array, f: Array, beta: float, b: Array) -> None:
    """Replace S by the factor of S (I - f f^T / alpha) S^T, alpha = beta + |f|^2; `b` becomes S f (Carlson 1973)."""
    n = T.shape[0]
    for i in range(n):
        b[i] = 0.0
    for j in range(n - 1, -1, -1):
        f_j = f[j]
        new = beta + f_j * f_j
        root = np.sqrt(beta * new)
        keep, take = beta / root, f_j / root
        for i in range(j, n):
            t = T[j, i]
            T[j, i] = keep * t - take * b[i]
            b[i] += f_j * t
        beta = new


@compiled
def rank_one_down(T: Array, w: Array, b: Array) -> bool:
    """Replace S by the factor of S S^T - w w^T; leave it as it is and return False where that is not positive.

    With S p = w the difference is S (I - p p^T) S^T; the bracket is factored from the bottom, where 1 - |p|^2 stands,
    so that nothing cancels (as in Carlson 1973).
    """
    n = T.shape[0]
    rest = 1.0
    for i in range(n):
        for j in range(i):
            w[i] -= T[j, i] * w[j]
        w[i] /= T[i, i]
        rest -= w[i] * w[i]
    if not rest > 1e-8:
        return False
    shrink(T, w, rest, b)
    return True


@compiled
def triangle(T: Array, s: int, W: Array) -> None:
    """Make the last block of S the lower triangular L with L L^T = W W^T (modified Gram-Schmidt, Bierman 1977)."""
    n_x, wide = W.shape
    for i in range(n_x):
        acc = 0.0
        for c in range(wide):
            acc += W[i, c] * W[i, c]
        length = np.sqrt(acc)
        T[s + i, s + i] = length
        back = 1.0 / length if length > 0.0 else 0.0
        for c in range(wide):
            W[i, c] *= back
        for j in range(i + 1, n_x):
            acc = 0.0
            for c in range(wide):
                acc += W[j, c] * W[i, c]
            T[s + i, s + j] = acc
            for c in range(wide):
                W[j, c] -= acc * W[i, c]


@compiled
def carry(T: Array, first: int, s: int, A: Array, J: Array, W: Array) -> None:
    """Carry rows of x over a step: A S_x + J S_q in columns from `first` on; A S_xx goes to the first of `W`."""
    n_x = J.shape[0]
    v = W[:, :n_x]
    for j in range(first, s):
        for i in range(n_x):
            acc = 0.0
            for c in range(n_x):
                acc += A[i, c] * T[j, s + c]
            for c in range(j, s):
                acc += J[i, c] * T[j, c]
            v[i, 0] = acc
        for i in range(n_x):
            T[j, s + i] = v[i, 0]
    for i in range(n_x):
        for j in range(n_x):
            acc = 0.0
            for c in range(j, n_x):
                acc += A[i, c] * T[s + j, s + c]
            v[i, j] = acc
