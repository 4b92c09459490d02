"""Compiled recursions of a NARMAX model in scaled signals: predictions, free runs and their exact sensitivities.

All signals stand in one array z (n_samples, outputs + inputs + innovations). A factor is a column of it and a lag; a
term is a row of factor numbers, -1 behind the last. The model of output o is yhat = num / (1 + den), num and den sums
of coefficient times term.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

Table = NDArray[np.int64]

_FAR = 1e6  # times the typical size of the output: a recursion that is beyond has diverged


@compiled(error_model="numpy")
def run(
    z: Array, column: Table, back: Table, terms: Table, place: Table, theta: Array, shape: Table, out: Array
) -> None:
    """Run the model over z from sample `lag` on; `shape` = (lag, n_outputs, n_inputs, free, folded).

    `place` (n_terms, 2) holds output and 1 for the denominator. Predicts from the measured outputs and writes
    innovations into z, or with `free` writes its own outputs into z. `out` (n_samples, n_outputs) is NaN where nothing
    is predicted, and from where the recursion diverges on. With `folded` only the magnitude of the output is measured:
    it gets the sign that is predicted, and `out` is the magnitude of the prediction; with 2 it is the mean of this
    magnitude and that of the output before.
    """
    lag, n_y, n_u, free, folded = shape[0], shape[1], shape[2], shape[3], shape[4]
    n, n_e = z.shape[0], n_y + n_u
    recursive = free == 1
    for v in range(column.size):
        recursive = recursive or column[v] >= n_e
    num, den = np.empty(n_y), np.empty(n_y)
    out[:] = np.nan
    for t in range(lag, n):
        num[:] = 0.0
        den[:] = 1.0
        for k in range(terms.shape[0]):
            p = theta[k]
            for j in range(terms.shape[1]):
                v = terms[k, j]
                if v < 0:
                    break
                p *= z[t - back[v], column[v]]
            if place[k, 1] == 1:
                den[place[k, 0]] += p
            else:
                num[place[k, 0]] += p
        for o in range(n_y):
            x = num[o] / den[o]
            if recursive and not abs(x) < _FAR:
                out[t:, :] = np.nan
                return
            out[t, o] = x
            if folded == 1:
                out[t, o] = abs(x)
            elif folded == 2:
                out[t, o] = 0.5 * (abs(x) + abs(z[t - 1, o]))
            if free == 1:
                z[t, o] = x
            else:
                if folded > 0:
                    z[t, o] = np.copysign(z[t, o], x)
                z[t, n_e + o] = z[t, o] - x


@compiled(error_model="numpy")
def slopes(
    z: Array, column: Table, back: Table, terms: Table, place: Table, theta: Array, shape: Table, out: Array
) -> None:
    """Derive what `run` computed by theta; z as `run` left it; `out` (n_samples, n_outputs, n_terms), zero before lag.

    Each output's slope is that of its own terms, plus what its factors that are themselves computed pass on: the
    innovations (slope minus that of the prediction) or, in a free run, the outputs. Where outputs are folded, the slope
    of the magnitude is that of the output times its sign, which is put in at the end.
    """
    lag, n_y, n_u, free = shape[0], shape[1], shape[2], shape[3]
    n, n_e, n_v, n_k = z.shape[0], n_y + n_u, column.size, terms.shape[0]
    passed = np.zeros(n_v)
    for v in range(n_v):
        if free == 1 and column[v] < n_y:
            passed[v] = 1.0
        elif free == 0 and column[v] >= n_e:
            passed[v] = -1.0
    num, den, value = np.empty(n_y), np.empty(n_y), np.empty(n_k)
    by_factor = np.empty((n_y, n_v))
    out[:lag] = 0.0
    for t in range(lag, n):
        num[:] = 0.0
        den[:] = 1.0
        by_factor[:] = 0.0
        for k in range(n_k):
            p = 1.0
            for j in range(terms.shape[1]):
                if terms[k, j] < 0:
                    break
                p *= z[t - back[terms[k, j]], column[terms[k, j]]]
            value[k] = p
            if place[k, 1] == 1:
                den[place[k, 0]] += theta[k] * p
            else:
                num[place[k, 0]] += theta[k] * p
        for k in range(n_k):
            o = place[k, 0]
            w = 1.0 / den[o]
            if place[k, 1] == 1:
                w *= -num[o] / den[o]
            for q in range(n_y):
                out[t, q, k] = w * value[k] if q == o else 0.0
            for j in range(terms.shape[1]):
                v = terms[k, j]
                if v < 0:
                    break
                if passed[v] != 0.0:
                    p = theta[k] * w
                    for i in range(terms.shape[1]):
                        if terms[k, i] < 0:
                            break
                        if i != j:
                            p *= z[t - back[terms[k, i]], column[terms[k, i]]]
                    by_factor[o, v] += p * passed[v]
        for v in range(n_v):
            if passed[v] != 0.0:
                source = column[v] if free == 1 else column[v] - n_e
                for o in range(n_y):
                    a = by_factor[o, v]
                    if a != 0.0:
                        for k in range(n_k):
                            out[t, o, k] += a * out[t - back[v], source, k]
    if shape[4] > 0:
        share = 1.0 if shape[4] == 1 else 0.5
        for t in range(n - 1, lag - 1, -1):  # backwards, for the slope before is needed as it is
            for o in range(n_y):
                now = share * np.copysign(1.0, z[t, o])
                before = 0.5 * np.copysign(1.0, z[t - 1, o]) if shape[4] == 2 and free == 1 and t > lag else 0.0
                for k in range(n_k):
                    out[t, o, k] *= now
                    if before != 0.0:
                        out[t, o, k] += before * out[t - 1, o, k]
