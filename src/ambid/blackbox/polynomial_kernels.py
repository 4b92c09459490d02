"""Compiled recursions of the polynomial predictor, and the triangle of its residual and gradients.

Signals are rows of one buffer, each made from earlier rows by one filter, by a table of whole numbers made once for a
structure. The buffer holds a block of samples behind `pad` of history, so that a long record needs no more memory.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Table = NDArray[np.int64]

# columns of the table of filters and of the table of their terms
_DESTINATION, _DENOMINATOR, _N_DENOMINATOR, _FIRST_TERM, _LAST_TERM, _IMPULSE = range(6)
_SOURCE, _NUMERATOR, _N_NUMERATOR, _LAG = range(4)
_FORGOTTEN = 1e-17  # what is left of a unit impulse when it no longer counts
_LOST = 1e-30


@compiled(fastmath={"contract", "reassoc", "nsz"})
def _add_moving_sum(c: Array, lag: int, x: Array, y: Array, pad: int, m: int) -> None:
    """Add sum_j c_j x(t - lag - j) to y(t). Slices, whose indices cannot be negative, let vector instructions in."""
    out = y[pad : pad + m]
    for j in range(c.size):
        a, first = c[j], pad - lag - j
        if a != 0:
            past = x[first : first + m]
            for t in range(m):
                out[t] += a * past[t]


@compiled(fastmath={"contract"})
def _recurse(c: Array, y: Array, pad: int, m: int) -> None:
    """Turn y into y / c in place, c = c_1, c_2, ...; one and two coefficients stay in registers."""
    n, out = c.size, y[pad : pad + m]
    if n == 1:
        p, a = y[pad - 1], c[0]
        for t in range(m):
            p = out[t] - a * p
            out[t] = p
    elif n == 2:
        p, q, a, b = y[pad - 1], y[pad - 2], c[0], c[1]
        for t in range(m):
            r = (out[t] - b * q) - a * p
            q = p
            p = r
            out[t] = r
    elif n == 3:
        p, q, r, a, b, d = y[pad - 1], y[pad - 2], y[pad - 3], c[0], c[1], c[2]
        for t in range(m):
            s = (out[t] - d * r - b * q) - a * p
            r = q
            q = p
            p = s
            out[t] = s
    else:
        for t in range(pad, pad + m):
            s = y[t]
            for k in range(n - 1, -1, -1):
                s = s - c[k] * y[t - 1 - k]
            y[t] = s


@compiled(inline="always")
def _ring(c: Array, y: Array, pad: int, m: int) -> None:
    """Turn y into y / c in place and end the response where it is lost in rounding: denormal numbers are slow."""
    for t in range(pad, pad + m):
        s = y[t]
        for k in range(c.size - 1, -1, -1):
            s = s - c[k] * y[t - 1 - k]
        y[t] = s if np.abs(s) > _LOST else 0


@compiled(inline="always")
def _filter_block(filters: Table, terms: Table, coef: Array, s: Array, pad: int, m: int, impulse: int) -> None:
    """Run every filter over one block. `impulse`: 0 where nothing of the impulse at the first row is left."""
    for f in range(filters.shape[0]):
        if filters[f, _IMPULSE] and not impulse:
            continue
        y = s[filters[f, _DESTINATION]]
        for t in range(pad, pad + m):
            y[t] = 0
        for k in range(filters[f, _FIRST_TERM], filters[f, _LAST_TERM]):
            first = terms[k, _NUMERATOR]
            _add_moving_sum(
                coef[first : first + terms[k, _N_NUMERATOR]], terms[k, _LAG], s[terms[k, _SOURCE]], y, pad, m
            )
        first = filters[f, _DENOMINATOR]
        last = first + filters[f, _N_DENOMINATOR]
        if last > first and filters[f, _IMPULSE]:
            _ring(coef[first:last], y, pad, m)
        elif last > first:
            _recurse(coef[first:last], y, pad, m)


@compiled(inline="always")
def _next_block(s: Array, y: Array, u: Array, impulse_row: int, t0: int, first: int, pad: int, m: int) -> None:
    """Keep the end of the last block as history and read the next samples."""
    for i in range(s.shape[0]):
        for t in range(pad):
            s[i, t] = s[i, m + t]
    last = min(first + m, y.size)
    for t in range(first, last):  # a copy of slices would compile the text of an error as well
        s[0, pad + t - first] = y[t]
    for i in range(u.shape[0]):
        for t in range(first, last):
            s[1 + i, pad + t - first] = u[i, t]
    for t in range(pad, pad + m):
        s[impulse_row - 1, t], s[impulse_row, t] = 1, 0
    if first <= t0 < last:
        s[impulse_row, pad + t0 - first] = 1


@compiled(inline="always")
def _still_ringing(filters: Table, s: Array, pad: int, m: int) -> int:
    """Return 1 while the history of any impulse response counts, else flush it to zero."""
    for f in range(filters.shape[0]):
        if filters[f, _IMPULSE]:
            for t in range(m, m + pad):
                if np.abs(s[filters[f, _DESTINATION], t]) > _FORGOTTEN:
                    return 1
    for f in range(filters.shape[0]):
        if filters[f, _IMPULSE]:
            for t in range(s.shape[1]):
                s[filters[f, _DESTINATION], t] = 0
    return 0


@compiled(fastmath={"contract", "reassoc", "nsz"})
def add_rows(R: Array, w: Array, n: int, first: int) -> None:
    """Take the first `n` samples of rows `w` (n_columns, block), zero before column `first`, into the triangle R by
    Householder reflections, column j's mixing R[j] with new samples alone: one sweep takes one off and sums the next.
    """
    p = R.shape[0]
    tau, size = np.zeros(p), np.zeros(p)
    for k in range(first, p):
        x, s = w[k], 0.0
        v = w[first]
        for t in range(n):
            s += v[t] * x[t]
        for j in range(first, k):
            g = tau[j] * (R[j, k] + s * size[j])
            R[j, k] -= g
            g *= size[j]
            v, after, s = w[j], w[j + 1], 0.0
            if j + 1 < k:
                for t in range(n):
                    x[t] -= g * v[t]
                    s += after[t] * x[t]
            else:
                for t in range(n):
                    x[t] -= g * v[t]
                    s += x[t] * x[t]
        if s > 0.0:
            a = R[k, k]
            b = -np.sqrt(a * a + s) if a > 0 else np.sqrt(a * a + s)
            size[k] = 1.0 / (a - b)
            tau[k] = (b - a) / b
            R[k, k] = b


@compiled
def block_rows(
    y: Array,
    u: Array,
    filters: Table,
    terms: Table,
    columns: Table,
    coef: Array,
    s: Array,
    w: Array,
    pad: int,
    t0: int,
    impulse_row: int,
    first: int,
    ringing: int,
) -> tuple[int, int]:
    """Put the rows of samples `first`, ... into w (n_columns, block); return how many, and whether impulses still ring.
    Blocks follow each other; `s` (n_signals, pad + block) begins with zeros and carries the history, `ringing` with 1.
    """
    n, p, m = y.size, columns.shape[0], w.shape[1]
    if first and ringing and first > t0 + pad:
        ringing = _still_ringing(filters, s, pad, m)
    _next_block(s, y, u, impulse_row, t0, first, pad, m)
    _filter_block(filters, terms, coef, s, pad, m, ringing)
    skip = max(0, t0 - first)
    rows = max(0, min(m, n - first) - skip)
    for j in range(p):
        a, sign = pad + skip - columns[j, 1], columns[j, 2]
        x, out = s[columns[j, 0], a : a + rows], w[j, :rows]
        for t in range(rows):
            out[t] = sign * x[t]
    return rows, ringing
