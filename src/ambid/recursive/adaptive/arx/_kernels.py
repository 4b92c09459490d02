"""Compiled tapped delay lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Table = NDArray[np.int64]


@compiled(error_model="numpy")
def tapped(past: Array, table: Table, x: Array, rows: Array, theta: Array, first: int) -> None:
    """Fill rows (n, n_columns) from signals x (n, n_channels) and from what came before, past (n_lags, n_channels).

    `table` holds a channel, a lag and a sign for each column; channel -1 is the constant 1. With `theta` (p,), the last
    channel of x is made here: the output of a model without noise, from columns `first`, ... and these coefficients.
    The row of a sample that holds a number that is not finite begins with NaN.
    """
    lags, last = past.shape[0], x.shape[1] - 1
    for t in range(x.shape[0]):
        finite = True
        for c in range(x.shape[1]):
            if theta.size == 0 or c < last:
                finite = finite and np.isfinite(x[t, c])
        for j in range(table.shape[0]):
            c, k = table[j, 0], t - table[j, 1]
            if c < 0:
                rows[t, j] = 1.0
            else:
                rows[t, j] = table[j, 2] * (x[k, c] if k >= 0 else past[lags + k, c])
        if theta.size > 0:
            made = 0.0
            for j in range(theta.size):
                made += rows[t, first + j] * theta[j]
            x[t, last] = made if np.isfinite(made) else 0.0
        if not finite:
            rows[t, 0] = np.nan
    n = x.shape[0]
    for k in range(lags):
        for c in range(last + 1):
            past[k, c] = past[k + n, c] if k + n < lags else x[k + n - lags, c]
