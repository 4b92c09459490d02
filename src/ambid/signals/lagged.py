"""Triangles of lagged samples: all that least squares needs of a record, in memory that does not grow with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ambid.arrays import Array

_ROWS = 8192  # of a block that fits the processor's cache


def lagged_triangle(columns: Sequence[tuple[Array, int]], first: int) -> Array:
    """Return R of the QR factorisation of [x(t - lag) of every column] for t >= first.

    `columns`: (n_samples,), and int), signal x and its lag; a constant is a signal of ones without lag; `first`: first
    row, at least the largest lag. Returns (n_columns, n_columns), rows of zeros at the end where there are fewer rows
    than columns.
    """
    n, width = columns[0][0].size, len(columns)
    R = np.zeros((0, width))
    rows = max(_ROWS, 4 * width)
    for start in range(first, n, rows):
        stop = min(start + rows, n)
        block = np.empty((R.shape[0] + stop - start, width), order="F")
        block[: R.shape[0]] = R
        for k, (x, lag) in enumerate(columns):
            block[R.shape[0] :, k] = x[start - lag : stop - lag]
        R = np.asarray(np.linalg.qr(block, mode="r"))
    return np.vstack([R, np.zeros((width - R.shape[0], width))])
