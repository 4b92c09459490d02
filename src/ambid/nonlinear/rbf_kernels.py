"""Compiled loop over samples: steepest descent of the output weights of a radial basis network."""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled


@compiled(error_model="numpy")
def descent_pass(F: Array, Y: Array, rate: float, bounded: int, W: Array) -> int:
    """Take one step W <- W + eta e f' for each row f of F (n, d); W (p, d) changes. Return where it diverged, or -1.

    `bounded`: eta is no larger than one over the squared slope of all errors, with which none of them grows.
    """
    (n, d), p = F.shape, Y.shape[1]
    e = np.zeros(p)
    for t in range(n):
        size = 0.0
        for j in range(d):
            size += p * F[t, j] * F[t, j]
        eta = min(rate, 1.0 / size) if bounded == 1 and size > 0.0 else rate
        for o in range(p):
            e[o] = Y[t, o]
            for j in range(d):
                e[o] -= W[o, j] * F[t, j]
        for o in range(p):
            for j in range(d):
                W[o, j] += eta * e[o] * F[t, j]
                if not abs(W[o, j]) < 1e12:
                    return t
    return -1
