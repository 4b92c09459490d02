"""Least squares on lagged samples by QR: the autoregressions behind outliers, signal-to-noise ratio and delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.errors import EstimationError
from ambid.record.record import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Regression:
    """A least-squares fit: coefficients and their sd, shape (n_columns,), residual variance and the number of rows."""

    coefficients: Array
    sd: Array
    variance: float
    n_rows: int


def lagged(x: Array, lags: Sequence[int], reach: int) -> Array:
    """Return columns x(t - lag) for t = reach … n-1, shape (n - reach, n_lags)."""
    return np.column_stack([x[reach - lag : x.size - lag] for lag in lags])


def fit_arx(y: Array, inputs: Sequence[Array], na: int, lags: Sequence[int]) -> Regression:
    """Fit y(t) = -a·y(t-1…t-na) + b·u(t-lags) + constant by QR.

    Columns: `na` of the output, then len(lags) of each input, then the constant. Coefficients hold +y weights (-a).
    """
    reach = max([na, *lags])
    columns = [lagged(y, range(1, na + 1), reach)] if na else []
    columns += [lagged(u, lags, reach) for u in inputs]
    regressors = np.column_stack([*columns, np.ones(y.size - reach)])
    n_rows, n_columns = regressors.shape
    if n_rows <= 2 * n_columns:
        raise EstimationError(
            f"{y.size} samples are too few for a regression on {n_columns} lagged values; it needs more than "
            f"{2 * n_columns + reach}. Use a longer record, or a lower order"
        )
    norms = np.linalg.norm(regressors, axis=0)
    norms[norms == 0.0] = 1.0
    r: Array = np.asarray(np.linalg.qr(np.column_stack([regressors / norms, y[reach:]]), mode="r"))
    triangle, rhs = r[:n_columns, :n_columns], r[:n_columns, n_columns]
    # A noise-free record makes lagged columns dependent: the smallest norm among all solutions predicts as well.
    u, s, vt = np.linalg.svd(triangle)
    kept = s > s[0] * 1e-12
    inverse = (vt[kept].T / s[kept]) @ u[:, kept].T
    variance = float(r[n_columns, n_columns] ** 2) / (n_rows - int(kept.sum()))
    sd = np.sqrt(variance * np.sum(inverse**2, axis=1)) / norms
    return Regression(coefficients=inverse @ rhs / norms, sd=sd, variance=variance, n_rows=n_rows)
