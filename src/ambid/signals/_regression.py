"""Least squares on lagged samples by QR: the autoregressions behind outliers, signal-to-noise ratio and delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.errors import EstimationError
from ambid.record.record import Array

_ROWS = 8192


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regression:
    """A least-squares fit: coefficients and their sd, shape (n_columns,), residual variance and the number of rows."""

    coefficients: Array
    sd: Array
    variance: float
    n_rows: int


def fit_arx(y: Array, inputs: Sequence[Array], na: int, lags: Sequence[int]) -> Regression:
    """Fit y(t) = -a·y(t-1…t-na) + b·u(t-lags) + constant by QR.

    Columns: `na` of the output, then len(lags) of each input, then the constant. Coefficients hold +y weights (-a).
    """
    reach = max([na, *lags])
    n_columns, n_rows = na + len(lags) * len(inputs) + 1, y.size - reach
    if n_rows <= 2 * n_columns:
        raise EstimationError(
            f"{y.size} samples are too few for a regression on {n_columns} lagged values; it needs more than "
            f"{2 * n_columns + reach}. Use a longer record, or a lower order"
        )
    columns = [(y, lag) for lag in range(1, na + 1)] + [(u, lag) for u in inputs for lag in lags]
    norms = np.array([np.linalg.norm(x) or 1.0 for x, _ in columns] + [np.sqrt(n_rows)])
    r = _triangle(y, columns, norms, reach)
    triangle, rhs = r[:n_columns, :n_columns], r[:n_columns, n_columns]
    # A noise-free record makes lagged columns dependent: the smallest norm among all solutions predicts as well.
    u, s, vt = np.linalg.svd(triangle)
    kept = s > s[0] * 1e-12
    inverse = (vt[kept].T / s[kept]) @ u[:, kept].T
    variance = float(r[n_columns, n_columns] ** 2) / (n_rows - int(kept.sum()))
    sd = np.sqrt(variance * np.sum(inverse**2, axis=1)) / norms
    return Regression(coefficients=inverse @ rhs / norms, sd=sd, variance=variance, n_rows=n_rows)


def _triangle(y: Array, columns: Sequence[tuple[Array, int]], norms: Array, reach: int) -> Array:
    """Return R of the QR factorisation of [x(t - lag)/norm of all columns, 1/norm, y(t)] for t >= reach.

    Rows are folded in by blocks that fit the processor's cache, so that memory does not grow with the record.
    """
    r = np.zeros((0, len(columns) + 2))
    for first in range(reach, y.size, _ROWS):
        last = min(first + _ROWS, y.size)
        block = np.empty((last - first, len(columns) + 2), order="F")
        for k, (x, lag) in enumerate(columns):
            np.divide(x[first - lag : last - lag], norms[k], out=block[:, k])
        block[:, -2] = 1.0 / norms[-1]
        block[:, -1] = y[first:last]
        r = np.asarray(np.linalg.qr(np.concatenate((r, block)), mode="r"))
    return r
